//! Splices: new text for byte ranges of a text.

use std::ops::Range;

use serde::Serialize;

/// New text for a byte range.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Splice {
    /// Bytes to replace; empty for an insertion.
    pub range: Range<usize>,
    /// The new text.
    pub text: String,
}

impl Splice {
    /// Whether both change the same bytes, or insert at the same offset.
    #[must_use]
    pub fn meets(&self, other: &Self) -> bool {
        let (a, b) = (&self.range, &other.range);
        a.start == b.start || (a.start < b.end && b.start < a.end)
    }
}

/// Applies all splices to the text; `None` when one lies outside it or two of them meet.
#[must_use]
pub fn spliced(text: &str, splices: &[Splice]) -> Option<String> {
    let mut sorted: Vec<&Splice> = splices.iter().collect();
    sorted.sort_by_key(|s| s.range.start);
    if sorted.windows(2).any(|pair| matches!(pair, [a, b] if a.meets(b))) {
        return None;
    }
    let mut out = String::with_capacity(text.len());
    let mut at = 0;
    for splice in sorted {
        out.push_str(text.get(at..splice.range.start)?);
        out.push_str(&splice.text);
        text.get(splice.range.clone())?;
        at = splice.range.end;
    }
    out.push_str(text.get(at..)?);
    Some(out)
}
