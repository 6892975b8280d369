//! The predicted load report: the keys that a loader would report, and those that it would load incorrectly without a
//! warning.

use std::fmt::Write as _;

use comfy_table::{ContentArrangement, Table, presets};

use super::super::Style;
use super::super::collapse::{NameGroup, collapse};
use super::super::format::{mismatched, more, name, sentence, silent, versions};
use super::paint::Paint;
use crate::check::load::LoadReport;
use crate::check::verdict::PredictedLoad;

/// Renders the load report of loaders with the same result.
pub fn render(out: &mut String, load: &LoadReport, loaders: &[&PredictedLoad], style: Style) {
    let paint = Paint(style.color);
    let n = load.lengths();
    let [missing, unexpected, mismatches, silents] = n;
    let line = format!(
        "predicted load by {}: {missing} missing, {unexpected} unexpected, {mismatches} mismatched, {silents} silent",
        versions(loaders),
    );
    // The verdict tells of a load without differences.
    if n == [0; 4] {
        return;
    }
    let _ok = writeln!(out, "  {}", paint.strong(&line));
    if let Some(exception) = &load.raises {
        let _ok = writeln!(out, "\n  before it reports any of these, the loader raises");
        let _ok = writeln!(out, "    {}", sentence(exception));
    }
    let names = |list: &[String]| collapse(list.iter().map(String::as_str));
    list(out, "missing: the loader initialises these with random values", &names(&load.missing), style);
    unlisted(out, load.unlisted.missing);
    list(out, "unexpected: the loader ignores these", &names(&load.unexpected), style);
    unlisted(out, load.unlisted.unexpected);
    if !load.mismatched.is_empty() {
        let _ok = writeln!(out, "\n  mismatched: the loader raises an exception");
        table(out, ["tensor", "stored", "expected"], &mismatched(load), style);
        unlisted(out, load.unlisted.mismatched);
    }
    for (reason, groups) in silent(load) {
        list(out, &format!("silent, loaded without a warning: {reason}"), &groups, style);
    }
    unlisted(out, load.unlisted.silent);
}

/// The number of names that the report does not have.
fn unlisted(out: &mut String, count: usize) {
    if count > 0 {
        let _ok = writeln!(out, "    and {count} tensors that are not listed");
    }
}

fn list(out: &mut String, title: &str, groups: &[NameGroup], style: Style) {
    if groups.is_empty() {
        return;
    }
    let _ok = writeln!(out, "\n  {title}");
    for group in groups.iter().take(style.cap) {
        let _ok = write!(out, "    {}", name(&group.pattern));
        let _ok = if group.count > 1 { writeln!(out, "  ({})", group.count) } else { writeln!(out) };
    }
    if let Some(more) = more(groups.len(), style.cap) {
        let _ok = writeln!(out, "    {more}");
    }
}

/// A table of at most `style.cap` rows, indented by two columns.
pub fn table<const N: usize>(out: &mut String, header: [&str; N], rows: &[[String; N]], style: Style) {
    const INDENT: usize = 2;
    let mut table = Table::new();
    table.load_style(presets::UTF8_FULL_CONDENSED).set_header(header);
    if let Some(width) = style.width {
        table.set_content_arrangement(ContentArrangement::Dynamic);
        table.set_width(u16::try_from(width.saturating_sub(INDENT)).unwrap_or(u16::MAX).max(40));
    }
    for row in rows.iter().take(style.cap) {
        table.add_row(row);
    }
    for line in table.lines() {
        let _ok = writeln!(out, "{:INDENT$}{line}", "");
    }
    if let Some(more) = more(rows.len(), style.cap) {
        let _ok = writeln!(out, "    {more}");
    }
}
