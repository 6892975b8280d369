//! Names of files to be written.

use super::files;
use std::borrow::Cow;
use std::fmt;
use std::ops::Deref;
use std::path::Path;

use serde::{Deserialize, Deserializer};

use super::open::is_plain_file_name;
use super::text::escape;

/// Characters of a refused name that its error shows.
const SHOWN: usize = 80;

/// The name of a file that a plan writes: one plain component that is not hidden.
///
/// Plans hold only such names, so joining one to the directory of a plan never leaves that directory. Recipes and plans
/// make them from text.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct FileName(Cow<'static, str>);

/// A text that is not the name of a file to be written.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{name}` is not the name of a file in the result: it {reason}")]
pub struct FileNameError {
    name: String,
    reason: &'static str,
}

impl FileName {
    /// A name that the program itself gives, for constants: a separator or a leading dot stops the compiler.
    pub(crate) const fn constant(name: &'static str) -> Self {
        let mut rest = name.as_bytes();
        assert!(!matches!(rest, [] | [b'.', ..]), "a constant file name is neither empty nor hidden");
        while let [first, after @ ..] = rest {
            assert!(first.is_ascii_graphic() && !matches!(first, b'/' | b'\\' | b':'), "a constant file name is plain");
            rest = after;
        }
        Self(Cow::Borrowed(name))
    }

    /// The name of shard `number` (from 1) of `count`: `model.safetensors` for a single one.
    ///
    /// Source: `split_state_dict_into_shards_factory` in `huggingface_hub`.
    pub(crate) fn shard(number: usize, count: usize) -> Self {
        if count == 1 {
            Self::constant(files::WEIGHTS)
        } else {
            Self(Cow::Owned(format!("model-{number:05}-of-{count:05}.safetensors")))
        }
    }

    /// Parses a name.
    ///
    /// # Errors
    /// For what [`is_plain_file_name`] refuses, and for hidden names: `Checkpoint::open` does not read hidden files, and
    /// ckpt-doctor keeps its own there.
    pub fn parse(name: &str) -> Result<Self, FileNameError> {
        refusal(name).map_or_else(
            || Ok(Self(Cow::Owned(name.to_owned()))),
            |reason| Err(FileNameError { name: escape(name, SHOWN), reason }),
        )
    }
}

/// The reason why a text is not the name of a file to be written.
fn refusal(name: &str) -> Option<&'static str> {
    if name.is_empty() {
        Some("is empty")
    } else if name.len() > 255 {
        Some("has more than 255 bytes")
    } else if name.contains(['/', '\\', ':']) {
        Some("contains `/`, `\\` or `:`")
    } else if name.starts_with('.') {
        Some("starts with a dot")
    } else if is_plain_file_name(name) {
        None
    } else {
        Some("contains a control character")
    }
}

impl Deref for FileName {
    type Target = str;

    fn deref(&self) -> &str {
        &self.0
    }
}

impl AsRef<Path> for FileName {
    fn as_ref(&self) -> &Path {
        Path::new(&**self)
    }
}

impl fmt::Display for FileName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl<'de> Deserialize<'de> for FileName {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::parse(&String::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_plain_names_are_file_names() {
        for name in ["config.json", "model-00001-of-00002.safetensors", "a..b", "ü.txt"] {
            assert_eq!(&*FileName::parse(name).unwrap(), name);
        }
        let long = "x".repeat(256);
        for name in ["", ".", "..", "../a", "/a", "a/b", "a\\b", "C:a", "a\nb", "a\0", ".hidden", &long] {
            assert!(FileName::parse(name).is_err(), "{name}");
        }
        let error = FileName::parse("../x").unwrap_err().to_string();
        assert_eq!(error, "`../x` is not the name of a file in the result: it contains `/`, `\\` or `:`");
    }
}
