//! The record of a merge on a page.

use std::fmt::Write as _;

use super::super::format::{bytes, changed, name, plural, shape, tokens_used, trained};
use super::super::model::{CheckpointMap, MergeReport, Seam};
use super::{Column, block, code, list, map, table, text, titled, words};

const LEFT: Column = Column::Left;

/// The donors beside each other, and the result below them.
pub(super) fn maps(out: &mut String, maps: &[CheckpointMap]) {
    let Some((result, donors)) = maps.split_last() else { return };
    out.push_str("<div class=\"two\">\n");
    for (at, donor) in donors.iter().enumerate() {
        out.push_str("<div>");
        map::render(out, &format!("map-{}", at.saturating_add(1)), &donor.title, &donor.map);
        out.push_str("</div>\n");
    }
    out.push_str("</div>\n");
    map::render(out, "map-result", &result.title, &result.map);
}

pub(super) fn render(out: &mut String, merge: &MergeReport) {
    let donors: Vec<Vec<String>> =
        merge.donors.iter().map(|(role, path)| vec![text(&name(role)), code(path)]).collect();
    table(out, "Donors", &[("role", LEFT), ("directory", LEFT)], &donors);
    let options: Vec<Vec<String>> = merge.options.iter().map(|(key, value)| vec![code(key), code(value)]).collect();
    table(out, "Options", &[("option", LEFT), ("value", LEFT)], &options);
    let stages: Vec<Vec<String>> = merge.stages.iter().map(|s| vec![text(&name(&s.name)), words(&s.outcome)]).collect();
    table(out, "Stages", &[("stage", LEFT), ("outcome", LEFT)], &stages);
    for seam in &merge.seams {
        render_seam(out, seam);
    }
    tensors(out, merge);
    let sentences = |lines: &[String]| lines.iter().map(|line| words(line)).collect::<Vec<_>>();
    titled(out, "Repaired", &sentences(&merge.repairs));
    titled(out, "Notes", &sentences(&merge.notes));
    if let Some(training) = merge.training.as_ref().filter(|training| training.pattern.is_some()) {
        let rows: Vec<Vec<String>> = trained(training)
            .into_iter()
            .map(|[names, values, new]| vec![code(&names), text(&values), text(&new)])
            .collect();
        let columns = [("tensor", LEFT), ("parameters", Column::Right), ("new rows", LEFT)];
        table(out, "Tensors to train", &columns, &rows);
    }
    let tokens: Vec<Vec<String>> = tokens_used(merge)
        .into_iter()
        .map(|[token, ids, used_as]| vec![code(&token), text(&ids), text(&used_as)])
        .collect();
    table(out, "Tokens", &[("token", LEFT), ("id", LEFT), ("used as", LEFT)], &tokens);
    for (title, lines) in [("Load it like this", &merge.usage), ("Ask about a picture", &merge.prompt)] {
        if !lines.is_empty() {
            let _ok = writeln!(out, "<h2>{title}</h2>");
            block(out, lines);
        }
    }
    let files: Vec<Vec<String>> = merge.files.iter().map(|file| vec![code(&file.name), words(&file.origin)]).collect();
    table(out, "Files", &[("file", LEFT), ("from", LEFT)], &files);
}

/// A seam as a joint: the two tensors that should meet, with their shapes.
fn render_seam(out: &mut String, seam: &Seam) {
    let _ok =
        writeln!(out, "<article class=\"error\"><h2><span class=\"error\">seam</span> {}</h2>", words(&seam.message));
    let mut rows = Vec::new();
    for (what, part, needed) in [("mismatch", &seam.tensor, seam.needed.as_deref()), ("must match", &seam.meets, None)]
    {
        rows.extend(part.iter().map(|part| {
            let needed = needed.map_or_else(String::new, shape);
            vec![what.to_owned(), text(&name(&part.donor)), code(&part.name), shape(&part.shape), needed]
        }));
    }
    let columns = [("part", LEFT), ("donor", LEFT), ("tensor", LEFT), ("shape", LEFT), ("needed", LEFT)];
    table(out, "Tensors that do not fit", &columns, &rows);
    let options = seam.options.iter().map(|option| format!("<strong>Option:</strong> {}", words(option)));
    list(out, &options.collect::<Vec<_>>());
    out.push_str("</article>\n");
}

fn tensors(out: &mut String, merge: &MergeReport) {
    if !merge.transforms.is_empty() {
        let how: Vec<String> = merge.transforms.iter().map(|(how, n)| format!("{n} {}", how.name())).collect();
        let (tensors, size) = (plural(merge.tensors, "tensor"), bytes(merge.bytes));
        let _ok = writeln!(out, "<h2>Tensors</h2>\n<p>{tensors}, {size}: {}</p>", how.join(", "));
    }
    list(out, &merge.casts().iter().map(|line| text(line)).collect::<Vec<_>>());
    let rows: Vec<Vec<String>> =
        changed(merge).map(|[tensor, how, from, to]| vec![code(&tensor), text(&how), text(&from), text(&to)]).collect();
    table(out, "Changed tensors", &[("tensor", LEFT), ("how", LEFT), ("from", LEFT), ("to", LEFT)], &rows);
    let rows: Vec<Vec<String>> = merge
        .dropped
        .iter()
        .map(|d| vec![text(&name(&d.donor)), code(&d.pattern), d.count.to_string(), words(&d.why)])
        .collect();
    let columns = [("donor", LEFT), ("tensors", LEFT), ("count", Column::Right), ("why", LEFT)];
    table(out, "Dropped", &columns, &rows);
}
