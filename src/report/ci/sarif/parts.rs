//! Texts and file locations, used by results and fixes.

use std::fmt::Write as _;

use serde::Serialize;

use crate::check::Location;
use crate::report::ci::file;

/// Base of relative paths: by convention the root of the sources, known to the reader.
pub(super) const SOURCES: &str = "%SRCROOT%";
/// Base of absolute paths.
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

/// A path as a relative reference (RFC 3986): all characters except unreserved ones and `/` are percent-encoded.
pub(super) fn uri(path: &str) -> String {
    let mut out = String::with_capacity(path.len());
    for byte in path.bytes() {
        if byte.is_ascii_alphanumeric() || b"-._~/".contains(&byte) {
            out.push(char::from(byte));
        } else {
            let _infallible = write!(out, "%{byte:02X}");
        }
    }
    // An empty reference would not denote the directory itself.
    if out.is_empty() { ".".to_owned() } else { out }
}

/// Plain text without links (3.11.6).
pub(super) fn text(plain: &str) -> SarifText {
    let linked = plain.contains("](");
    SarifText { text: if linked { plain.replace('[', "\\[").replace(']', "\\]") } else { plain.to_owned() } }
}

#[cfg(test)]
mod tests {
    use super::{text, uri};

    #[test]
    fn reserved_bytes_are_percent_encoded() {
        assert_eq!(uri("a b/c:d?e#f%20[é]"), "a%20b/c%3Ad%3Fe%23f%2520%5B%C3%A9%5D");
        assert_eq!(uri(""), ".");
    }

    #[test]
    fn text_contains_no_links() {
        assert_eq!(text("[a](javascript:x)").text, "\\[a\\](javascript:x)");
        assert_eq!(text("is [1, 2]").text, "is [1, 2]");
    }
}
