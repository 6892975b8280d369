//! Finds places in a text: the byte range of a value, the line of a byte.

use std::collections::HashMap;
use std::ops::Range;

use super::Document;
use crate::checkpoint::pointer;
use crate::checkpoint::scan::{Scanner, Token};

/// Finds many places in one text. Each container on the way is scanned once, and line breaks are counted once. Without
/// this, a hundred findings in a one-line document of fifty megabytes would scan it some thousand times.
#[derive(Debug)]
pub struct Locator<'t> {
    text: &'t str,
    /// Large containers that are skipped without a scan.
    known: &'t [Range<usize>],
    /// Members of the containers scanned so far, by the offset of the container.
    containers: HashMap<usize, LocatedMembers>,
    /// Line number, start of the line, and characters since then, for every [`STRIDE`] bytes.
    lines: Vec<Mark>,
}

/// Byte ranges of a member.
#[derive(Debug, Clone)]
struct MemberSpans {
    key: Option<Range<usize>>,
    value: Range<usize>,
}

#[derive(Debug)]
enum LocatedMembers {
    /// By key; of duplicate keys the last.
    Object(HashMap<String, MemberSpans>),
    Array(Vec<Range<usize>>),
}

/// Line and column at one byte of the text.
#[derive(Debug, Clone, Copy, Default)]
struct Mark {
    line_breaks: usize,
    /// Characters since the last line break.
    characters: usize,
}

/// Bytes from one mark to the next.
const STRIDE: usize = 4096;

impl<'t> Locator<'t> {
    /// A locator for `text`; scans nothing yet.
    #[must_use]
    pub fn new(text: &'t str) -> Self {
        Self { text, known: &[], containers: HashMap::new(), lines: Vec::new() }
    }

    /// A locator for the text of a document; `None` when the document has none.
    #[must_use]
    pub fn of(document: &'t Document) -> Option<Self> {
        Some(Self { known: &document.left_out, ..Self::new(document.text.as_deref()?) })
    }

    /// Byte range of the value at a JSON pointer.
    pub fn value(&mut self, pointer: &str) -> Option<Range<usize>> {
        self.find(pointer).map(|found| found.value)
    }

    /// Byte range of the key, quotes included, for the last step of a JSON pointer.
    pub fn key(&mut self, pointer: &str) -> Option<Range<usize>> {
        self.find(pointer)?.key
    }

    /// Line and column of a byte offset, as [`line_column`](crate::checkpoint::line_column) counts them.
    pub fn line_column(&mut self, offset: usize) -> (usize, usize) {
        if self.lines.is_empty() {
            self.lines = marks(self.text);
        }
        let bytes = self.text.as_bytes();
        let offset = self.text.floor_char_boundary(offset.min(bytes.len()));
        let at = offset.checked_div(STRIDE).unwrap_or(0);
        let mark = self.lines.get(at).copied().unwrap_or_default();
        let between = bytes.get(at.saturating_mul(STRIDE)..offset).unwrap_or_default();
        let mark = mark.after(between);
        (mark.line_breaks.saturating_add(1), mark.characters.saturating_add(1))
    }

    fn find(&mut self, pointer: &str) -> Option<MemberSpans> {
        let start = if self.text.starts_with('\u{feff}') { '\u{feff}'.len_utf8() } else { 0 };
        let mut found: Option<MemberSpans> = None;
        for step in pointer::steps(pointer)? {
            let start = found.map_or(start, |f| f.value.start);
            if !self.containers.contains_key(&start) {
                self.containers.insert(start, members(self.scanner(start))?);
            }
            found = Some(match self.containers.get(&start)? {
                LocatedMembers::Object(members) => members.get(&step)?.clone(),
                LocatedMembers::Array(items) => {
                    MemberSpans { key: None, value: items.get(step.parse::<usize>().ok()?)?.clone() }
                }
            });
        }
        found.or_else(|| Some(MemberSpans { key: None, value: value_at(self.scanner(start))? }))
    }

    fn scanner(&self, start: usize) -> Scanner<'t> {
        Scanner::lenient(self.text, start).knowing(self.known)
    }
}

impl Mark {
    /// The mark after these bytes of UTF-8.
    fn after(self, bytes: &[u8]) -> Self {
        let line = memchr::memrchr(b'\n', bytes);
        let breaks = memchr::memchr_iter(b'\n', bytes).count();
        let rest = line.map_or(bytes, |at| bytes.get(at.saturating_add(1)..).unwrap_or_default());
        // Bytes 0x80 to 0xbf continue a character; all others begin one.
        let characters = rest.iter().filter(|b| (**b & 0xc0) != 0x80).count();
        Self {
            line_breaks: self.line_breaks.saturating_add(breaks),
            characters: if line.is_some() { characters } else { self.characters.saturating_add(characters) },
        }
    }
}

fn marks(text: &str) -> Vec<Mark> {
    let mut mark = Mark::default();
    let mut marks = vec![mark];
    for bytes in text.as_bytes().chunks(STRIDE) {
        mark = mark.after(bytes);
        marks.push(mark);
    }
    marks
}

/// Bytes of the next value.
pub(super) fn value_at(mut scanner: Scanner<'_>) -> Option<Range<usize>> {
    let (token, span) = scanner.next().ok()??;
    scanner.skip_rest_of(&token).ok()?;
    Some(span.start..scanner.position())
}

/// The members of the container that comes next.
fn members(mut scanner: Scanner<'_>) -> Option<LocatedMembers> {
    match scanner.next().ok()??.0 {
        Token::BeginObject => {
            let mut members = HashMap::new();
            loop {
                let (Token::Key(key), span) = scanner.next().ok()?? else {
                    return Some(LocatedMembers::Object(members));
                };
                let (first, value) = scanner.next().ok()??;
                scanner.skip_rest_of(&first).ok()?;
                let found = MemberSpans { key: Some(span), value: value.start..scanner.position() };
                members.insert(key.decode().0.into_owned(), found);
            }
        }
        Token::BeginArray => {
            let mut items = Vec::new();
            loop {
                let (first, span) = scanner.next().ok()??;
                if first == Token::EndArray {
                    return Some(LocatedMembers::Array(items));
                }
                scanner.skip_rest_of(&first).ok()?;
                items.push(span.start..scanner.position());
            }
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::Locator;
    use crate::checkpoint::line_column;

    #[test]
    fn lines_are_counted_as_in_one_go() {
        let text = "é\n日本語\r\n\n".repeat(1500) + &"ü".repeat(9000);
        let mut locator = Locator::new(&text);
        for offset in (0..text.len() + 3).step_by(7) {
            assert_eq!(locator.line_column(offset), line_column(&text, offset), "{offset}");
        }
    }
}
