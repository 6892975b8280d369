//! The table of a run.

use std::fmt::Write as _;

use comfy_table::{CellAlignment, Table, presets};

use super::super::Style;
use super::super::format::{bytes, name, scaled};
use super::super::model::Verdict;
use super::super::overview::{Overview, OverviewRow, shared_folder};
use super::paint::Paint;
use crate::check::verdict::LoadVerdict;

/// Spaces between two columns.
const GAP: usize = 2;
/// Least width of a cut name.
const NARROWEST: usize = 8;

/// Renders the table. Paths and classes are cut to the width of the terminal.
pub fn render(out: &mut String, overview: &Overview<'_>, style: Style) {
    let names = overview.rows.iter().map(|row| (name(&row.checkpoint.path), row.class().map_or_else(none, name)));
    let mut names: Vec<(String, String)> = names.collect();
    names.insert(0, ("model".to_owned(), "class".to_owned()));
    let loaders = overview.loaders.iter().map(|loader| name(loader));
    let header = ["params", "size"].map(str::to_owned).into_iter().chain(loaders);
    let mut figures: Vec<Vec<String>> = vec![header.chain(["err", "warn"].map(str::to_owned)).collect()];
    figures.extend(overview.rows.iter().map(cells));
    if let Some(width) = style.width {
        fit(&mut names, width.saturating_sub(columns_width(&figures)));
    }
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    for ((path, class), figures) in names.into_iter().zip(&figures) {
        table.add_row([path, class].iter().chain(figures));
    }
    let last = overview.loaders.len().saturating_add(5);
    for (at, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, u16::try_from(GAP).unwrap_or_default()));
        let is_number = [2, 3].contains(&at) || at.saturating_add(2) > last.saturating_sub(1);
        if is_number {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    let paint = Paint(style.color);
    let mut lines = table.lines();
    if let Some(header) = lines.next() {
        let _ok = writeln!(out, "{}", paint.strong(header.trim_end()));
    }
    for (line, row) in lines.zip(&overview.rows) {
        let _ok = writeln!(out, "{}", colored(line.trim_end(), &row.verdicts, paint));
    }
}

/// A line of the table with its verdicts in colour. They are the last words of it, before two numbers.
fn colored(line: &str, verdicts: &[Option<LoadVerdict>], paint: Paint) -> String {
    let (mut head, mut tail) = (line, String::new());
    for verdict in verdicts.iter().rev().flatten() {
        let word = short(Some(*verdict));
        let Some((before, after)) = head.rsplit_once(word) else { break };
        let word = match verdict {
            LoadVerdict::Loads => paint.verdict(Verdict::Clean, word),
            LoadVerdict::NotPredicted => paint.quiet(word),
            LoadVerdict::LoadsWrong | LoadVerdict::Raises => paint.verdict(Verdict::Error, word),
        };
        tail = format!("{word}{after}{tail}");
        head = before;
    }
    format!("{head}{tail}")
}

/// The cells after the names.
fn cells(row: &OverviewRow<'_>) -> Vec<String> {
    const UNITS: [(&str, u64); 3] = [("B", 1_000_000_000), ("M", 1_000_000), ("k", 1_000)];
    let checkpoint = row.checkpoint;
    let has_tensors = checkpoint.tensors > 0;
    let mut cells = vec![
        if has_tensors { scaled(checkpoint.parameters, UNITS) } else { none() },
        if has_tensors { bytes(checkpoint.bytes) } else { none() },
    ];
    cells.extend(row.verdicts.iter().map(|verdict| short(*verdict).to_owned()));
    cells.extend([checkpoint.counts.error, checkpoint.counts.warning].map(|n| n.to_string()));
    cells
}

const fn short(verdict: Option<LoadVerdict>) -> &'static str {
    match verdict {
        Some(LoadVerdict::Loads) => "loads",
        Some(LoadVerdict::LoadsWrong) => "wrong",
        Some(LoadVerdict::Raises) => "raises",
        Some(LoadVerdict::NotPredicted) => "?",
        None => "",
    }
}

fn none() -> String {
    "-".to_owned()
}

/// Width of the columns of these rows, with the gaps before them.
fn columns_width(rows: &[Vec<String>]) -> usize {
    let columns = rows.first().map_or(0, Vec::len);
    let widest = |at: usize| rows.iter().filter_map(|row| row.get(at)).map(|cell| cell.chars().count()).max();
    (0..columns).filter_map(widest).fold(0, |sum: usize, widest| sum.saturating_add(widest).saturating_add(GAP))
}

/// Removes the folder that all paths share.
fn without_folder(names: &mut [(String, String)]) {
    let paths: Vec<&str> = names.iter().map(|(path, _)| path.as_str()).collect();
    let shared = shared_folder(&paths);
    for (path, _) in names {
        path.drain(..shared);
    }
}

/// Makes both columns and the gap between them fit into `width`: first without the folder that all paths share, then with
/// paths cut at the left and classes at the right.
fn fit(names: &mut [(String, String)], width: usize) {
    let room = width.saturating_sub(GAP).max(NARROWEST.saturating_mul(2));
    let long = |text: &str| text.chars().count();
    let widest = |names: &[(String, String)], text: fn(&(String, String)) -> &String| {
        names.iter().map(|row| long(text(row))).max().unwrap_or(0)
    };
    let class = widest(names, |(_, class)| class);
    if class.saturating_add(widest(names, |(path, _)| path)) > room {
        without_folder(names.get_mut(1..).unwrap_or_default());
    }
    let path = widest(names, |(path, _)| path);
    // The class gets what the paths leave, and at least two fifths.
    let class = class.min(room.saturating_sub(path).max(room.saturating_mul(2).checked_div(5).unwrap_or_default()));
    let path = room.saturating_sub(class);
    for (text, _) in &mut *names {
        let cut = long(text).saturating_sub(path);
        if cut > 0 {
            let kept: String = text.chars().skip(cut.saturating_add(1)).collect();
            *text = format!("…{kept}");
        }
    }
    for (_, text) in names {
        if long(text) > class {
            let kept: String = text.chars().take(class.saturating_sub(1)).collect();
            *text = format!("{kept}…");
        }
    }
}
