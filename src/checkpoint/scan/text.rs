//! Strings of a JSON text, and their escapes.

use std::borrow::Cow;

/// A string of the text as written, without its quotes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct JsonString<'a> {
    pub(super) raw: &'a str,
    pub(super) escaped: bool,
}

impl<'a> JsonString<'a> {
    /// The unescaped string, and whether it contained an unpaired surrogate (replaced by U+FFFD).
    pub(crate) fn decode(self) -> (Cow<'a, str>, bool) {
        if self.escaped { unescape(self.raw) } else { (Cow::Borrowed(self.raw), false) }
    }
}

/// Resolves escapes that the scanner has accepted.
fn unescape(raw: &str) -> (Cow<'_, str>, bool) {
    let mut out = String::with_capacity(raw.len());
    let mut lone = false;
    let mut rest = raw;
    while let Some(at) = rest.find('\\') {
        out.push_str(rest.get(..at).unwrap_or_default());
        let escape = rest.get(at.saturating_add(1)..).unwrap_or_default();
        let mut used = 1;
        match escape.as_bytes().first() {
            Some(b'n') => out.push('\n'),
            Some(b't') => out.push('\t'),
            Some(b'r') => out.push('\r'),
            Some(b'b') => out.push('\u{8}'),
            Some(b'f') => out.push('\u{c}'),
            Some(b'u') => {
                let high = hex4(escape, 1);
                let low = if escape.get(5..7) == Some("\\u") { hex4(escape, 7) } else { None };
                used = 5;
                match (high, low) {
                    (Some(h @ 0xd800..=0xdbff), Some(l @ 0xdc00..=0xdfff)) => {
                        used = 11;
                        out.extend(char::decode_utf16([h, l]).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)));
                    }
                    (Some(unit), _) => {
                        let c = char::from_u32(unit.into());
                        lone |= c.is_none();
                        out.push(c.unwrap_or(char::REPLACEMENT_CHARACTER));
                    }
                    (None, _) => out.push(char::REPLACEMENT_CHARACTER),
                }
            }
            Some(b) => out.push(char::from(*b)),
            None => used = 0,
        }
        rest = escape.get(used..).unwrap_or_default();
    }
    out.push_str(rest);
    (Cow::Owned(out), lone)
}

fn hex4(text: &str, at: usize) -> Option<u16> {
    u16::from_str_radix(text.get(at..at.checked_add(4)?)?, 16).ok()
}
