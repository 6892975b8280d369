//! Cuts an excerpt around a place out of a source text.
//!
//! The size of the result is limited: a `tokenizer.json` may have 20 MB on one line.

use std::collections::BTreeSet;
use std::ops::Range;

use super::format::hostile;
use super::model::CheckpointReport;
use crate::check::Location;

/// Bytes kept before the first mark of a long line.
const BEFORE: usize = 60;
/// Bytes kept after the start of the last mark of a long line.
const AFTER: usize = 120;
/// Spans further apart than this, in bytes, get separate excerpts.
const APART: usize = 400;

/// An excerpt of a source with marked ranges, escaped for display.
#[derive(Debug, PartialEq, Eq)]
pub struct Excerpt {
    /// The text; `…` marks the places where a line was cut.
    pub text: String,
    /// Byte ranges in `text`, one per span, each within one line.
    pub marks: Vec<Range<usize>>,
    /// Whether the first line lacks its start.
    pub cut_left: bool,
}

/// Whether a span can share an excerpt with an earlier one.
fn near(first: &Range<usize>, next: &Range<usize>) -> bool {
    next.start.checked_sub(first.start).is_some_and(|distance| distance <= APART)
}

/// One place: locations that share an excerpt, or a single location without one.
pub struct FilePlaces<'a> {
    /// The locations, in order.
    pub locations: Vec<&'a Location>,
    /// The text of the file, if the locations are ranges in it.
    pub source: Option<&'a str>,
}

/// Groups locations in order: neighbours in one file together, and a file without a span once.
pub fn gather<'a>(locations: &'a [Location], checkpoint: &'a CheckpointReport) -> Vec<FilePlaces<'a>> {
    let mut places: Vec<FilePlaces<'a>> = Vec::new();
    let mut bare = BTreeSet::new();
    for location in locations {
        let Some(file) = location.file.as_deref() else { continue };
        let source = checkpoint.sources.get(file).map(AsRef::as_ref).filter(|_| location.span.is_some());
        if source.is_none() && !bare.insert((file, location.line, location.column, &location.pointer)) {
            continue;
        }
        match places.last_mut() {
            Some(place) if source.is_some() && place.source.is_some() && shares(place, location) => {
                place.locations.push(location);
            }
            _ => places.push(FilePlaces { locations: vec![location], source }),
        }
    }
    places
}

fn shares(place: &FilePlaces<'_>, location: &Location) -> bool {
    let (Some(first), Some(last)) = (place.locations.first(), place.locations.last()) else { return false };
    match (&first.span, &last.span, &location.span) {
        (Some(a), Some(b), Some(c)) => first.file == location.file && near(a, c) && c.start >= b.start,
        _ => false,
    }
}

/// Cuts out the lines around `spans`, which are sorted and pairwise [`near`].
///
/// `None` without spans, or when a span lies outside the source.
pub fn cut(source: &str, spans: &[Range<usize>]) -> Option<Excerpt> {
    let (first, last) = (spans.first()?.start, spans.last()?.start);
    if last > source.len() || spans.iter().any(|s| s.start < first || s.start > last) {
        return None;
    }
    let from = source.floor_char_boundary(first.saturating_sub(BEFORE));
    let to = source.ceil_char_boundary(last.saturating_add(AFTER).min(source.len()));
    let (head, tail) = (source.get(from..first)?, source.get(last..to)?);
    let (begin, cut_left) = match head.rfind('\n') {
        Some(at) => (from.saturating_add(at).saturating_add(1), false),
        None => (from, from > 0),
    };
    // Excerpts start at the start of a line if it is close enough.
    let cut_left = cut_left && !source.get(..begin)?.ends_with('\n');
    let (end, cut_right) = match tail.find('\n') {
        Some(at) => (last.saturating_add(at), false),
        None => (to, to < source.len()),
    };

    let mut text = String::new();
    if cut_left {
        text.push('…');
    }
    let mut starts = vec![None; spans.len()];
    let mut ends = vec![None; spans.len()];
    for (offset, c) in source.get(begin..end)?.char_indices() {
        let at = begin.saturating_add(offset);
        for ((span, start), stop) in spans.iter().zip(&mut starts).zip(&mut ends) {
            if start.is_none() && at >= span.start {
                *start = Some(text.len());
            }
            // A mark ends with its span or with its line, whichever comes first.
            if stop.is_none() && start.is_some_and(|s| s < text.len()) && (at >= span.end || c == '\n' || c == '\r') {
                *stop = Some(text.len());
            }
        }
        match c {
            '\r' => {}
            '\n' | '\t' => text.push(c),
            c if hostile(c) => text.push('\u{fffd}'),
            c => text.push(c),
        }
    }
    let whole = text.len();
    if cut_right {
        text.push('…');
    }
    let marks = starts.into_iter().zip(ends).map(|(start, end)| start.unwrap_or(whole)..end.unwrap_or(whole)).collect();
    Some(Excerpt { text, marks, cut_left })
}

