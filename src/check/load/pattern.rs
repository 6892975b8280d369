//! Regular expressions of the loader, searched for as Python's `re.search` does.
//!
//! The patterns are the library's own, the names are a stranger's: backtracking is bounded, and a search that
//! reaches the bound counts as no match.

use std::ops::Range;

use fancy_regex::RegexBuilder;

/// Steps of backtracking for one name; the longest pattern of transformers 5.23.0 takes some hundred.
const BACKTRACKS: usize = 10_000;

/// Longest name that is searched, in bytes, several times that of any published tensor; a search takes time in the square of
/// it.
const LONGEST: usize = 512;

/// What stands at the end of a pattern whose match ends with a word.
pub(super) const NAME_ENDS: &str = r"(?!\w)";

/// A pattern of characters that stand for themselves, `.`, and at most one `.*`: most of them are. A large model has a name
/// for each of its experts, and a regular expression takes ten times as long for it.
#[derive(Debug)]
pub(super) struct Simple {
    /// Whether a match starts where the name does.
    starts: bool,
    /// Up to the `.*`, or the whole; `None` is any character.
    first: Vec<Option<u8>>,
    /// After the `.*`.
    last: Option<Vec<Option<u8>>>,
    /// Whether no word goes on after a match.
    ends: bool,
}

impl Simple {
    /// `None` for a pattern with anything else.
    pub(super) fn new(text: &str) -> Option<Self> {
        let (text, ends) = text.strip_suffix(NAME_ENDS).map_or((text, false), |text| (text, true));
        let (text, starts) = text.strip_prefix('^').map_or((text, false), |text| (text, true));
        let mut runs = text.split(".*").map(Self::run);
        let (first, last, more) = (runs.next()??, runs.next(), runs.next());
        let last = match last {
            Some(run) => Some(run?),
            None => None,
        };
        more.is_none().then_some(Self { starts, first, last, ends })
    }

    fn run(text: &str) -> Option<Vec<Option<u8>>> {
        let mut rest = text.bytes();
        let mut run = Vec::new();
        while let Some(byte) = rest.next() {
            run.push(match byte {
                b'.' => None,
                b'\\' => Some(rest.next().filter(u8::is_ascii_punctuation)?),
                b'_' | b'-' => Some(byte),
                _ if byte.is_ascii_alphanumeric() => Some(byte),
                _ => return None,
            });
        }
        Some(run)
    }

    /// Whether a name is one that `find` reads: of another one a character may be several bytes, or a line may end in it.
    pub(super) fn reads(name: &str) -> bool {
        name.len() <= LONGEST && name.is_ascii() && !name.contains('\n')
    }

    /// The first match, as a search for the regular expression finds it.
    pub(super) fn find(&self, name: &str) -> Option<Range<usize>> {
        let name = name.as_bytes();
        let ends = |at: usize| !self.ends || !name.get(at).is_some_and(|b| b.is_ascii_alphanumeric() || *b == b'_');
        let fits = |run: &[Option<u8>], at: usize| {
            let end = at.checked_add(run.len())?;
            let there = name.get(at..end)?;
            run.iter().zip(there).all(|(wanted, byte)| wanted.is_none_or(|w| w == *byte)).then_some(end)
        };
        let starts = 0..=if self.starts { 0 } else { name.len() };
        let Some(last) = &self.last else {
            return starts.into_iter().find_map(|at| Some(at..fits(&self.first, at).filter(|end| ends(*end))?));
        };
        // What can end a later match can end the first one too, and the last of the ends is taken.
        let (start, next) = starts.into_iter().find_map(|at| Some((at, fits(&self.first, at)?)))?;
        let end = (next..=name.len()).rev().find_map(|at| fits(last, at).filter(|end| ends(*end)))?;
        Some(start..end)
    }
}

/// A compiled pattern.
#[derive(Debug, Clone)]
pub(super) enum Pattern {
    /// Without a lookaround: several times faster.
    Regular(regex::Regex),
    Backtracking(fancy_regex::Regex),
}

/// The groups of a match; the first is the whole.
pub(super) struct Groups<'n>(Vec<Option<Range<usize>>>, &'n str);

impl<'n> Groups<'n> {
    /// Where the group matched; `None` when it took no part.
    pub(super) fn range(&self, n: usize) -> Option<Range<usize>> {
        self.0.get(n)?.clone()
    }

    /// The text of the group; empty when it took no part.
    pub(super) fn text(&self, n: usize) -> &'n str {
        self.range(n).and_then(|range| self.1.get(range)).unwrap_or_default()
    }
}

impl Pattern {
    /// Python's syntax is that of both crates in all that these patterns use.
    pub(super) fn new(text: &str) -> Option<Self> {
        // The only lookaround of most patterns has another spelling in the crate without lookarounds.
        let regular = regex::Regex::new(&text.replace(NAME_ENDS, r"\b{end-half}")).map(Self::Regular);
        let backtracking = || RegexBuilder::new(text).backtrack_limit(BACKTRACKS).build().map(Self::Backtracking);
        regular.or_else(|_| backtracking()).ok()
    }

    pub(super) fn found_in(&self, name: &str) -> bool {
        name.len() <= LONGEST
            && match self {
                Self::Regular(regex) => regex.is_match(name),
                Self::Backtracking(regex) => regex.is_match(name).unwrap_or(false),
            }
    }

