//! The plan and the result of a merge.

use std::fmt::Write as _;

use super::super::Style;
use super::super::diff;
use super::super::format::{self, bytes, more, name, plural, sentence, shape, tokens_used, trained, wrap};
use super::super::model::{DryRun, MergeReport, Seam, ShapedName, Verdict};
use super::load::table;
use super::paint::Paint;
use crate::checkpoint::files;

pub fn render(out: &mut String, merge: &MergeReport, style: Style) {
    let paint = Paint(style.color);
    let _ok = writeln!(out, "{} to {}", paint.strong(&format!("merge {}", name(&merge.recipe))), name(&merge.out));
    for (role, path) in &merge.donors {
        let _ok = writeln!(out, "  {:<10} {}", name(role), name(path));
    }
    if !merge.options.is_empty() {
        let options: Vec<String> = merge.options.iter().map(|(k, v)| format!("{}={}", name(k), name(v))).collect();
        let _ok = writeln!(out, "  {:<10} {}", "options", paint.quiet(&hang(&options.join(" "), 13, style)));
    }
    stages(out, merge, style);
    for seam in merge.seams.iter().take(style.cap) {
        render_seam(out, seam, style);
    }
    if !merge.seams.is_empty() {
        list(out, "seams", merge.seams.len(), style, Vec::new());
        // The rest of the plan does not explain the stop.
        return;
    }
    changed(out, merge, style);
    let dropped = merge.dropped.iter().map(|d| {
        format!("{} of {}: {} ({})", plural(d.count, "tensor"), name(&d.donor), name(&d.pattern), sentence(&d.why))
    });
    list(out, "dropped", merge.dropped.len(), style, dropped.take(style.cap).collect());
    let repairs = merge.repairs.iter().map(|r| sentence(r));
    list(out, "repaired", merge.repairs.len(), style, repairs.take(style.cap).collect());
    let notes = merge.notes.iter().map(|n| sentence(n));
    list(out, "notes", merge.notes.len(), style, notes.take(style.cap).collect());
    if let Some(dry_run) = &merge.dry_run {
        planned(out, dry_run, style);
    }
    next_steps(out, merge, style);
    if !merge.files.is_empty() {
        let rows: Vec<_> = merge.files.iter().map(|f| [name(&f.name), sentence(&f.origin)]).collect();
        let size = format!("{}, {}", plural(merge.tensors, "tensor"), bytes(merge.bytes));
        let _ok = writeln!(out, "\n  {}: {size}", plural(merge.files.len(), "file"));
        table(out, ["file", "from"], &rows, style);
    }
}

/// The facts of a dry run: space, shards and the change of the config.
fn planned(out: &mut String, dry_run: &DryRun, style: Style) {
    let free = dry_run.free.map_or_else(|| "not reported".to_owned(), bytes);
    let verdict = if dry_run.free.is_some_and(|free| free < dry_run.needed) { ": too little" } else { "" };
    let _ok = writeln!(out, "\n  space: {} to write, {free} free{verdict}\n", bytes(dry_run.needed));
    let rows: Vec<_> = dry_run.shards.iter().map(|s| [name(&s.name), s.tensors.to_string(), bytes(s.bytes)]).collect();
    table(out, ["shard", "tensors", "size"], &rows, style);
    if let Some(change) = &dry_run.config {
        let before = format!("config.json of donor {}", name(&change.donor));
        let _ok = writeln!(out, "\n{}", diff::texts(&before, files::CONFIG, &change.old, &change.new));
    }
}

/// The tensors to train, and the statements that load the result.
fn next_steps(out: &mut String, merge: &MergeReport, style: Style) {
    if let Some(training) = &merge.training
        && !training.train.is_empty()
    {
        let (train, all) = (training.train.len(), plural(merge.tensors, "tensor"));
        let new = match training.new_values() {
            0 => String::new(),
            new => format!(", {new} of them in new rows"),
        };
        let values = training.values();
        let line = format!("train {train} of {all}, {values} parameters{new} (pattern: merge-report.md)");
        let _ok = writeln!(out, "\n  {}", hang(&line, 2, style));
        table(out, ["tensor", "parameters", "new rows"], &trained(training), style);
        let tokens = tokens_used(merge);
        if !tokens.is_empty() {
            out.push_str("\n  tokens\n");
            table(out, ["token", "id", "used as"], &tokens, style);
        }
    }
    if !merge.usage.is_empty() {
        out.push_str("\n  load it like this\n");
    }
    for line in merge.usage.iter().chain(&merge.prompt) {
        let _ok = writeln!(out, "    {}", sentence(line));
    }
}

fn stages(out: &mut String, merge: &MergeReport, style: Style) {
    let widest = merge.stages.iter().map(|s| s.name.chars().count()).max().unwrap_or(0).min(24);
    out.push('\n');
    for (n, stage) in (1_usize..).zip(&merge.stages).take(style.cap) {
        let outcome = hang(&sentence(&stage.outcome), widest.saturating_add(7), style);
        let _ok = writeln!(out, "  {n}. {:<widest$}  {outcome}", name(&stage.name));
    }
}

fn render_seam(out: &mut String, seam: &Seam, style: Style) {
    let paint = Paint(style.color);
    let message = hang(&sentence(&seam.message), 4, style);
    let title = format!("{}:\n    {}", paint.verdict(Verdict::Error, "error[seam]"), paint.strong(&message));
    let _ok = writeln!(out, "\n  {title}");
    let mut rows = Vec::new();
    let mut row = |what: &str, part: &ShapedName, needed: Option<&[u64]>| {
        rows.push([
            what.to_owned(),
            name(&part.donor),
            name(&part.name),
            shape(&part.shape),
            needed.map_or_else(String::new, shape),
        ]);
    };
    if let Some(tensor) = &seam.tensor {
        row("mismatch", tensor, seam.needed.as_deref());
    }
    if let Some(meets) = &seam.meets {
        row("must match", meets, None);
    }
    if !rows.is_empty() {
        table(out, ["", "donor", "tensor", "shape", "needed"], &rows, style);
    }
    for (n, option) in seam.options.iter().enumerate().take(style.cap) {
        let word = if n == 0 { "help:" } else { "  or:" };
        let _ok = writeln!(out, "  {} {}", paint.help(word), sentence(option));
    }
}

fn changed(out: &mut String, merge: &MergeReport, style: Style) {
    if merge.transforms.is_empty() {
        return;
    }
    let how: Vec<String> = merge.transforms.iter().map(|(how, n)| format!("{n} {}", how.name())).collect();
    let _ok = writeln!(out, "\n  tensors: {}", how.join(", "));
    for cast in merge.casts() {
        let _ok = writeln!(out, "  {cast}");
    }
    let rows: Vec<_> = format::changed(merge).collect();
    if rows.is_empty() {
        return;
    }
    table(out, ["changed tensor", "how", "from", "to"], &rows, style);
}

fn list(out: &mut String, title: &str, total: usize, style: Style, shown: Vec<String>) {
    if !shown.is_empty() {
        let _ok = writeln!(out, "\n  {title}");
    }
    for line in shown {
        let _ok = writeln!(out, "    - {}", hang(&line, 6, style));
    }
    if let Some(more) = more(total, style.cap) {
        let _ok = writeln!(out, "    {more} {title}");
    }
}

/// Wraps text that starts at column `indent`, so that the following lines start there as well.
fn hang(text: &str, indent: usize, style: Style) -> String {
    wrap(text, style.width.map(|w| w.saturating_sub(indent))).replace('\n', &format!("\n{:indent$}", ""))
}
