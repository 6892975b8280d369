//! The data files in `rules/`, which are embedded in the program, and those of users: both are JSON5.

use std::borrow::Cow;
use std::cmp::Ordering;

use include_dir::{Dir, include_dir};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::expression::{compile_eagerly, compile_lazily};
use crate::checkpoint::line_column;

/// The files of `rules/`, all but recipes as JSON: the build script writes them.
static RULES: Dir<'static> = include_dir!("$OUT_DIR/rules");

/// A malformed data file.
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

    /// An error in `file` at a line and column, from 1.
    #[must_use]
    pub fn at(file: &str, place: (usize, usize), reason: impl Into<String>) -> Self {
        Self { place: Some(place), ..Self::new(file, reason) }
    }

    /// An error in `file` at the first occurrence of `word` in `text`.
    #[must_use]
    pub fn about(file: &str, text: &str, word: &str, reason: impl Into<String>) -> Self {
        let quoted = |quote: char| text.find(&format!("{quote}{word}{quote}"));
        let found = quoted('"').or_else(|| quoted('\'')).or_else(|| text.find(word));
        let place = found.map(|at| line_column(text, at));
        Self { place, ..Self::new(file, reason) }
    }

    /// An error in `file` at the first member `key` of `text` whose value is the string `word`, or else as [`Self::about`].
    #[must_use]
    pub fn about_value(file: &str, text: &str, key: &str, word: &str, reason: impl Into<String>) -> Self {
        Self::about_nth_value(file, text, key, word, 0, reason)
    }

    /// As [`Self::about_value`], at a member with `before` of the same key and value before it.
    #[must_use]
    pub fn about_nth_value(
        file: &str,
        text: &str,
        key: &str,
        word: &str,
        before: usize,
        reason: impl Into<String>,
    ) -> Self {
        let quoted = serde_json::to_string(word).unwrap_or_default();
        let spelled = quoted.get(1..quoted.len().saturating_sub(1)).unwrap_or_default();
        let member = || {
            let string = r#""(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'"#;
            let pattern = format!(r#"(?s)\b{}["']?\s*:\s*({string})"#, regex::escape(key));
            let members = regex::Regex::new(&pattern).ok()?;
            let values = members.captures_iter(text).filter_map(|found| found.get(1));
            let found = values.filter(|value| json5::from_str(value.as_str()) == Ok(word.to_owned())).nth(before)?;
            Some(line_column(text, found.start().saturating_add(1)))
        };
        let other = || Self::about(file, text, if text.contains(word) { word } else { spelled }, "").place;
        let place = member().or_else(other).or_else(|| Self::about(file, text, key, "").place);
        Self { place, ..Self::new(file, reason) }
    }
}

/// Maximum nesting of a data file. The json5 crate recurses without a limit, so deeper nesting could overflow the
/// stack.
const MAX_DEPTH: usize = 64;

/// Parses a JSON5 file, and compiles its expressions at once.
///
/// # Errors
/// [`DataError`] with the parser's line and column.
pub fn parse<T: DeserializeOwned>(path: &str, text: &str) -> Result<T, DataError> {
    compile_eagerly(|| read(path, text))
}

/// As [`parse`], for a built-in recipe: its expressions are compiled at their first evaluation.
///
/// # Errors
/// As [`parse`], except for invalid expressions.
pub fn parse_lazily<T: DeserializeOwned>(path: &str, text: &str) -> Result<T, DataError> {
    compile_lazily(|| read(path, text))
}

/// Parses any other built-in file, which is JSON; its expressions are compiled at their first evaluation.
///
/// # Errors
/// [`DataError`] with the parser's line and column.
pub fn parse_embedded<T: DeserializeOwned>(path: &str, text: &str) -> Result<T, DataError> {
    compile_lazily(|| serde_json::from_str(text)).map_err(|error| DataError::new(path, error.to_string()))
}

/// A string of a data file, borrowed from its text if it has no escapes.
#[derive(Deserialize)]
#[serde(transparent)]
pub(super) struct Text<'t>(#[serde(borrow)] pub(super) Cow<'t, str>);

