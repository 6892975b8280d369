//! Requirement files of pip: `requirements.txt`, `constraints.txt`, and what they include.

use std::borrow::Cow;
use std::collections::{BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

use super::demand::{Demands, parse_requirement_text};
use crate::checkpoint::open::read_capped;
use crate::checkpoint::platform::shown;
use crate::knowledge::source::DataError;

/// Most files of one run: also the greatest depth to which they include each other.
const MAX_FILES: usize = 32;

/// Options that include a file, which follows behind blanks or `=`, and behind a short one also directly.
const INCLUDES: [&str; 4] = ["--requirement", "--constraint", "-r", "-c"];

/// Reads a requirement file and the files that it includes by relative paths, each once, of `cap` bytes together. Called by
/// [`super::read_pins`].
///
/// # Errors
/// A file that cannot be read or is not UTF-8, with the place that includes it; too many files, bytes or demands.
pub fn read(path: &Path, cap: u64, demands: &mut Demands) -> Result<(), DataError> {
    let mut left = cap;
    let mut seen = BTreeSet::new();
    let mut waiting = VecDeque::from([Include { path: path.to_owned(), from: None }]);
    while let Some(next) = waiting.pop_front() {
        // A file that includes itself is read once.
        if !seen.insert(next.path.canonicalize().unwrap_or_else(|_| next.path.clone())) {
            continue;
        }
        if seen.len() > MAX_FILES {
            return Err(
                next.wrong(&format!("more than {MAX_FILES} files include one another; name a version with --for"))
            );
        }
        let bytes = read_capped(&next.path, left)
            .map_err(|error| next.wrong(&format!("{error}; name a version with --for")))?;
        left = left.saturating_sub(u64::try_from(bytes.len()).unwrap_or(u64::MAX));
        let text = String::from_utf8(bytes).map_err(|_| next.wrong("is not UTF-8; save it as UTF-8"))?;
        waiting.extend(next.demands(&text, demands)?);
    }
    Ok(())
}

/// A file to read.
struct Include {
    path: PathBuf,
    /// The file, and the line in it, that includes this one.
    from: Option<(String, usize)>,
}

impl Include {
    /// An error about this file, at the place that includes it.
    fn wrong(&self, reason: &str) -> DataError {
        let name = shown(&self.path);
        let reason = reason.strip_prefix(&name).map_or(reason, str::trim_start);
        match &self.from {
            Some((file, line)) => DataError::at(file, (*line, 1), format!("cannot include {name}: {reason}")),
            None => DataError::new(&name, reason),
        }
    }

    /// Adds what the lines of this file demand; the files that they include.
    fn demands(&self, text: &str, demands: &mut Demands) -> Result<Vec<Self>, DataError> {
        let name = shown(&self.path);
        let mut included = Vec::new();
        let mut lines = (1_usize..).zip(text.strip_prefix('\u{feff}').unwrap_or(text).lines());
        while let Some((at, line)) = logical_line(&mut lines) {
            let line = line.trim();
            if line.is_empty() {
                continue;
            }
            if let Some(file) = included_file(line) {
                if file.contains("://") || Path::new(file).has_root() {
                    demands.not_followed.get_or_insert_with(|| file.to_owned());
                } else {
                    let path = self.path.parent().unwrap_or(Path::new("")).join(file);
                    included.push(Self { path, from: Some((name.clone(), at)) });
                }
                if included.len() > MAX_FILES {
                    return Err(DataError::at(&name, (at, 1), format!("more than {MAX_FILES} files are included")));
                }
            } else if let Some(demand) = parse_requirement_text(line) {
                demands.add(&name, || (at, 1), demand)?;
            }
        }
        Ok(included)
    }
}

/// The file that a line includes.
fn included_file(line: &str) -> Option<&str> {
    let option = INCLUDES.into_iter().find(|option| line.starts_with(option))?;
    let rest = line.strip_prefix(option)?;
    if option.starts_with("--") && !rest.starts_with(['=', ' ', '\t']) {
        return None;
    }
    let file = rest.trim_start_matches(['=', ' ', '\t']);
    let file = file.split(" #").next().unwrap_or_default().trim().trim_matches(['"', '\'']);
    (!file.is_empty()).then_some(file)
}

/// The next line with those that a backslash continues, as pip joins them, and its number. A comment ends a line.
/// Source: `join_lines` of `pip/_internal/req/req_file.py`.
fn logical_line<'t>(lines: &mut impl Iterator<Item = (usize, &'t str)>) -> Option<(usize, Cow<'t, str>)> {
    let (number, first) = lines.next()?;
    let is_comment = |line: &str| line.trim_start().starts_with('#');
    let Some(part) = first.strip_suffix('\\').filter(|_| !is_comment(first)) else {
        return Some((number, Cow::Borrowed(if is_comment(first) { "" } else { first })));
    };
    let mut joined = part.to_owned();
    for (_, line) in lines {
        if is_comment(line) {
            break;
        }
        joined.push_str(line.strip_suffix('\\').unwrap_or(line));
        if !line.ends_with('\\') {
            break;
        }
    }
    Some((number, Cow::Owned(joined)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn lines(text: &str) -> Vec<(usize, String)> {
        let mut lines = (1_usize..).zip(text.lines());
        std::iter::from_fn(|| logical_line(&mut lines).map(|(at, line)| (at, line.into_owned()))).collect()
    }

    #[test]
    fn a_backslash_continues_a_line_and_a_comment_ends_it() {
        let text = "a \\\n  b\\\nc\nd # e \\\nf\n# g \\\nh\ni \\\n # j\nk \\";
        let all = ["a   bc", "d # e f", "", "h", "i ", "k "].map(str::to_owned);
        assert_eq!(lines(text), [1, 4, 6, 7, 8, 10].into_iter().zip(all).collect::<Vec<_>>());
    }

    #[test]
    fn included_files_are_told_from_other_options() {
        for (line, file) in [
            ("-r base.txt", Some("base.txt")),
            ("-rbase.txt", Some("base.txt")),
            ("-c ../constraints.txt  # why", Some("../constraints.txt")),
            ("--requirement=base.txt", Some("base.txt")),
            ("--constraint 'with blank.txt'", Some("with blank.txt")),
            ("--requirements base.txt", None),
            ("--constraint", None),
            ("-r", None),
            ("-e .", None),
            ("ruff", None),
        ] {
            assert_eq!(included_file(line), file, "{line}");
        }
    }

    proptest! {
        #[test]
        fn no_text_panics(text in r#"((-r|-c|transformers|peft|==|4\.57|\[|\]|\(|\)|;|,|#|\\|@|é| |\n|--hash|'|")[ -~]{0,3}){0,40}"#) {
            let mut demands = Demands::default();
            let file = Include { path: PathBuf::from("x.txt"), from: None };
            let included = file.demands(&text, &mut demands);
            prop_assert!(included.is_err() || demands.list.len() <= text.lines().count());
        }
    }
}
