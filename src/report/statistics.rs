//! Counts the findings of each rule.

use std::collections::BTreeMap;

use comfy_table::{CellAlignment, Table, presets};
use serde::Serialize;

use super::format::{name, summary};
use super::{Format, Report, json};
use crate::check::{Finding, Severity};

#[derive(Serialize)]
struct RuleCount<'a> {
    code: &'a str,
    name: &'a str,
    severity: Severity,
    count: usize,
    /// Safety of the fix: `safe`, `unsafe` or `manual`.
    fix: Option<&'a str>,
}

/// One line per rule, the most frequent first: a table for `full` and `concise`, an array for `json`. `None` for the
/// other formats.
#[must_use]
pub fn statistics(report: &Report, format: Format) -> Option<String> {
    let mut counts: BTreeMap<(&str, Severity), (usize, &Finding)> = BTreeMap::new();
    for finding in report.checkpoints.iter().flat_map(|c| &c.findings) {
        let (count, _) = counts.entry((&finding.code, finding.severity)).or_insert((0, finding));
        *count = count.saturating_add(finding.count());
    }
    let mut lines: Vec<RuleCount<'_>> = counts
        .into_iter()
        .map(|((code, severity), (count, finding))| {
            let fix = finding.fix.as_ref().map(|fix| fix.safety.name());
            RuleCount { code, name: &finding.name, severity, count, fix }
        })
        .collect();
    lines.sort_by_key(|line| std::cmp::Reverse(line.count));
    match format {
        Format::Json => Some(json::pretty(&lines)),
        Format::Full | Format::Concise => Some(text(&lines, report)),
        _ => None,
    }
}

fn text(lines: &[RuleCount<'_>], report: &Report) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    for line in lines {
        table.add_row([&line.count.to_string(), &name(line.code), line.severity.name(), &name(line.name)]);
    }
    if let Some(counts) = table.column_mut(0) {
        counts.set_cell_alignment(CellAlignment::Right);
    }
    let rows = table.lines().filter(|_| !lines.is_empty()).map(|row| format!("{}\n", row.trim_end()));
    format!("{}{}\n", rows.collect::<String>(), summary(report))
}
