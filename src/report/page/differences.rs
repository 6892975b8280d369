//! The page of a comparison.

use std::fmt::Write as _;

use serde_json::Value;

use super::super::compare::{conversion, equal, figures, outcome, value};
use super::super::format::{and, name, plural, shape};
use super::{Column, code, map, page, table, text, titled, words};
use crate::check::compare::{ChangedCell, ChangesByLayer, Differences, OneSided, TensorDifferences};
use crate::check::inspect::ModuleMap;
use crate::checkpoint::{DifferenceRank, Distance};

const LEFT: Column = Column::Left;
const RIGHT: Column = Column::Right;

/// Rows of a table.
const CAP: usize = 2_000;

/// The page of a comparison of two checkpoints: their maps, what changed by layer, and every difference.
#[must_use]
pub fn render(paths: [&str; 2], differences: &Differences, maps: &[ModuleMap; 2], layers: &ChangesByLayer) -> String {
    let mut body = String::new();
    let found = &differences.tensors;
    let _ok = writeln!(
        body,
        "<p>{} in the first, {} in the second; {} {}.</p>\n<div class=\"two\">",
        plural(found.before, "tensor"),
        found.after,
        found.equal,
        text(equal(found.bytes))
    );
    for ((path, map), id) in paths.iter().zip(maps).zip(["before", "after"]) {
        body.push_str("<div>");
        map::render(&mut body, id, &name(path), map);
        body.push_str("</div>\n");
    }
    body.push_str("</div>\n");
    by_layer(&mut body, layers);
    tensors(&mut body, found);
    documents(&mut body, differences);
    titled(&mut body, "Not compared", &differences.unknown.iter().map(|text| words(text)).collect::<Vec<_>>());
    page(&and(&paths.map(name)), outcome(differences), &body)
}

