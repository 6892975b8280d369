//! The report for a terminal: source excerpts and tables, with a line for the verdict at the end.

mod contents;
pub(super) mod finding;
pub(super) mod load;
mod merge;
mod overview;
pub(super) mod paint;

use std::fmt::Write as _;

use self::paint::Paint;
use super::format::{
    agreeing, alike, bytes, capped, counts, governed, headlines, kind, name, notes, objects, plural, summary,
    worst_first, wrap,
};
use super::model::{CheckpointReport, Report};
use super::overview::Overview;
use super::{Style, concise, fixes};
use crate::check::Finding;

/// The table of the checkpoints alone, and the seams of a stopped merge. `quiet` leaves out checkpoints without findings.
pub fn table(report: &Report, style: Style) -> String {
    let mut overview = Overview::new(report);
    overview.rows.retain(|row| !style.quiet || !row.checkpoint.is_quiet());
    let mut out = String::new();
    if !overview.rows.is_empty() {
        overview::render(&mut out, &overview, style);
    }
    for row in &overview.rows {
        if let Some(governed) = governed(row.checkpoint) {
            let _ok = writeln!(out, "{}: {governed}", name(&row.checkpoint.path));
        }
    }
    concise::seams(&mut out, report, style.cap);
    out
}

pub fn render(report: &Report, style: Style) -> String {
    let paint = Paint(style.color);
    let mut out = String::new();
    if let Some(overview) = Overview::of_several(report).filter(|_| !style.quiet) {
        overview::render(&mut out, &overview, style);
        out.push('\n');
    }
    let mut above: Option<&CheckpointReport> = None;
    for checkpoint in worst_first(report) {
        if style.quiet && checkpoint.is_quiet() {
            continue;
        }
        header(&mut out, checkpoint, style);
        if above.is_some_and(|a| repeats(a, checkpoint)) {
            let _ok = writeln!(out, "  {}", paint.quiet("the same findings and the same predicted load as above"));
        } else {
            findings(&mut out, checkpoint, style);
            out.push_str(&fixes::section(checkpoint));
            for (load, loaders) in agreeing(&checkpoint.loads) {
                load::render(&mut out, load, &loaders, style);
            }
            contents::render(&mut out, &checkpoint.contents);
        }
        out.push('\n');
        above = Some(checkpoint);
    }
    if let Some(merge) = &report.merge {
        merge::render(&mut out, merge, style);
        out.push('\n');
    }
    if style.quiet {
        return out;
    }
    let _ok = writeln!(out, "{}", paint.verdict(report.summary.verdict, &wrap(&summary(report), style.width)));
    if let Some(closing) = fixes::closing(report) {
        let _ok = writeln!(out, "{closing}");
    }
    out
}

/// Whether a checkpoint has the same findings as the one above it, as the planned and the written one usually do.
fn repeats(above: &CheckpointReport, checkpoint: &CheckpointReport) -> bool {
    !checkpoint.findings.is_empty()
        && (&above.path, &above.findings, &above.loads) == (&checkpoint.path, &checkpoint.findings, &checkpoint.loads)
}

/// `fixtures/vision (donor vision): loads with transformers 4.47.0`, then `spatialvla, 690 tensors, 1.23 MB, clean`, and a
/// line for each object that does not load.
fn header(out: &mut String, checkpoint: &CheckpointReport, style: Style) {
    let paint = Paint(style.color);
    out.push_str(&paint.strong(&name(&checkpoint.path)));
    if let Some(role) = &checkpoint.role {
        let _ok = write!(out, " ({})", name(&role.to_string()));
    }
    if !checkpoint.loads.is_empty() {
        let (first, others) = headlines(&checkpoint.loads);
        let _ok = write!(out, ": {}", paint.strong(&first));
        let _ok = others.map(|others| write!(out, " {}", paint.quiet(&others)));
    }
    let kind = kind(checkpoint, name);
    let _ok = write!(out, "\n  {kind}, {}, {}", plural(checkpoint.tensors, "tensor"), bytes(checkpoint.bytes));
    let found = counts(checkpoint.counts);
    let verdict = if found.is_empty() { "clean" } else { &found };
    let _ok = writeln!(out, ", {}", paint.verdict(checkpoint.verdict, verdict));
    if let Some(governed) = governed(checkpoint) {
        let _ok = writeln!(out, "  {}", paint.quiet(&governed));
    }
    for line in objects(&checkpoint.loads).into_iter().chain(notes(checkpoint)) {
        let width = style.width.map(|width| width.saturating_sub(4).max(40));
        for (n, part) in wrap(&line, width).lines().enumerate() {
            let indent = if n == 0 { "  " } else { "    " };
            let _ok = writeln!(out, "{indent}{}", paint.quiet(part));
        }
    }
}

fn findings(out: &mut String, checkpoint: &CheckpointReport, style: Style) {
    let (shown, hidden) = capped(&checkpoint.findings, style.cap);
    let shown: Vec<&Finding> = shown.into_iter().filter(|finding| !finding.is_note()).collect();
    let is_empty = shown.is_empty() && hidden.is_empty();
    for finding in alike(shown) {
        out.push('\n');
        out.push_str(&finding::render(&finding, checkpoint, style));
        out.push('\n');
    }
    for (code, n) in hidden {
        let _ok = writeln!(out, "\nand {n} more {}", name(code));
    }
    if !is_empty {
        out.push('\n');
    }
}