#[cfg(test)]
#[allow(
    clippy::arithmetic_side_effects,
    clippy::single_range_in_vec_init,
    reason = "a list with one span is intended, and tests may panic"
)]
mod tests {
    use super::cut;

    fn marked(source: &str, what: &[&str]) -> (String, Vec<String>) {
        let spans: Vec<_> = what.iter().map(|w| source.find(w).map(|at| at..at + w.len()).unwrap()).collect();
        let excerpt = cut(source, &spans).unwrap();
        let marks = excerpt.marks.iter().map(|m| excerpt.text[m.clone()].to_owned()).collect();
        (excerpt.text, marks)
    }

    #[test]
    fn one_line_of_many() {
        let (text, marks) = marked("{\n  \"a\": 1,\r\n  \"b\": 22\n}\n", &["1"]);
        assert_eq!((text.as_str(), marks), ("  \"a\": 1,", vec!["1".to_owned()]));
    }

    #[test]
    fn neighbouring_lines_share_an_excerpt() {
        let (text, marks) = marked("[\n  Infinity,\n  NaN\n]", &["Infinity", "NaN"]);
        assert_eq!((text.as_str(), marks), ("  Infinity,\n  NaN", vec!["Infinity".to_owned(), "NaN".to_owned()]));
    }

    #[test]
    fn a_huge_line_is_cut_on_both_sides() {
        let source = format!("{{\"v\":\"{}é\",\"bad\":NaN,\"w\":\"{}\"}}", "é".repeat(500_000), "ü".repeat(500_000));
        let (text, marks) = marked(&source, &["NaN"]);
        assert!(text.len() < 400 && text.starts_with('…') && text.ends_with('…'), "{text}");
        assert_eq!(marks, ["NaN"]);
    }

    #[test]
    fn a_span_over_lines_is_marked_on_its_first() {
        let source = "x {\n 1\n}";
        let excerpt = cut(source, &[2..8]).unwrap();
        assert_eq!((excerpt.text.as_str(), excerpt.marks), ("x {", vec![2..3]));
    }

    #[test]
    fn hostile_characters_do_not_get_out() {
        let (text, marks) = marked("\"\u{1b}[2J\u{202e}\u{9b}\" : NaN", &["NaN"]);
        assert_eq!((text.as_str(), marks), ("\"\u{fffd}[2J\u{fffd}\u{fffd}\" : NaN", vec!["NaN".to_owned()]));
    }

    #[test]
    fn spans_outside_the_source_give_nothing() {
        assert_eq!(cut("ab", &[5..6]), None);
        assert_eq!(cut("é", &[1..2]), None);
        assert_eq!(cut("ab", &[]), None);
        assert_eq!(cut("ab", &[2..9]).map(|e| e.marks), Some(vec![2..2]));
    }
}
