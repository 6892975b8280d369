//! The page of an inspection.

use std::fmt::Write as _;

use super::super::format::{bytes, headline, name, objects};
use super::super::inspect::{adapter_line, count, memory, notes, part, target, totals};
use super::{Column, code, map, page, table, text, titled, words};
use crate::check::inspect::{InspectedFile, Inspection, ModuleMap};
use crate::check::verdict::PredictedLoad;
use crate::checkpoint::files;

const LEFT: Column = Column::Left;
const RIGHT: Column = Column::Right;

/// The page of an inspection with its verdicts, and the map of the same checkpoint.
#[must_use]
pub fn render(path: &str, inspection: &Inspection, loads: &[PredictedLoad], map: &ModuleMap) -> String {
    let mut body = String::new();
    if !loads.is_empty() {
        let said: Vec<String> = std::iter::once(headline(loads)).chain(objects(loads)).collect();
        titled(&mut body, "Verdict", &said.iter().map(|line| text(line)).collect::<Vec<_>>());
    }
    map::render(&mut body, "map", "Map", map);
    facts(&mut body, inspection);
    if let Some(summary) = &inspection.adapter {
        let _ok = writeln!(body, "<h2>Adapter</h2>\n<p>{}</p>", words(&adapter_line(summary)));
        let rows: Vec<[String; 3]> = summary.targets.iter().map(target).collect();
        table(&mut body, "Targets", &[("module", LEFT), ("modules", RIGHT), ("rank", RIGHT)], &cells(&rows));
    }
    let parts: Vec<[String; 5]> = inspection.parts.iter().map(part).collect();
    let columns = [("part", LEFT), ("class", LEFT), ("tensors", RIGHT), ("parameters", RIGHT), ("bytes", RIGHT)];
    table(&mut body, "Parts", &columns, &cells(&parts));
    if let Some(found) = &inspection.memory {
        let columns = [("for", LEFT), ("bytes", RIGHT), ("how", LEFT)];
        table(&mut body, "Memory", &columns, &cells(&memory(found)));
    }
    let types = inspection.dtypes.iter();
    let rows = types.map(|(dtype, amount)| {
        vec![text(&name(dtype)), amount.tensors.to_string(), count(amount.parameters), bytes(amount.bytes)]
    });
    let columns = [("type", LEFT), ("tensors", RIGHT), ("parameters", RIGHT), ("bytes", RIGHT)];
    table(&mut body, "Element types", &columns, &rows.collect::<Vec<_>>());
    files(&mut body, inspection);
    titled(&mut body, "Notes", &notes(inspection).iter().map(|note| words(note)).collect::<Vec<_>>());
    page(&name(path), &totals(inspection), &body)
}

/// Cells of text.
fn cells<const N: usize>(rows: &[[String; N]]) -> Vec<Vec<String>> {
    rows.iter().map(|row| row.iter().map(|cell| text(cell)).collect()).collect()
}

/// What config.json says, and what the tensors say.
fn facts(out: &mut String, inspection: &Inspection) {
    let mut rows = Vec::new();
    if let Some(config) = &inspection.config {
        let values = [
            ("class", &config.class),
            ("model type", &config.model_type),
            ("written by transformers", &config.transformers_version),
            ("quantised with", &config.quantization),
        ];
        rows.extend(values.into_iter().filter_map(|(key, value)| Some(vec![key.to_owned(), code(value.as_deref()?)])));
    }
    if let Some(best) = inspection.classes.first() {
        rows.push(vec!["class by tensors".to_owned(), code(&best.class)]);
    }
    table(out, "Class", &[("property", LEFT), ("value", LEFT)], &rows);
    let votes = inspection.votes.iter().flat_map(|votes| &votes.votes).filter(|vote| vote.outvotes());
    let rows: Vec<Vec<String>> = votes
        .map(|vote| {
            vec![
                code(vote.pointer.trim_start_matches('/')),
                code(&vote.config_value.to_string()),
                code(&vote.voted_value.to_string()),
                format!("{} of {}", vote.votes_for, vote.votes_for.saturating_add(vote.votes_against)),
            ]
        })
        .collect();
    let columns = [("value", LEFT), (files::CONFIG, LEFT), ("tensors imply", LEFT), ("votes", LEFT)];
    table(out, "Config values that the tensors contradict", &columns, &rows);
}

/// The files, those of tensors with a bar.
fn files(out: &mut String, inspection: &Inspection) {
    let largest = inspection.files.iter().map(|file| file.bytes).max().unwrap_or_default();
    let row = |file: &InspectedFile| {
        let bar = match file.tensors {
            Some(_) => {
                let width = map::percent(file.bytes, largest);
                format!("<div class=\"bar\"><div style=\"width:{width}%;background:#8ecae6\"></div></div>")
            }
            None => String::new(),
        };
        vec![code(&file.name), bytes(file.bytes), file.tensors.map(|n| n.to_string()).unwrap_or_default(), bar]
    };
    let columns = [("file", LEFT), ("bytes", RIGHT), ("tensors", RIGHT), ("share of the largest", LEFT)];
    let rows: Vec<Vec<String>> = inspection.files.iter().map(row).collect();
    table(out, "Files", &columns, &rows);
}