/// The changes by layer as a table of colours.
fn by_layer(out: &mut String, found: &ChangesByLayer) {
    if found.rows.is_empty() {
        return;
    }
    let _ok = write!(
        out,
        "<h2>Changes by layer</h2>\n<p class=\"dim\">The norm of the difference as a share of the norm before: \
         <span class=\"swatch h0\"></span>{} <span class=\"swatch h1\"></span>below 0.0001 \
         <span class=\"swatch h2\"></span>below 0.001 <span class=\"swatch h3\"></span>below 0.01, or not measured \
         <span class=\"swatch h4\"></span>below 0.1 <span class=\"swatch h5\"></span>0.1 and more</p>\n\
         <div class=\"wide\" tabindex=\"0\"><table class=\"grid\"><thead><tr><th scope=\"col\">tensor</th>",
        found.kept
    );
    for layer in &found.layers {
        let _ok = write!(out, "<th scope=\"col\">{layer}</th>");
    }
    out.push_str("</tr></thead>\n<tbody>\n");
    for row in &found.rows {
        let _ok = write!(out, "<tr><th scope=\"row\">{}</th>", code(&row.pattern));
        for (cell, layer) in row.cells.iter().zip(&found.layers) {
            let Some(cell) = cell else {
                out.push_str("<td></td>");
                continue;
            };
            let (heat, said) = heat(*cell, found.kept);
            let _ok =
                write!(out, "<td class=\"cell h{heat}\" title=\"layer {layer}: {said}\"><span>{said}</span></td>");
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody></table></div>\n");
    for (further, noun) in [(found.further_rows, "row"), (found.further_layers, "layer")] {
        if further > 0 {
            let _ok = writeln!(out, "<p class=\"dim\">and {}</p>", plural(further, &format!("more {noun}")));
        }
    }
}

/// The colour of a cell, and what it says.
fn heat(cell: ChangedCell, kept: &str) -> (usize, String) {
    const STEPS: [f64; 4] = [0.0001, 0.001, 0.01, 0.1];
    if cell.changed == 0 {
        return (0, kept.to_owned());
    }
    let of = if cell.tensors > 1 { format!("{} of {} tensors, ", cell.changed, cell.tensors) } else { String::new() };
    match cell.by.and_then(Distance::relative) {
        Some(share) => {
            let heat = STEPS.iter().filter(|step| share >= **step).count().saturating_add(1);
            (heat, format!("{of}relative {}", figures(share)))
        }
        None => (3, format!("{of}other bytes")),
    }
}

fn tensors(out: &mut String, found: &TensorDifferences) {
    let renamed: Vec<Vec<String>> = found
        .renamed
        .iter()
        .map(|change| vec![code(&change.from), code(&change.to), change.tensors.to_string()])
        .collect();
    table(out, "Renamed tensors, by prefix", &[("from", LEFT), ("to", LEFT), ("tensors", RIGHT)], &renamed);
    if let Some(converted) = &found.converted {
        let _ok = writeln!(out, "<p>{}.</p>", text(&conversion(converted)));
    }
    let one_sided = |tensors: &[OneSided]| -> Vec<Vec<String>> {
        let row = |one: &OneSided| {
            let dtype = one.dtype.as_deref().map(name).unwrap_or_default();
            vec![code(&one.name), one.shape.as_deref().map(shape).unwrap_or_default(), text(&dtype)]
        };
        tensors.iter().map(row).collect()
    };
    let columns = [("tensor", LEFT), ("shape", LEFT), ("type", LEFT)];
    folded(out, "Tensors of the first alone", &columns, one_sided(&found.removed));
    folded(out, "Tensors of the second alone", &columns, one_sided(&found.added));
    let reshaped = found.reshaped.iter().map(|one| vec![code(&one.name), shape(&one.before), shape(&one.after)]);
    let columns = [("tensor", LEFT), ("before", LEFT), ("after", LEFT)];
    folded(out, "Tensors of another shape", &columns, reshaped.collect());
    let measured = |by: Option<Distance>, rank: Option<DifferenceRank>| {
        let number = |number: Option<f64>| number.map(figures).unwrap_or_default();
        let rank = rank.map(|rank| format!("{}{}", if rank.at_least { "≥ " } else { "" }, rank.rank));
        [
            number(by.and_then(Distance::relative)),
            number(by.map(|by| by.largest_difference)),
            by.and_then(Distance::cosine).map(|cosine| format!("{cosine:.6}")).unwrap_or_default(),
            rank.unwrap_or_default(),
        ]
    };
    let figures = [("relative", RIGHT), ("largest", RIGHT), ("cosine", RIGHT), ("rank", RIGHT)];
    let recast = found.recast.iter().map(|one| {
        let change = format!("{} → {}", text(&name(&one.before)), text(&name(&one.after)));
        [code(&one.name), change].into_iter().chain(measured(one.by, None)).collect()
    });
    let columns: Vec<_> = [("tensor", LEFT), ("type", LEFT)].into_iter().chain(figures).collect();
    folded(out, "Tensors of another type", &columns, recast.collect());
    let changed = found.changed.iter();
    let changed = changed.map(|one| std::iter::once(code(&one.name)).chain(measured(one.by, one.rank)).collect());
    let columns: Vec<_> = std::iter::once(("tensor", LEFT)).chain(figures).collect();
    folded(out, "Tensors with other bytes", &columns, changed.collect());
}

/// A table that is closed at first, with its number of rows.
fn folded(out: &mut String, title: &str, columns: &[(&str, Column)], mut rows: Vec<Vec<String>>) {
    let all = rows.len();
    if all == 0 {
        return;
    }
    rows.truncate(CAP);
    let _ok = writeln!(out, "<details><summary>{}: {all}</summary>", text(title));
    table(out, title, columns, &rows);
    if all > CAP {
        let _ok = writeln!(out, "<p class=\"dim\">and {} more</p>", all.saturating_sub(CAP));
    }
    out.push_str("</details>\n");
}

fn documents(out: &mut String, differences: &Differences) {
    let shown = |one: &Option<Value>| code(&value(one.as_ref()));
    for change in &differences.documents {
        let rows: Vec<Vec<String>> =
            change.values.iter().map(|one| vec![code(&one.pointer), shown(&one.before), shown(&one.after)]).collect();
        table(out, &name(&change.file), &[("value", LEFT), ("before", LEFT), ("after", LEFT)], &rows);
        if change.further > 0 {
            let _ok = writeln!(out, "<p class=\"dim\">and {} more</p>", change.further);
        }
    }
    if let Some(tokens) = &differences.tokens {
        let id = |id: Option<u64>| id.map_or_else(|| "none".to_owned(), |id| id.to_string());
        let _ok = writeln!(
            out,
            "<h2>Tokenizer</h2>\n<p>{} with another id, the first is {}: {} → {}</p>",
            plural(tokens.tokens, "token"),
            code(&tokens.first),
            id(tokens.before),
            id(tokens.after)
        );
    }
    let files = &differences.files;
    let named = |what: &str, names: &[String]| -> Vec<String> {
        names.iter().map(|file| format!("{what} {}", code(file))).collect()
    };
    let lines = [named("removed", &files.removed), named("added", &files.added), named("changed", &files.changed)];
    titled(out, "Files", &lines.concat());
}
