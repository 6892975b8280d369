//! Renders one finding with its places.

use std::ops::Range;

use annotate_snippets::{AnnotationKind, Element, Group, Level, Origin, Renderer, Snippet};

use super::super::Style;
use super::super::excerpt::{FilePlaces, cut, gather};
use super::super::fixes::mark;
use super::super::format::{advice, details, more, name, place, sentence, tensors, wrap};
use super::super::model::CheckpointReport;
use crate::check::{Finding, Severity};
use crate::checkpoint::line_column;

/// Maximum number of places shown for one finding.
const PLACES: usize = 6;
/// Columns before the text of a note, with room for line numbers of four digits.
const INDENT: usize = 16;

pub fn render(finding: &Finding, checkpoint: &CheckpointReport, style: Style) -> String {
    let level = match finding.severity {
        Severity::Error => Level::ERROR,
        Severity::Warning => Level::WARNING,
        Severity::Info => Level::INFO,
    };
    let message = format!("{}{}", mark(finding, checkpoint.fixing), sentence(&finding.message));
    let title = level.primary_title(message).id(name(&finding.code));
    let mut group = Group::with_title(title);
    let places = gather(&finding.locations, checkpoint);
    let mut shown: Vec<Shown> = places.iter().take(PLACES).map(|one| show(one, checkpoint)).collect();
    for one in &mut shown {
        group = group.elements(one.elements.drain(..));
    }
    let width = style.width.map(|w| w.saturating_sub(INDENT));
    let note = |label: &'static str, text: String| Level::NOTE.with_name(label).message(wrap(&text, width));
    if let Some(more) = more(places.len(), PLACES) {
        group = group.element(note("places", more));
    }
    for text in tensors(&finding.message, &finding.locations, PLACES) {
        group = group.element(note("tensor", text));
    }
    group = group.element(note("rule", name(&finding.name)));
    for detail in details(finding) {
        group = group.element(note("note", detail));
    }
    for step in finding.fix.iter().flat_map(advice) {
        group = group.element(Level::HELP.message(wrap(&step, width)));
    }
    let renderer = if style.color { Renderer::styled() } else { Renderer::plain() };
    let mut text = renderer.term_width(style.width.unwrap_or(140)).render(&[group]);
    for (wrong, right) in shown.iter().filter_map(|one| one.column.as_ref()) {
        text = text.replacen(wrong, right, 1);
    }
    // Without line numbers for alignment, arrows and notes would start at the left margin.
    if shown.iter().all(|one| !one.excerpt) { text.replace('\n', "\n ") } else { text }
}

/// A rendered place.
struct Shown {
    elements: Vec<Element<'static>>,
    /// Whether it contains an excerpt.
    excerpt: bool,
    /// `path:line:column` as rendered and as corrected, if a line was cut at the left.
    column: Option<(String, String)>,
}

fn show(place: &FilePlaces<'_>, checkpoint: &CheckpointReport) -> Shown {
    let Some(first) = place.locations.first() else {
        return Shown { elements: Vec::new(), excerpt: false, column: None };
    };
    let spans: Vec<Range<usize>> = place.locations.iter().filter_map(|l| l.span.clone()).collect();
    let excerpt = place.source.and_then(|source| cut(source, &spans));
    let counted = || place.source.zip(first.span.as_ref()).map(|(source, span)| line_column(source, span.start));
    let place_in_file = first.line.zip(first.column).or_else(counted);
    let line = place_in_file.map(|(line, _)| line).or(first.line);
    let column = place_in_file.map(|(_, column)| column);
    let path = self::place(&checkpoint.path, Some(first));
    let (Some(excerpt), Some(line)) = (excerpt, line) else {
        let mut origin = Origin::path(path);
        if let Some(line) = line {
            origin = origin.line(line);
        }
        if let Some(column) = column {
            origin = origin.char_column(column);
        }
        let mut elements = vec![Element::Origin(origin)];
        let pointer = first.pointer.as_deref().filter(|p| !p.is_empty());
        elements.extend(pointer.map(|p| Level::NOTE.with_name("at").message(name(p)).into()));
        return Shown { elements, excerpt: false, column: None };
    };
    let column = column.filter(|_| excerpt.cut_left).zip(excerpt.marks.first()).map(|(column, mark)| {
        let seen = excerpt.text.get(..mark.start).unwrap_or_default().chars().count();
        (format!("{path}:{line}:{}", seen.saturating_add(1)), format!("{path}:{line}:{column}"))
    });
    let mut snippet = Snippet::source(excerpt.text).line_start(line).fold(false).path(path);
    for (mark, location) in excerpt.marks.into_iter().zip(&place.locations) {
        let label = location.pointer.as_deref().filter(|p| !p.is_empty()).map(name);
        snippet = snippet.annotation(AnnotationKind::Primary.span(mark).label(label));
    }
    Shown { elements: vec![snippet.into()], excerpt: true, column }
}
