//! File name patterns, within limits.

use std::borrow::Cow;
use std::fmt;

use globset::{GlobBuilder, GlobSet, GlobSetBuilder};
use serde::{Deserialize, Deserializer};

use super::FileName;

/// Maximum length of a pattern in bytes.
const MAX_LENGTH: usize = 4096;
/// Maximum nesting of braces. globset 0.4.21 compiles a pattern to a regular expression, and panics in `compile_matcher` where
/// that is nested more deeply than the regex crate allows.
const MAX_NESTING: usize = 8;

/// Compiles a pattern in which `*` does not match `/`. Called for the `per-path` of settings, and for `.gitattributes`.
///
/// # Errors
/// The reason, when the pattern is malformed or exceeds a limit.
pub(crate) fn glob(pattern: &str) -> Result<GlobSet, String> {
    if pattern.len() > MAX_LENGTH {
        return Err(format!("it has {} bytes; at most {MAX_LENGTH} are allowed", pattern.len()));
    }
    if nesting(pattern) > MAX_NESTING {
        return Err(format!("its braces are nested more than {MAX_NESTING} deep"));
    }
    let glob = GlobBuilder::new(pattern).literal_separator(true).build().map_err(|error| error.kind().to_string())?;
    // Unlike the matcher of a single glob, a set does not panic where the regular expression is refused.
    GlobSetBuilder::new().add(glob).build().map_err(|error| error.kind().to_string())
}

/// Name of a file, or a pattern for names of files, as written in a recipe.
#[derive(Debug, Clone)]
pub enum FilePattern {
    /// A name, without `*`, `?`, `[` and `{`.
    Name(FileName),
    /// A pattern, as written and compiled.
    Pattern(String, GlobSet),
}

impl fmt::Display for FilePattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(name) => f.write_str(name),
            Self::Pattern(text, _) => f.write_str(text),
        }
    }
}

impl<'de> Deserialize<'de> for FilePattern {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = Cow::<str>::deserialize(deserializer)?;
        let pattern = text.contains(['*', '?', '[', '{']);
        if pattern {
            let refused = |reason| serde::de::Error::custom(format!("not a pattern for file names: {reason}"));
            return glob(&text).map(|set| Self::Pattern(text.into_owned(), set)).map_err(refused);
        }
        FileName::parse(&text).map(Self::Name).map_err(serde::de::Error::custom)
    }
}

/// The greatest number of braces that are open at one place. Braces in brackets, which are literal, count as well.
fn nesting(pattern: &str) -> usize {
    let mut open = 0_usize;
    let mut most = 0_usize;
    for byte in pattern.bytes() {
        match byte {
            b'{' => open = open.saturating_add(1),
            b'}' => open = open.saturating_sub(1),
            _ => {}
        }
        most = most.max(open);
    }
    most
}

#[cfg(test)]
mod tests {
    use super::glob;

    #[test]
    fn patterns_within_the_limits_match_and_others_are_refused_with_the_reason() {
        assert!(glob("models/**/{a,b}*.{json,py}").unwrap().is_match("models/x/a1.json"));
        assert!(!glob("models/*").unwrap().is_match("models/x/y"));
        for n in [9, 300, 2000] {
            let pattern = format!("{}b{}", "{a,".repeat(n), "}".repeat(n));
            let reason = glob(&pattern).unwrap_err();
            assert!(reason.contains("deep") || reason.contains("bytes"), "{n}: {reason}");
        }
        assert!(glob(&"*".repeat(5000)).unwrap_err().contains("5000 bytes"));
        assert!(glob("{a").is_err());
        for class in ["[!a]", "?", "*", "**/", "{*,?}", "[a-z]"] {
            // Any pattern of the greatest length gives a result.
            let _either = glob(&class.repeat(4096 / class.len()));
        }
    }
}