/// The value in the line of `key`, by bisection: lines of a key, a tab and a value, sorted by their keys.
pub(super) fn line_of<'t>(lines: &'t [u8], key: &str) -> Option<&'t str> {
    bisect(lines, key, "", "\t")
}

/// The value in the line of `key` in sorted lines, each of which has `before`, a key, `between` and a value. Reads the lines
/// that it compares, and of a built-in file only their pages.
pub(super) fn bisect<'t>(lines: &'t [u8], key: &str, before: &str, between: &str) -> Option<&'t str> {
    let (mut start, mut end) = (0, lines.len());
    while start < end {
        let middle = start.midpoint(end);
        let above = lines.get(start..middle)?;
        let from = memchr::memrchr(b'\n', above).map_or(Some(start), |at| start.checked_add(at)?.checked_add(1))?;
        let to = memchr::memchr(b'\n', lines.get(middle..end)?).map_or(Some(end), |at| middle.checked_add(at))?;
        let line = lines.get(from..to)?.strip_prefix(before.as_bytes())?;
        let (found, value) = line.split_at_checked(memchr::memmem::find(line, between.as_bytes())?)?;
        match found.cmp(key.as_bytes()) {
            Ordering::Equal => return std::str::from_utf8(value).ok()?.strip_prefix(between),
            Ordering::Less => start = to.checked_add(1)?,
            Ordering::Greater => end = from,
        }
    }
    None
}

fn read<T: DeserializeOwned>(path: &str, text: &str) -> Result<T, DataError> {
    if depth(text) > MAX_DEPTH {
        return Err(DataError::new(path, format!("nested deeper than {MAX_DEPTH} levels")));
    }
    json5::from_str(text).map_err(|error| {
        let place = error.position().map(|at| (at.line.saturating_add(1), at.column.saturating_add(1)));
        let message = error.to_string();
        let cause = place.and_then(|_| message.rsplit_once(" at ")).map_or(message.as_str(), |(cause, _)| cause);
        DataError { file: path.to_owned(), place, reason: readable_cause(cause) }
    })
}

/// Maximum nesting of brackets, without those in strings and comments, which could hide deeper nesting.
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
                // In JSON5 every line terminator ends a comment.
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

/// Rewrites serde's errors about keys and values, and suggests the nearest valid one.
fn readable_cause(cause: &str) -> String {
    let quoted: Vec<&str> = cause.split('`').skip(1).step_by(2).collect();
    match (cause.starts_with("unknown field "), cause.starts_with("unknown variant "), quoted.split_first()) {
        (true, _, Some((key, known))) => format!("unknown key `{key}`; {}", hint(key, known)),
        (_, true, Some((word, known))) => format!("unknown value `{word}`; {}", hint(word, known)),
        _ => cause.strip_prefix("missing field").map_or_else(|| cause.to_owned(), |key| format!("missing key{key}")),
    }
}

/// `did you mean `near`?`, or the known words if none is similar.
#[must_use]
pub fn hint(word: &str, known: &[&str]) -> String {
    match (nearest(word, known.iter().copied()), known) {
        (Some(near), _) => format!("did you mean `{near}`?"),
        (None, []) => "there is none".to_owned(),
        (None, known) if known.len() > MANY => format!("none of the {} known names is similar", known.len()),
        (None, known) => format!("expected one of {}", known.join(", ")),
    }
}

/// Most words that a hint lists.
const MANY: usize = 40;

/// Lowest similarity, from 0 to 1, of a suggestion.
const NEAR: f64 = 0.75;

/// The known word most similar to `word`; `None` when none is similar.
#[must_use]
pub fn nearest<'w>(word: &str, known: impl IntoIterator<Item = &'w str>) -> Option<&'w str> {
    let likeness = |other: &str| strsim::jaro_winkler(&word.to_ascii_lowercase(), &other.to_ascii_lowercase());
    let best = known.into_iter().map(|w| (likeness(w), w)).max_by(|a, b| a.0.total_cmp(&b.0));
    best.filter(|(likeness, _)| *likeness > NEAR).map(|(_, word)| word)
}

