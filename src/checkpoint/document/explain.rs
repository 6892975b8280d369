//! Explains why a text is not JSON, for causes larger than a slip.

use std::ops::Range;

/// Conflict markers of an unresolved merge in version control.
pub(super) fn conflict_markers(text: &str) -> Vec<(Range<usize>, &'static str)> {
    const MARKERS: [&str; 4] = ["<<<<<<<", "|||||||", "=======", ">>>>>>>"];
    let mut found = Vec::new();
    let mut at = 0_usize;
    for line in text.split_inclusive('\n') {
        let body = line.trim_end();
        if let Some(marker) =
            MARKERS.into_iter().find(|m| body == *m || body.strip_prefix(m).is_some_and(|r| r.starts_with(' ')))
        {
            found.push((at..at.saturating_add(body.len()), marker));
        }
        at = at.saturating_add(line.len());
    }
    found
}

/// Replaces these ranges with spaces, so that all other bytes keep their offsets.
pub(super) fn blank(text: &str, ranges: &[(Range<usize>, &'static str)]) -> String {
    let mut out = String::with_capacity(text.len());
    let mut from = 0;
    for (range, _) in ranges {
        out.push_str(text.get(from..range.start).unwrap_or_default());
        out.extend(std::iter::repeat_n(' ', range.len()));
        from = range.end;
    }
    out.push_str(text.get(from..).unwrap_or_default());
    out
}

/// The section name, when `text` begins with a section of an INI file (`[http]`, then settings).
pub(super) fn ini_section(text: &str) -> Option<&str> {
    let mut lines = text.trim_start().lines();
    let name = lines.next()?.trim_end().strip_prefix('[')?.strip_suffix(']')?;
    let plain = |c: char| c.is_alphanumeric() || matches!(c, ' ' | '"' | '.' | '-' | '_' | '/' | ':');
    let starts_well = name.starts_with(|c: char| c.is_alphabetic());
    let setting = lines.map(str::trim).find(|l| !l.is_empty()).is_none_or(|l| l.contains('=') || l.starts_with('['));
    (starts_well && setting && name.chars().all(plain)).then_some(name)
}

/// Describes the text after the end of a document's value.
pub(super) fn trailing(text: &str) -> &'static str {
    match text.trim_start().chars().next() {
        Some('{' | '[') => "a second JSON value",
        Some('}' | ']') => "an extra closing bracket",
        Some(',') => "a comma",
        Some('\0') => "NUL bytes",
        _ => "other text",
    }
}
