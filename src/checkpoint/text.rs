//! Escapes strings of a checkpoint, and formats sizes and positions for messages.

use std::fmt::Write as _;

/// Makes a string from a checkpoint safe to print, in at most about `cap` characters.
///
/// Control characters (ESC and line breaks included), bidirectional overrides and other invisible characters become
/// `\u{..}`; `…` marks omitted text.
#[must_use]
pub fn escape(text: &str, cap: usize) -> String {
    let mut out = String::new();
    for (count, c) in text.chars().enumerate() {
        if count >= cap {
            out.push('…');
            break;
        }
        match c {
            '\n' => out.push_str("\\n"),
            '\r' => out.push_str("\\r"),
            '\t' => out.push_str("\\t"),
            c if c.is_control() || is_invisible(c) => {
                // Writing to a String cannot fail.
                let _ = write!(out, "\\u{{{:x}}}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out
}

/// Characters that reorder or hide text: those with the Unicode property `Default_Ignorable_Code_Point`, all of the
/// category Cf, line and paragraph separators, and the Braille pattern without dots. The tests compare it with the tables
/// of the `regex` crate.
const fn is_invisible(c: char) -> bool {
    matches!(c,
        '\u{ad}' | '\u{34f}' | '\u{600}'..='\u{605}' | '\u{61c}' | '\u{6dd}' | '\u{70f}' | '\u{890}'..='\u{891}'
        | '\u{8e2}' | '\u{115f}'..='\u{1160}' | '\u{17b4}'..='\u{17b5}' | '\u{180b}'..='\u{180f}'
        | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{2800}' | '\u{3164}'
        | '\u{fe00}'..='\u{fe0f}' | '\u{feff}' | '\u{ffa0}' | '\u{fff0}'..='\u{fffb}' | '\u{110bd}' | '\u{110cd}'
        | '\u{13430}'..='\u{1343f}' | '\u{1bca0}'..='\u{1bca3}' | '\u{1d173}'..='\u{1d17a}'
        | '\u{e0000}'..='\u{e0fff}')
}

/// A size in decimal units, three digits: `8.06 GB`.
#[must_use]
pub fn file_size(n: u64) -> String {
    const UNITS: [(&str, u64); 5] = [
        ("PB", 1_000_000_000_000_000),
        ("TB", 1_000_000_000_000),
        ("GB", 1_000_000_000),
        ("MB", 1_000_000),
        ("kB", 1_000),
    ];
    let Some((unit, size)) = UNITS.into_iter().find(|(_, size)| n >= *size) else {
        return format!("{n} B");
    };
    let size = u128::from(size);
    let hundredths = u128::from(n).saturating_mul(100).saturating_add(size / 2).checked_div(size).unwrap_or_default();
    let (whole, rest) = (hundredths / 100, hundredths % 100);
    if whole >= 100 {
        format!("{whole} {unit}")
    } else if whole >= 10 {
        format!("{whole}.{} {unit}", rest / 10)
    } else {
        format!("{whole}.{rest:02} {unit}")
    }
}

/// Line and column of a byte offset, both from 1; the column counts characters.
///
/// An offset past the end counts as the end; an offset inside a character counts as the start of that character.
#[must_use]
pub fn line_column(text: &str, offset: usize) -> (usize, usize) {
    let mut offset = offset.min(text.len());
    while !text.is_char_boundary(offset) {
        offset = offset.saturating_sub(1);
    }
    let before = text.get(..offset).unwrap_or_default();
    let line = before.bytes().filter(|b| *b == b'\n').count().saturating_add(1);
    let start = before.rfind('\n').map_or(0, |at| at.saturating_add(1));
    let column = before.get(start..).map_or(0, |t| t.chars().count()).saturating_add(1);
    (line, column)
}

/// Bytes in lower-case hexadecimal.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    let mut out = String::with_capacity(bytes.len().saturating_mul(2));
    for byte in bytes {
        // Writing to a String cannot fail.
        let _ = write!(out, "{byte:02x}");
    }
    out
}

#[cfg(test)]
mod tests {
    use regex::Regex;

    use super::escape;

    /// The tables of another program decide which characters are invisible.
    #[test]
    fn every_invisible_character_is_escaped() {
        let invisible = Regex::new(r"^[\p{Default_Ignorable_Code_Point}\p{Cc}\p{Cf}\p{Zl}\p{Zp}\u{2800}]$").unwrap();
        let mut text = [0; 4];
        for c in (0..=u32::from(char::MAX)).filter_map(char::from_u32) {
            let text = &*c.encode_utf8(&mut text);
            assert_eq!(escape(text, 1) != text, invisible.is_match(text), "U+{:04X}", u32::from(c));
        }
    }
}
