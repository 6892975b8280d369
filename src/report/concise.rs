//! One line for the verdicts on a checkpoint and one per finding, for editors, `grep` and logs.

use std::fmt::Write as _;

use super::Style;
use super::fixes::mark;
use super::format::{capped, governed, headline, more, name, place, sentence, worst_first};
use super::model::{CheckpointReport, Report};

pub fn render(report: &Report, style: Style) -> String {
    let cap = style.cap;
    let mut out = String::new();
    for checkpoint in worst_first(report) {
        if !style.quiet || !checkpoint.is_quiet() {
            findings(&mut out, checkpoint, cap);
        }
    }
    seams(&mut out, report, cap);
    out
}

/// The seams of a stopped merge, one per line.
pub fn seams(out: &mut String, report: &Report, cap: usize) {
    if let Some(merge) = &report.merge {
        for seam in merge.seams.iter().take(cap) {
            let _ok = write!(out, "{}: error[seam] {}", name(&merge.recipe), sentence(&seam.message));
            if !seam.options.is_empty() {
                let _ok = write!(out, " (try {})", sentence(&seam.options.join(" or ")));
            }
            out.push('\n');
        }
        if let Some(more) = more(merge.seams.len(), cap) {
            let _ok = writeln!(out, "{}: {more} seams", name(&merge.recipe));
        }
    }
}

fn findings(out: &mut String, checkpoint: &CheckpointReport, cap: usize) {
    if !checkpoint.loads.is_empty() {
        let _ok = writeln!(out, "{}: {}", name(&checkpoint.path), headline(&checkpoint.loads));
    }
    if let Some(governed) = governed(checkpoint) {
        let _ok = writeln!(out, "{}: {governed}", name(&checkpoint.path));
    }
    let (shown, hidden) = capped(&checkpoint.findings, cap);
    let (notes, findings): (Vec<_>, Vec<_>) = shown.into_iter().partition(|finding| finding.is_note());
    for finding in notes.into_iter().chain(findings) {
        let location = finding.locations.first();
        out.push_str(&place(&checkpoint.path, location));
        if let Some(line) = location.and_then(|l| l.line) {
            let _ok = write!(out, ":{line}");
            if let Some(column) = location.and_then(|l| l.column) {
                let _ok = write!(out, ":{column}");
            }
        }
        let _ok = writeln!(
            out,
            ": {}[{}] {}{}",
            finding.severity.name(),
            name(&finding.code),
            mark(finding, checkpoint.fixing),
            sentence(&finding.message)
        );
    }
    for (code, n) in hidden {
        let _ok = writeln!(out, "{}: and {n} more {}", name(&checkpoint.path), name(code));
    }
}
