//! The changes of a repair: a unified diff for each text, a table for each shard.

use std::fmt::Write as _;

use comfy_table::{Table, presets};
use similar::TextDiff;

use super::collapse::collapse;
use super::format::{hostile, name, place};
use crate::check::Location;
use crate::surgery::plan::PlannedShard;
use crate::surgery::repair::{Content, Repair};

/// Maximum length of a line, in characters; a longer line is cut around its first difference.
const LINE: usize = 300;
/// Larger texts, in bytes, are not compared line by line.
const TEXT: usize = 8 << 20;
/// Maximum number of rows in a table of tensors.
const ROWS: usize = 40;

/// The changes that a repair makes in the checkpoint `path`, escaped for display.
#[must_use]
pub fn render(path: &str, repair: &Repair) -> String {
    let mut out = String::new();
    for change in &repair.changes {
        let at = place(path, Some(&Location { file: Some(change.name.clone()), ..Location::default() }));
        match &change.new {
            Content::Text(new) => {
                let old = repair.original.text(&change.name);
                text(&mut out, &at, old.map(AsRef::as_ref), new);
            }
            Content::Shard(new) => shard(&mut out, &at, repair, new),
        }
    }
    out
}

/// The unified diff of two texts, escaped for display.
pub(super) fn texts(before: &str, after: &str, old: &str, new: &str) -> String {
    let mut out = String::new();
    text(&mut out, after, Some(old), new);
    out.replacen(&format!("--- {after}"), &format!("--- {before}"), 1)
}

fn text(out: &mut String, at: &str, old: Option<&str>, new: &str) {
    let from = if old.is_some() { at } else { "/dev/null" };
    let old = old.unwrap_or_default();
    if old.len().max(new.len()) > TEXT {
        let _ok = writeln!(out, "--- {from}\n+++ {at}\n {} bytes become {}", old.len(), new.len());
        return;
    }
    let diff = TextDiff::from_lines(old, new);
    let _ok = writeln!(out, "--- {from}\n+++ {at}");
    for hunk in diff.unified_diff().context_radius(3).iter_hunks() {
        let _ok = writeln!(out, "{}", hunk.header());
        let changes: Vec<_> = hunk.iter_changes().collect();
        for (i, change) in changes.iter().enumerate() {
            // The line is compared with its neighbour in the diff to find the first difference.
            let other = [i.checked_add(1), i.checked_sub(1)].into_iter().flatten().filter_map(|j| changes.get(j));
            let other = other.filter(|c| c.tag() != change.tag()).map(similar::Change::value).next();
            let _ok = writeln!(out, "{}{}", change.tag(), shown(change.value(), other.unwrap_or_default()));
            if change.missing_newline() {
                out.push_str("\\ No newline at end of file\n");
            }
        }
    }
}

/// A line, escaped for display, and cut around the first character that differs from `other`.
fn shown(line: &str, other: &str) -> String {
    let line = line.strip_suffix('\n').unwrap_or(line);
    let same = line.chars().zip(other.chars()).take_while(|(a, b)| a == b).count();
    let length = line.chars().count();
    let from = if length > LINE { same.saturating_sub(LINE / 3).min(length.saturating_sub(LINE)) } else { 0 };
    let mut out = String::from(if from > 0 { "…" } else { "" });
    out.extend(line.chars().skip(from).take(LINE).map(|c| if hostile(c) && c != '\t' { '\u{fffd}' } else { c }));
    if length > from.saturating_add(LINE) {
        out.push('…');
    }
    out
}

fn shard(out: &mut String, at: &str, repair: &Repair, new: &PlannedShard) {
    let mut table = Table::new();
    table.load_style(presets::UTF8_FULL_CONDENSED);
    table.set_header([name(at), "before".to_owned(), "after".to_owned()]);
    let old = repair.original.shards.get(&*new.name);
    let metadata = old.and_then(|shard| shard.metadata().cloned()).unwrap_or_default();
    for (key, value) in new.metadata.iter().filter(|(key, value)| metadata.get(*key) != Some(value)) {
        let before = metadata.get(key).map(|v| name(v)).unwrap_or_default();
        table.add_row([format!("__metadata__ {}", name(key)), before, name(value)]);
    }
    let renamed: Vec<(&str, &str)> = new
        .tensors
        .iter()
        .map(|t| (t.source.main().name.as_str(), t.name.as_str()))
        .filter(|(before, after)| before != after)
        .collect();
    let before = collapse(renamed.iter().map(|(before, _)| *before));
    let after = collapse(renamed.iter().map(|(_, after)| *after));
    let rows: Vec<(String, String)> = if before.len() == after.len() {
        before.into_iter().zip(after).map(|(b, a)| (b.pattern, a.pattern)).collect()
    } else {
        renamed.into_iter().map(|(b, a)| (b.to_owned(), a.to_owned())).collect()
    };
    for (before, after) in rows.iter().take(ROWS) {
        table.add_row(["tensor".to_owned(), name(before), name(after)]);
    }
    if let Some(more) = super::format::more(rows.len(), ROWS) {
        table.add_row([more.as_str(), "", ""]);
    }
    if table.row_count() == 0 {
        table.add_row(["header", "", "rewritten, tensors unchanged"]);
    }
    let _ok = writeln!(out, "{table}");
}