/// The folder of this path below `rules/`; `include_dir` would compare the path with that of every file.
fn folder(path: &str) -> Option<&'static Dir<'static>> {
    let mut here = &RULES;
    for (end, _) in path.match_indices('/').chain([(path.len(), "")]) {
        here = here.dirs().find(|dir| dir.path().to_str() == path.get(..end))?;
    }
    Some(here)
}

/// The `.json5` files below a folder of `rules/`, in path order.
#[must_use]
pub fn embedded(path: &str) -> Vec<(String, &'static str)> {
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
    if let Some(dir) = folder(path) {
        walk(dir, &mut out);
    }
    out.sort_by(|a, b| a.0.cmp(&b.0));
    out
}

/// Stem and bytes of each file in a folder of `rules/` that has this extension with its dot, not in its subfolders.
pub(super) fn embedded_bytes(path: &str, extension: &str) -> impl Iterator<Item = (&'static str, &'static [u8])> {
    let files = folder(path).into_iter().flat_map(Dir::files);
    files.filter_map(move |file| {
        Some((file.path().to_str()?.rsplit('/').next()?.strip_suffix(extension)?, file.contents()))
    })
}

/// Paths below a folder of `rules/` of all files in it and in its subfolders.
#[must_use]
pub fn paths(path: &str) -> Vec<&'static str> {
    let mut pending: Vec<&Dir<'static>> = folder(path).into_iter().collect();
    let mut out = Vec::new();
    while let Some(dir) = pending.pop() {
        let paths = dir.files().filter_map(|file| file.path().to_str());
        out.extend(paths.filter_map(|file| file.strip_prefix(path)?.strip_prefix('/')));
        pending.extend(dir.dirs());
    }
    out.sort_unstable();
    out
}

/// The text of one embedded file, such as a template of a recipe.
#[must_use]
pub fn text(path: &str) -> Option<&'static str> {
    std::str::from_utf8(bytes(path)?).ok()
}

/// The bytes of one embedded file, of which a large one is not read whole to look something up.
pub(super) fn bytes(path: &str) -> Option<&'static [u8]> {
    let dir = path.rsplit_once('/').map_or(Some(&RULES), |(dir, _)| folder(dir))?;
    Some(dir.files().find(|file| file.path().to_str() == Some(path))?.contents())
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
        assert_eq!(refused("{\n  sumary: 1,\n}"), "a.json5:2:3: unknown key `sumary`; did you mean `summary`?");
        assert_eq!(refused("{ qqq: 1 }"), "a.json5:1:3: unknown key `qqq`; expected one of summary");
        assert_eq!(refused("{ summary: }"), "a.json5:1:12: expected value");
        assert!(refused("{}").contains("missing key `summary`"), "{}", refused("{}"));
        let about = DataError::about("a.json5", "{\n x: ['IDX']}", "IDX", "no");
        assert_eq!(about.to_string(), "a.json5:2:6: no");
    }

    #[test]
    fn every_line_is_found_and_no_other() {
        let lines = "a\t1\nb + 1\t2\nb + é\t3\n";
        for (key, value) in [("a", Some("1")), ("b + 1", Some("2")), ("b + é", Some("3")), ("b", None), ("c", None)] {
            assert_eq!(line_of(lines.as_bytes(), key), value, "{key}");
        }
        assert_eq!(line_of(b"", "a"), None);
    }

    /// Strings and comments between the brackets do not hide the nesting.
    #[test]
    fn depth_is_bounded_with_text_between_the_brackets() {
        for between in ["", "'}',", "\"}\\\"}\",", "/*}*/", "/*}**}/*/", "//}\n", "/*/}*/", "/*}*///}\n", "'\\'}',"] {
            let text = format!("[{between}").repeat(100_000);
            assert_eq!(refused(&text), "a.json5: nested deeper than 64 levels", "{between}");
        }
        assert_eq!(depth("{a: [1, '[[['] /* [[ */, b: {}} // [[["), 2);
    }
}
