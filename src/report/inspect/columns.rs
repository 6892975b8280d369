//! Aligned columns without borders: nothing is wrapped, and many rows take no time.

use std::fmt::Write as _;

/// Width that a longer cell gives its column where the terminal sets none.
pub(super) const WIDTH: usize = 80;

/// Side to which the cells of a column are aligned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Align {
    /// Words.
    Left,
    /// Numbers.
    Right,
}

/// Appends a header and rows, which are escaped already. A cell longer than `limit` moves the others of its row only.
pub(super) fn columns<const N: usize>(
    out: &mut String,
    header: [&str; N],
    alignment: [Align; N],
    rows: &[[String; N]],
    limit: usize,
) {
    let mut widths = header.map(|cell| cell.chars().count());
    for row in rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = cell.chars().count().min(limit).max(*width);
        }
    }
    line(out, header.into_iter(), &widths, alignment);
    for row in rows {
        line(out, row.iter().map(String::as_str), &widths, alignment);
    }
}

fn line<'a, const N: usize>(
    out: &mut String,
    cells: impl Iterator<Item = &'a str>,
    widths: &[usize; N],
    alignment: [Align; N],
) {
    for (n, ((cell, width), align)) in cells.zip(widths).zip(alignment).enumerate() {
        let gap = if n == 0 { "" } else { "  " };
        let _ok = match align {
            Align::Left => write!(out, "{gap}{cell:<width$}"),
            Align::Right => write!(out, "{gap}{cell:>width$}"),
        };
    }
    out.truncate(out.trim_end_matches(' ').len());
    out.push('\n');
}

#[cfg(test)]
mod tests {
    use super::{Align, WIDTH, columns};

    #[test]
    fn cells_are_aligned_and_only_long_ones_move_others() {
        let long = "x".repeat(90);
        let rows = [["a", "1"], ["bcd", "20"], [long.as_str(), "3"]].map(|row| row.map(str::to_owned));
        let mut out = String::new();
        columns(&mut out, ["", "n"], [Align::Left, Align::Right], &rows, WIDTH);
        let gap = |n: usize| " ".repeat(n);
        assert_eq!(out, format!("{} n\na{} 1\nbcd{}20\n{long}   3\n", gap(82), gap(81), gap(79)));
    }
}
