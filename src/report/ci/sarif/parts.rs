//! Texts and file locations, which results and fixes both have.

use std::fmt::Write as _;

use serde::Serialize;

use crate::check::Location;
use crate::report::ci::file;

/// What relative paths start from: by custom the root of the sources, which the reader knows.
pub(super) const SOURCES: &str = "%SRCROOT%";
/// What absolute paths start from.
pub(super) const ROOT: &str = "ROOT";

#[derive(Serialize)]
pub(super) struct SarifText {
    pub(super) text: String,
}

#[derive(Serialize, PartialEq)]
#[serde(rename_all = "camelCase")]
pub(super) struct ArtifactLocation {
    pub(super) uri: String,
    pub(super) uri_base_id: &'static str,
}

/// A file of the checkpoint at `path`.
pub(super) fn artifact(path: &str, name: &str) -> ArtifactLocation {
    let location = Location { file: Some(name.to_owned()), ..Location::default() };
    artifact_at(file(path, &location).as_deref().unwrap_or(path))
}

pub(super) fn artifact_at(path: &str) -> ArtifactLocation {
    let (uri, uri_base_id) = match path.strip_prefix('/') {
        Some(below) => (uri(below), ROOT),
        None => (uri(path), SOURCES),
    };
    ArtifactLocation { uri, uri_base_id }
}

/// A path as a relative reference (RFC 3986): only unreserved characters and `/` stand for themselves.
pub(super) fn uri(path: &str) -> String {
    let mut out = String::with_capacity(path.len());
    for byte in path.bytes() {
        if byte.is_ascii_alphanumeric() || b"-._~/".contains(&byte) {
            out.push(char::from(byte));
        } else {
            let _infallible = write!(out, "%{byte:02X}");
        }
    }
    // The directory itself is no empty reference.
    if out.is_empty() { ".".to_owned() } else { out }
}

/// Plain text in which nothing is a link (3.11.6).
pub(super) fn text(plain: &str) -> SarifText {
    let linked = plain.contains("](");
    SarifText { text: if linked { plain.replace('[', "\\[").replace(']', "\\]") } else { plain.to_owned() } }
}

#[cfg(test)]
mod tests {
    use super::{text, uri};

    #[test]
    fn every_byte_that_means_something_is_percent_encoded() {
        assert_eq!(uri("a b/c:d?e#f%20[é]"), "a%20b/c%3Ad%3Fe%23f%2520%5B%C3%A9%5D");
        assert_eq!(uri(""), ".");
    }

    #[test]
    fn words_make_no_link() {
        assert_eq!(text("[a](javascript:x)").text, "\\[a\\](javascript:x)");
        assert_eq!(text("is [1, 2]").text, "is [1, 2]");
    }
}
