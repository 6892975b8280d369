//! Regular expressions of the loader, searched for as Python's `re.search` does.
//!
//! The patterns are the library's own, the names are a stranger's: backtracking is bounded, and a search that
//! reaches the bound counts as no match.

use fancy_regex::{Captures, Regex, RegexBuilder};

/// Steps of backtracking for one name; the longest pattern of transformers 5.23.0 takes some hundred.
const BACKTRACKS: usize = 10_000;

/// Longest name that is searched, in bytes, several times that of any published tensor; a search takes time in the square of
/// it.
const LONGEST: usize = 512;

/// A compiled pattern.
#[derive(Debug, Clone)]
pub(super) struct Pattern(Regex);

impl Pattern {
    /// Python's syntax is fancy-regex's in all that these patterns use.
    pub(super) fn new(text: &str) -> Option<Self> {
        RegexBuilder::new(text).backtrack_limit(BACKTRACKS).build().ok().map(Self)
    }

    pub(super) fn found_in(&self, name: &str) -> bool {
        name.len() <= LONGEST && self.0.is_match(name).unwrap_or(false)
    }

    pub(super) fn captures<'n>(&self, name: &'n str) -> Option<Captures<'n, str>> {
        if name.len() <= LONGEST { self.0.captures(name).ok().flatten() } else { None }
    }

    /// As Python's `re.sub`: every match replaced, `\1` standing for a group; `None` where nothing matches.
    pub(super) fn replace_all(&self, name: &str, to: &str) -> Option<String> {
        if name.len() > LONGEST {
            return None;
        }
        let mut out = String::new();
        let mut end = 0;
        for captures in self.0.captures_iter(name) {
            let Ok(captures) = captures else { break };
            let whole = captures.get(0)?;
            out.push_str(name.get(end..whole.start())?);
            let group = |n: usize| captures.get(n).map_or("", |m| m.as_str());
            out.push_str(&(1..10).fold(to.to_owned(), |text, n| text.replace(&format!(r"\{n}"), group(n))));
            end = whole.end();
        }
        if end == 0 && out.is_empty() && !self.found_in(name) {
            return None;
        }
        out.push_str(name.get(end..)?);
        Some(out)
    }

    /// Number of the group of this name.
    pub(super) fn group(&self, name: &str) -> Option<usize> {
        self.0.capture_names().position(|group| group == Some(name))
    }
}

/// Drops the names that one of the patterns is found in.
pub(super) fn ignore(names: &mut Vec<String>, patterns: &[String]) {
    let patterns: Vec<Pattern> = patterns.iter().filter_map(|text| Pattern::new(text)).collect();
    if !patterns.is_empty() {
        names.retain(|name| !patterns.iter().any(|p| p.found_in(name)));
    }
}
