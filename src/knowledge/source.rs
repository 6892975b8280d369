//! The data files in `rules/`: embedded in the program, parsed as JSON5.

use include_dir::{Dir, include_dir};
use serde::de::DeserializeOwned;

use super::expression::{compiled_at_once, compiled_when_needed};
use crate::checkpoint::line_column;

static RULES: Dir<'static> = include_dir!("$CARGO_MANIFEST_DIR/rules");

/// A data file that is not what it should be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{file}{}: {reason}", .place.map_or_else(String::new, |(line, column)| format!(":{line}:{column}")))]
pub struct DataError {
    file: String,
    /// Line and column, from 1.
    place: Option<(usize, usize)>,
    reason: String,
}

impl DataError {
    /// An error in `file`.
    #[must_use]
    pub fn new(file: &str, reason: impl Into<String>) -> Self {
        Self { file: file.to_owned(), place: None, reason: reason.into() }
    }

    /// An error in `file` about a word of its `text`.
    #[must_use]
    pub fn about(file: &str, text: &str, word: &str, reason: impl Into<String>) -> Self {
        let quoted = |quote: char| text.find(&format!("{quote}{word}{quote}"));
        let found = quoted('"').or_else(|| quoted('\'')).or_else(|| text.find(word));
        let place = found.map(|at| line_column(text, at));
        Self { place, ..Self::new(file, reason) }
    }
}

/// Nesting that a data file may have. The json5 crate recurses without a limit of its own, and a stack that overflows
/// takes the program with it.
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
    if depth(text) > MAX_DEPTH {
        return Err(DataError::new(path, format!("nested deeper than {MAX_DEPTH} levels")));
    }
    json5::from_str(text).map_err(|error| {
        let place = error.position().map(|at| (at.line.saturating_add(1), at.column.saturating_add(1)));
        let said = error.to_string();
        let cause = place.and_then(|_| said.rsplit_once(" at ")).map_or(said.as_str(), |(cause, _)| cause);
        DataError { file: path.to_owned(), place, reason: plainly(cause) }
    })
}

/// How deep brackets nest, those in strings and comments aside: there they could hide that others nest deeper.
fn depth(text: &str) -> usize {
    let (mut open, mut deepest) = (0_usize, 0_usize);
    let mut rest = text.chars().peekable();
    while let Some(c) = rest.next() {
        match c {
            '{' | '[' => open = open.saturating_add(1),
            '}' | ']' => open = open.saturating_sub(1),
            '"' | '\'' => {
                while let Some(inner) = rest.next().filter(|inner| *inner != c) {
                    if inner == '\\' {
                        rest.next();
                    }
                }
            }
            '/' if rest.peek() == Some(&'/') => {
                // Every line terminator that JSON5 has ends a comment.
                rest.by_ref().find(|c| matches!(c, '\n' | '\r' | '\u{2028}' | '\u{2029}'));
            }
            '/' if rest.peek() == Some(&'*') => {
                rest.next();
                while rest.by_ref().any(|c| c == '*') && rest.peek().is_some_and(|c| *c != '/') {}
                rest.next();
            }
            _ => {}
        }
        deepest = deepest.max(open);
    }
    deepest
}

/// serde's words for a key that there is not, in ours: with the nearest one there is.
fn plainly(cause: &str) -> String {
    let quoted: Vec<&str> = cause.split('`').skip(1).step_by(2).collect();
    match (cause.starts_with("unknown field "), cause.starts_with("unknown variant "), quoted.split_first()) {
        (true, _, Some((key, known))) => format!("there is no key `{key}`; {}", instead(key, known)),
        (_, true, Some((word, known))) => format!("`{word}` is not a word for this; {}", instead(word, known)),
        _ => cause.strip_prefix("missing field").map_or_else(|| cause.to_owned(), |key| format!("missing key{key}")),
    }
}

fn instead(word: &str, known: &[&str]) -> String {
    match nearest(word, known.iter().copied()) {
        Some(near) => format!("did you mean `{near}`?"),
        None => format!("known are {}", known.join(", ")),
    }
}

/// Likeness, from 0 to 1, from which a word is offered instead of a misspelt one.
const NEAR: f64 = 0.75;

/// The known word that is most like `word`, when one is like it at all.
#[must_use]
pub fn nearest<'w>(word: &str, known: impl IntoIterator<Item = &'w str>) -> Option<&'w str> {
    let likeness = |other: &str| strsim::jaro_winkler(&word.to_ascii_lowercase(), &other.to_ascii_lowercase());
    let best = known.into_iter().map(|w| (likeness(w), w)).max_by(|a, b| a.0.total_cmp(&b.0));
    best.filter(|(likeness, _)| *likeness > NEAR).map(|(_, word)| word)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Sample {
        #[allow(dead_code, reason = "its name is what is tested")]
        summary: serde_json::Value,
    }

    fn refused(text: &str) -> String {
        parse::<Sample>("a.json5", text).err().map_or_else(String::new, |e| e.to_string())
    }

    #[test]
    fn an_error_names_its_place_and_the_nearest_key() {
        assert_eq!(refused("{\n  sumary: 1,\n}"), "a.json5:2:3: there is no key `sumary`; did you mean `summary`?");
        assert_eq!(refused("{ qqq: 1 }"), "a.json5:1:3: there is no key `qqq`; known are summary");
        assert_eq!(refused("{ summary: }"), "a.json5:1:12: expected value");
        assert!(refused("{}").contains("missing key `summary`"), "{}", refused("{}"));
        let about = DataError::about("a.json5", "{\n x: ['IDX']}", "IDX", "no");
        assert_eq!(about.to_string(), "a.json5:2:6: no");
    }

    /// What hides brackets from a count of bytes hides them from the parser too.
    #[test]
    fn depth_is_bounded_whatever_stands_between_the_brackets() {
        for between in ["", "'}',", "\"}\\\"}\",", "/*}*/", "/*}**}/*/", "//}\n", "/*/}*/", "/*}*///}\n", "'\\'}',"] {
            let text = format!("[{between}").repeat(100_000);
            assert_eq!(refused(&text), "a.json5: nested deeper than 64 levels", "{between}");
        }
        assert_eq!(depth("{a: [1, '[[['] /* [[ */, b: {}} // [[["), 2);
    }
}
