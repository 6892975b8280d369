//! A finding on a page: places with excerpts, notes, and the fix as a diff.

use std::fmt::Write as _;
use std::ops::Range;

use super::super::diff::texts;
use super::super::edits::splices;
use super::super::excerpt::{FilePlaces, cut, gather};
use super::super::format::{advice, details, more, name, tensors};
use super::super::model::CheckpointReport;
use super::{code, list, text, words};
use crate::check::{Finding, FixHint};
use crate::checkpoint::{line_column, spliced};

/// Maximum number of places shown for one finding.
const PLACES: usize = 12;

pub(super) fn render(out: &mut String, finding: &Finding, checkpoint: &CheckpointReport) {
    let severity = finding.severity.name();
    let _ok = writeln!(
        out,
        "<article class=\"{severity}\"><h3><span class=\"{severity}\">{severity}</span> <code>{}</code> {}</h3>",
        text(&name(&finding.code)),
        words(&finding.message)
    );
    let places = gather(&finding.locations, checkpoint);
    for place in places.iter().take(PLACES) {
        show(out, place);
    }
    let mut notes: Vec<String> = more(places.len(), PLACES).map(|more| format!("{more} places")).into_iter().collect();
    notes.extend(
        tensors(&finding.message, &finding.locations, PLACES).iter().map(|tensor| format!("tensor {}", code(tensor))),
    );
    notes.extend(details(finding).iter().map(|detail| text(detail)));
    notes.push(format!("rule {}", text(&name(&finding.name))));
    list(out, &notes);
    if let Some(hint) = &finding.fix {
        fix(out, hint, checkpoint);
    }
    out.push_str("</article>\n");
}

/// A place with its excerpt.
fn show(out: &mut String, place: &FilePlaces<'_>) {
    let Some(first) = place.locations.first() else { return };
    let spans: Vec<Range<usize>> = place.locations.iter().filter_map(|l| l.span.clone()).collect();
    let counted = || place.source.zip(first.span.as_ref()).map(|(source, span)| line_column(source, span.start));
    let at = first.line.zip(first.column).or_else(counted);
    let _ok = write!(out, "<p>{}", code(first.file.as_deref().unwrap_or_default()));
    let _ok = match (at, first.line) {
        (Some((line, column)), _) => write!(out, ":{line}:{column}"),
        (None, Some(line)) => write!(out, ":{line}"),
        (None, None) => Ok(()),
    };
    if let Some(pointer) = first.pointer.as_deref().filter(|pointer| !pointer.is_empty()) {
        let _ok = write!(out, " <span class=\"dim\">at</span> {}", code(pointer));
    }
    out.push_str("</p>\n");
    let Some(excerpt) = place.source.and_then(|source| cut(source, &spans)) else { return };
    out.push_str("<pre tabindex=\"0\">");
    let mut end = 0;
    for mark in &excerpt.marks {
        let (before, marked) = (excerpt.text.get(end..mark.start), excerpt.text.get(mark.clone()));
        if let (Some(before), Some(marked)) = (before, marked) {
            let _ok = write!(out, "{}<mark>{}</mark>", quoted(before), quoted(marked));
            end = mark.end;
        }
    }
    let _ok = writeln!(out, "{}</pre>", quoted(excerpt.text.get(end..).unwrap_or_default()));
}

/// A part of a document. A tab is shown as blanks: a page has no character that controls anything.
fn quoted(part: &str) -> String {
    text(&part.replace('\t', "    "))
}

/// What to do: the edits as a diff where they change texts of the report.
fn fix(out: &mut String, hint: &FixHint, checkpoint: &CheckpointReport) {
    for step in advice(hint) {
        let _ok = writeln!(out, "<p><strong>Fix:</strong> {}</p>", text(&step));
    }
    let files = splices(hint, &checkpoint.sources).unwrap_or_default();
    for (file, splices) in files {
        let Some(source) = checkpoint.sources.get(file) else { continue };
        let Some(new) = spliced(source, &splices) else { continue };
        let shown = name(file);
        out.push_str("<pre class=\"diff\" tabindex=\"0\">");
        for line in texts(&shown, &shown, source, &new).lines() {
            let _ok = match line.as_bytes() {
                [b'+', b'+', b'+', ..] | [b'-', b'-', b'-', ..] => writeln!(out, "{}", quoted(line)),
                [b'+', ..] => writeln!(out, "<ins>{}</ins>", quoted(line)),
                [b'-', ..] => writeln!(out, "<del>{}</del>", quoted(line)),
                _ => writeln!(out, "{}", quoted(line)),
            };
        }
        out.push_str("</pre>\n");
    }
}
