//! Git LFS pointers: small text files in place of the content.

/// The content that a pointer refers to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LfsPointer {
    /// SHA-256 of the content, in hexadecimal, without the prefix `sha256:`.
    pub oid: String,
    /// Size of the content in bytes.
    pub size: u64,
}

/// Pointer files are smaller than this (git-lfs docs/spec.md: "less than 1024 bytes").
pub(crate) const MAX_POINTER: usize = 1024;

/// Addresses on the first line of a pointer, newest first.
const VERSIONS: [&str; 3] =
    ["https://git-lfs.github.com/spec/", "https://hawser.github.com/spec/", "http://git-media.io/v/"];

impl LfsPointer {
    /// Reads a pointer; `None` when the bytes are not one.
    ///
    /// Accepts what git-lfs accepts: either line ending, the older `hawser` address, `ext-` lines, and keys in any
    /// order after `version`. Source: git-lfs docs/spec.md.
    #[must_use]
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        if bytes.len() > MAX_POINTER {
            return None;
        }
        let text = std::str::from_utf8(bytes).ok()?;
        let mut lines = text.trim().lines().map(str::trim_end);
        let version = lines.next()?.strip_prefix("version ")?;
        if !VERSIONS.iter().any(|v| version.starts_with(v)) {
            return None;
        }
        let (mut oid, mut size) = (None, None);
        for line in lines {
            match line.split_once(' ') {
                Some(("oid", value)) => oid = Some(value.strip_prefix("sha256:").unwrap_or(value).to_owned()),
                Some(("size", value)) => size = value.parse().ok(),
                _ => {}
            }
        }
        Some(Self { oid: oid?, size: size? })
    }
}
