//! The page of an inspection.

use std::fmt::Write as _;

use super::super::format::{bytes, headline, name, objects, plural};
use super::super::inspect::{adapter_line, count, target};
use super::{Column, code, map, page, table, text, titled, words};
use crate::check::inspect::{Amount, InspectedFile, InspectedPart, Inspection, Memory, ModuleMap};
use crate::check::verdict::PredictedLoad;
use crate::checkpoint::files;

const LEFT: Column = Column::Left;
const RIGHT: Column = Column::Right;

/// The page of an inspection with its verdicts, and the map of the same checkpoint.
#[must_use]
pub fn render(path: &str, inspection: &Inspection, loads: &[PredictedLoad], map: &ModuleMap) -> String {
    let mut body = String::new();
    let all = inspection.tensors;
    let subtitle = format!(
        "{}, {}, {} parameters, {}",
        plural(inspection.files.len(), "file"),
        plural(all.tensors, "tensor"),
        count(all.parameters),
        bytes(all.bytes)
    );
    if !loads.is_empty() {
        let said: Vec<String> = std::iter::once(headline(loads)).chain(objects(loads)).collect();
        titled(&mut body, "Verdict", &said.iter().map(|line| text(line)).collect::<Vec<_>>());
    }
    map::render(&mut body, "map", "Map", map);
    facts(&mut body, inspection);
    if let Some(summary) = &inspection.adapter {
        let _ok = writeln!(body, "<h2>Adapter</h2>\n<p>{}</p>", words(&adapter_line(summary)));
        let rows: Vec<Vec<String>> =
            summary.targets.iter().map(|one| target(one).map(|cell| text(&cell)).to_vec()).collect();
        table(&mut body, "Targets", &[("module", LEFT), ("modules", RIGHT), ("rank", RIGHT)], &rows);
    }
    parts(&mut body, inspection);
    if let Some(memory) = &inspection.memory {
        table(&mut body, "Memory", &[("for", LEFT), ("bytes", RIGHT), ("how", LEFT)], &memory_rows(memory));
    }
    let types = inspection.dtypes.iter();
    let rows = types.map(|(dtype, amount)| {
        vec![text(&name(dtype)), amount.tensors.to_string(), count(amount.parameters), bytes(amount.bytes)]
    });
    let columns = [("type", LEFT), ("tensors", RIGHT), ("parameters", RIGHT), ("bytes", RIGHT)];
    table(&mut body, "Element types", &columns, &rows.collect::<Vec<_>>());
    files(&mut body, inspection);
    titled(&mut body, "Notes", &inspection.notes.iter().map(|note| words(note)).collect::<Vec<_>>());
    page(&name(path), &subtitle, &body)
}

fn parts(out: &mut String, inspection: &Inspection) {
    let row = |part: &InspectedPart| {
        let figure = |of: fn(&Amount) -> String| part.amount.as_ref().map(of).unwrap_or_default();
        let class = part.class.as_deref().map(code).unwrap_or_default();
        let [parameters, size] = [figure(|a| count(a.parameters)), figure(|a| bytes(a.bytes))];
        vec![code(&part.folder), class, figure(|a| a.tensors.to_string()), parameters, size]
    };
    let columns = [("part", LEFT), ("class", LEFT), ("tensors", RIGHT), ("parameters", RIGHT), ("bytes", RIGHT)];
    table(out, "Parts", &columns, &inspection.parts.iter().map(row).collect::<Vec<_>>());
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

fn memory_rows(memory: &Memory) -> Vec<Vec<String>> {
    let dtype = text(&name(&memory.dtype));
    let step = format!("weights, gradients and both moments of AdamW in {dtype}, without activations");
    let mut rows = vec![
        vec!["weights".to_owned(), bytes(memory.weights), format!("in {dtype}")],
        vec!["training step".to_owned(), bytes(memory.training), step],
    ];
    if let Some(cache) = &memory.cache {
        let size = if cache.at_most { format!("≤ {}", bytes(cache.bytes)) } else { bytes(cache.bytes) };
        let of = format!("keys and values of a batch of {} and a context of {} in {dtype}", cache.batch, cache.context);
        rows.push(vec!["cache".to_owned(), size, of]);
    }
    rows
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
