//! The data files in `rules/`: embedded in the program, parsed as JSON5.

use include_dir::{Dir, include_dir};
use serde::de::DeserializeOwned;

use super::expression::{compiled_at_once, compiled_when_needed};

static RULES: Dir<'static> = include_dir!("$CARGO_MANIFEST_DIR/rules");

/// A data file that is not what it should be.
#[derive(Debug, thiserror::Error)]
#[error("{file}: {reason}")]
pub struct DataError {
    file: String,
    reason: String,
}

impl DataError {
    /// An error in `file`.
    #[must_use]
    pub fn new(file: &str, reason: impl Into<String>) -> Self {
        Self { file: file.to_owned(), reason: reason.into() }
    }
}

/// Nesting that a data file may have. The json5 crate recurses without a limit of its own.
const MAX_DEPTH: usize = 64;

/// Parses a JSON5 file of ours or of a user's, its expressions included.
///
/// # Errors
/// [`DataError`] with the parser's line and column.
pub fn parse<T: DeserializeOwned>(path: &str, text: &str) -> Result<T, DataError> {
    compiled_at_once(|| read(path, text))
}

/// Parses a file that is in the program: its expressions are known to be right, and compiled when they are needed.
///
/// # Errors
/// As [`parse`], expressions aside.
pub fn parse_embedded<T: DeserializeOwned>(path: &str, text: &str) -> Result<T, DataError> {
    compiled_when_needed(|| read(path, text))
}

fn read<T: DeserializeOwned>(path: &str, text: &str) -> Result<T, DataError> {
    let deepest = text
        .bytes()
        .scan(0_usize, |depth, b| {
            match b {
                b'{' | b'[' => *depth = depth.saturating_add(1),
                b'}' | b']' => *depth = depth.saturating_sub(1),
                _ => {}
            }
            Some(*depth)
        })
        .max();
    if deepest.is_some_and(|d| d > MAX_DEPTH) {
        return Err(DataError::new(path, format!("nested deeper than {MAX_DEPTH} levels")));
    }
    json5::from_str(text).map_err(|e| DataError::new(path, e.to_string()))
}

/// The `.json5` files below `rules/<folder>`, in path order.
#[must_use]
pub fn embedded(folder: &str) -> Vec<(String, &'static str)> {
    fn walk(dir: &'static Dir<'static>, out: &mut Vec<(String, &'static str)>) {
        for file in dir.files() {
            let path = file.path().to_string_lossy();
            if path.ends_with(".json5")
                && let Some(text) = file.contents_utf8()
            {
                out.push((format!("rules/{path}"), text));
            }
        }
        for sub in dir.dirs() {
            walk(sub, out);
        }
    }
    let mut out = Vec::new();
    if let Some(dir) = RULES.get_dir(folder) {
        walk(dir, &mut out);
    }
    out.sort_by(|a, b| a.0.cmp(&b.0));
    out
}

/// One embedded file, such as an alias module of a recipe.
#[must_use]
pub fn text(path: &str) -> Option<&'static str> {
    RULES.get_file(path)?.contents_utf8()
}