    pub(super) fn captures<'n>(&self, name: &'n str) -> Option<Groups<'n>> {
        self.captures_from(name, 0)
    }

    /// The first match that starts at byte `start` or after.
    fn captures_from<'n>(&self, name: &'n str, start: usize) -> Option<Groups<'n>> {
        if name.len() > LONGEST {
            return None;
        }
        let groups = match self {
            Self::Regular(regex) => {
                let captures = regex.captures_at(name, start)?;
                captures.iter().map(|group| group.map(|found| found.range())).collect()
            }
            Self::Backtracking(regex) => {
                let captures = regex.captures_from_pos(name, start).ok()??;
                captures.iter().map(|group| group.map(|found| found.range())).collect()
            }
        };
        Some(Groups(groups, name))
    }

    /// As Python's `re.sub`: every match replaced, `\1` standing for a group; `None` where nothing matches.
    pub(super) fn replace_all(&self, name: &str, to: &str) -> Option<String> {
        let mut out = String::new();
        // End of the last match, and the place where the next may start.
        let (mut end, mut next) = (0, 0);
        let mut found = false;
        while let Some(groups) = name.get(next..).and_then(|_| self.captures_from(name, next)) {
            let whole = groups.range(0)?;
            found = true;
            out.push_str(name.get(end..whole.start)?);
            out.push_str(&(1..10).fold(to.to_owned(), |text, n| text.replace(&format!(r"\{n}"), groups.text(n))));
            end = whole.end;
            // After an empty match the search goes on at the next character.
            next = if whole.is_empty() { name.ceil_char_boundary(end.saturating_add(1)) } else { end };
            if whole.is_empty() && end >= name.len() {
                break;
            }
        }
        out.push_str(name.get(end..)?);
        found.then_some(out)
    }

    /// Number of the group of this name.
    pub(super) fn group(&self, name: &str) -> Option<usize> {
        match self {
            Self::Regular(regex) => regex.capture_names().position(|group| group == Some(name)),
            Self::Backtracking(regex) => regex.capture_names().position(|group| group == Some(name)),
        }
    }
}

/// A text that every match of a regular expression contains: its longest run of characters that stand for themselves. `None`
/// without one, or for an expression with alternatives, classes, or groups that are optional or look around.
pub(super) fn contained(text: &str) -> Option<String> {
    let longer = |one: String, other: String| if other.len() > one.len() { other } else { one };
    let (mut longest, mut run) = (String::new(), String::new());
    let mut depth = 0_usize;
    let mut rest = text.chars().peekable();
    while let Some(c) = rest.next() {
        let literal = match c {
            '|' | '[' => return None,
            '\\' => rest.next().filter(char::is_ascii_punctuation),
            '.' | '^' | '$' | '+' => None,
            '*' | '?' | '{' => {
                // The character before need not be there.
                run.pop();
                if c == '{' {
                    rest.by_ref().find(|c| *c == '}');
                }
                None
            }
            '(' => {
                depth = depth.checked_add(1)?;
                if rest.peek() == Some(&'?') {
                    return None;
                }
                None
            }
            ')' => {
                depth = depth.checked_sub(1)?;
                if rest.peek().is_some_and(|c| matches!(c, '*' | '?' | '{')) {
                    return None;
                }
                None
            }
            other => Some(other),
        };
        match literal {
            Some(c) => run.push(c),
            None => longest = longer(longest, std::mem::take(&mut run)),
        }
    }
    longest = longer(longest, run);
    (!longest.is_empty()).then_some(longest)
}

/// Drops the names that one of the patterns is found in.
pub(super) fn ignore(names: &mut Vec<String>, patterns: &[String]) {
    let patterns: Vec<Pattern> = patterns.iter().filter_map(|text| Pattern::new(text)).collect();
    if !patterns.is_empty() {
        names.retain(|name| !patterns.iter().any(|p| p.found_in(name)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_match_contains_the_text() {
        for (pattern, names, text) in [
            (r"\.attn\.(q|k)", &[".attn.q"][..], None),
            (r"^model\.", &["model.x"], Some("model.")),
            (r"LayerNorm.gamma", &["LayerNorm.gamma", "LayerNorm_gamma"], Some("LayerNorm")),
            (r"abc*", &["ab", "abcc"], Some("ab")),
            (r"abc+d", &["abccd"], Some("abc")),
            (r"abc?de", &["abde", "abcde"], Some("ab")),
            (r"ab{0,2}cde", &["acde", "abbcde"], Some("cde")),
            (r"layers\.(\d+)\.mlp", &["layers.10.mlp"], Some("layers.")),
            (r"a(bcd)?", &["a", "abcd"], None),
            (r"a(bcd)ef", &["abcdef"], Some("bcd")),
            (r"[ab]cdef", &["acdef"], None),
            (r"(?:a)bc", &["abc"], None),
            (r"\w+", &["a"], None),
        ] {
            let found = contained(pattern);
            assert_eq!(found.as_deref(), text, "{pattern}");
            let compiled = Pattern::new(pattern).expect("a pattern");
            for name in names {
                assert!(compiled.found_in(name), "{pattern} {name}");
                assert!(found.as_ref().is_none_or(|text| name.contains(text)), "{pattern} {name}");
            }
        }
    }
}
