//! The tree of modules for a terminal.

use std::fmt::Write as _;

use super::super::Style;
use super::super::format::{bytes, more, name};
use super::columns::{Align, WIDTH, columns};
use super::count;
use crate::check::inspect::InspectedModule;

/// Levels that are printed when the user names none.
const LEVELS: usize = 3;
/// Lines beyond which fewer levels are printed when the user names none.
const LINES: usize = 40;
/// Columns that the figures take, beside the names.
const FIGURES: usize = 36;

/// Appends the tree with as many levels as the user names, and 0 for all. Without a number, long lists of siblings are cut.
pub(super) fn render(out: &mut String, modules: &[InspectedModule], levels: Option<usize>, style: Style) {
    if modules.is_empty() {
        return;
    }
    let (levels, cap) = match levels {
        Some(0) => (usize::MAX, usize::MAX),
        Some(levels) => (levels, usize::MAX),
        None => (short(modules, style.cap), style.cap),
    };
    let mut rows = Vec::new();
    let all = Cut { levels, cap };
    all.collect(&mut rows, modules, "", 1);
    let limit = style.width.map_or(WIDTH, |width| width.saturating_sub(FIGURES));
    out.push('\n');
    columns(out, ["  modules", "tensors", "parameters", "bytes"], ALIGNMENT, &rows, limit);
    if all.hides(modules, 1) {
        let _ok = writeln!(out, "  further levels: --depth {}", levels.saturating_add(1));
    }
}

const ALIGNMENT: [Align; 4] = [Align::Left, Align::Right, Align::Right, Align::Right];

/// The most levels, up to [`LEVELS`], that take at most [`LINES`] lines.
fn short(modules: &[InspectedModule], cap: usize) -> usize {
    let fits = |levels: &usize| Cut { levels: *levels, cap }.lines(modules, 1) <= LINES;
    (1..=LEVELS).rev().find(fits).unwrap_or(1)
}

/// The part of a tree that is printed.
#[derive(Clone, Copy)]
struct Cut {
    levels: usize,
    /// Maximum length of a list of siblings.
    cap: usize,
}

impl Cut {
    fn lines(self, modules: &[InspectedModule], level: usize) -> usize {
        if level > self.levels {
            return 0;
        }
        let inner = modules.iter().take(self.cap).map(|one| self.lines(&one.modules, level.saturating_add(1)));
        inner.fold(modules.len().min(self.cap), usize::saturating_add)
    }

    /// Whether modules are deeper than what is printed.
    fn hides(self, modules: &[InspectedModule], level: usize) -> bool {
        !modules.is_empty()
            && (level > self.levels || modules.iter().any(|one| self.hides(&one.modules, level.saturating_add(1))))
    }

    /// Adds a row for each module, with its name below `outer`.
    fn collect(self, rows: &mut Vec<[String; 4]>, modules: &[InspectedModule], outer: &str, level: usize) {
        if level > self.levels {
            return;
        }
        let indent = "  ".repeat(level.saturating_add(1));
        for one in modules.iter().take(self.cap) {
            let amount = one.amount;
            let title = format!("{indent}{}", label(one, outer));
            rows.push([title, amount.tensors.to_string(), count(amount.parameters), bytes(amount.bytes)]);
            self.collect(rows, &one.modules, &one.name, level.saturating_add(1));
        }
        if let Some(more) = more(modules.len(), self.cap) {
            rows.push([format!("{indent}{more}"), String::new(), String::new(), String::new()]);
        }
    }
}

/// The name of a module below the one around it: `layers.0–31 ×32`.
pub fn label(module: &InspectedModule, outer: &str) -> String {
    let inner = module.name.strip_prefix(outer).unwrap_or(&module.name);
    let inner = if outer.is_empty() { inner } else { inner.strip_prefix('.').unwrap_or(inner) };
    let Some(last) = &module.last else { return name(inner) };
    let number = last.rsplit('.').next().unwrap_or(last);
    format!("{}–{} ×{}", name(inner), name(number), module.repeats)
}
