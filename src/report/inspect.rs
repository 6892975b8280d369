//! Renders the result of `inspect`, for people or as JSON.

mod columns;
mod tree;

use std::fmt::Write as _;

use serde::Serialize;

use self::columns::{Align, WIDTH, columns};
pub(super) use self::tree::label;
use super::Style;
use super::format::{and, bytes, headline, more, name, objects, plural, scaled, sentence, shape, wrap};
use super::json::pretty;
use super::model::ToolInfo;
use super::terminal::load::table;
use super::terminal::paint::Paint;
use crate::check::adapter::{AdaptedModules, AdapterSummary};
use crate::check::inspect::{Amount, ClassCandidate, InspectedPart, InspectedTensor, Inspection, Memory};
use crate::check::verdict::PredictedLoad;
use crate::check::votes::{Vote, Votes};

#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct InspectDocument<'a> {
    schema: u32,
    tool: ToolInfo,
    path: &'a str,
    #[serde(flatten)]
    inspection: &'a Inspection,
    /// What each version of transformers does with it, as `check` says; empty without a config, an index or an adapter's config.
    loads: &'a [PredictedLoad],
    /// The tensors, with `--tensors`.
    #[serde(skip_serializing_if = "Option::is_none")]
    tensor_list: Option<&'a [InspectedTensor]>,
}

/// A complete inspection as JSON, with a list of tensors if there is one.
#[must_use]
pub fn json(
    path: &str,
    inspection: &Inspection,
    loads: &[PredictedLoad],
    tensor_list: Option<&[InspectedTensor]>,
) -> String {
    pretty(&InspectDocument { schema: 2, tool: ToolInfo::this(), path, inspection, loads, tensor_list })
}

/// A list of tensors for a terminal, one per line.
///
/// The program calls it for `inspect --tensors`. Nothing is cut to the width of the terminal: programs read these lines too.
#[must_use]
pub fn tensors(list: &[InspectedTensor]) -> String {
    let row = |t: &InspectedTensor| {
        let offset = t.offset.map(|n| n.to_string()).unwrap_or_default();
        [name(&t.name), shape(&t.shape), t.dtype.to_owned(), t.bytes.to_string(), offset, name(&t.file)]
    };
    let rows: Vec<[String; 6]> = list.iter().map(row).collect();
    let mut out = String::new();
    let header = ["name", "shape", "dtype", "bytes", "offset", "file"];
    let alignment = [Align::Left, Align::Left, Align::Left, Align::Right, Align::Right, Align::Left];
    columns(&mut out, header, alignment, &rows, WIDTH);
    out
}

/// An inspection for a terminal, with `levels` of the tree of modules; without a number, with as many as stay short.
#[must_use]
pub fn full(
    path: &str,
    inspection: &Inspection,
    loads: &[PredictedLoad],
    levels: Option<usize>,
    style: Style,
) -> String {
    let paint = Paint(style.color);
    let mut out = String::new();
    let subject = name(path);
    let line = format!("{subject}: {}", totals(inspection));
    let _ok = writeln!(out, "{}", wrap(&line, style.width).replacen(&subject, &paint.strong(&subject), 1));
    if !loads.is_empty() {
        for line in [headline(loads)].into_iter().chain(objects(loads)) {
            prose(&mut out, &line, style);
        }
    }
    amounts(&mut out, "dtypes", &inspection.dtypes, style);
    tree::render(&mut out, &inspection.tree, levels, style);
    parts(&mut out, inspection, style);
    files(&mut out, inspection, style);
    if let Some(summary) = &inspection.adapter {
        adapter(&mut out, summary, style);
    }
    if !is_pipeline(inspection) {
        class(&mut out, inspection, style);
    }
    if let Some(found) = &inspection.memory {
        let _ok = writeln!(out, "\n  memory");
        table(&mut out, ["", "bytes", ""], &memory(found), style);
    }
    if let Some(votes) = &inspection.votes {
        values(&mut out, votes, inspection.config.is_some(), style);
    }
    if !inspection.proven.is_null() && (inspection.config.is_none() || outvoted(inspection)) {
        let _ok = writeln!(out, "\n  {}", paint.strong("config.json inferred from the tensors (incomplete)"));
        indented(&mut out, &pretty(&inspection.proven));
    }
    for note in notes(inspection) {
        out.push('\n');
        prose(&mut out, &format!("note: {}", sentence(note)), style);
    }
    out
}

/// Whether all of a directory is in its parts.
fn is_pipeline(inspection: &Inspection) -> bool {
    !inspection.parts.is_empty() && inspection.tensors.tensors == 0
}

/// `8 files, 76 tensors, 174.43 thousand parameters, 348 kB`; of a pipeline its parts in place of tensors.
pub(super) fn totals(inspection: &Inspection) -> String {
    let (files, all) = (plural(inspection.files.len(), "file"), inspection.tensors);
    if is_pipeline(inspection) {
        return format!("{files}, {}", plural(inspection.parts.len(), "part"));
    }
    format!("{files}, {}, {} parameters, {}", plural(all.tensors, "tensor"), count(all.parameters), bytes(all.bytes))
}

/// Why parts of the summary are missing. A pipeline is not expected to have them.
pub(super) fn notes(inspection: &Inspection) -> &[String] {
    if is_pipeline(inspection) { &[] } else { &inspection.notes }
}

fn outvoted(inspection: &Inspection) -> bool {
    inspection.votes.as_ref().is_some_and(|v| v.outvoted().next().is_some())
}

fn amounts<'a>(
    out: &mut String,
    title: &str,
    amounts: impl IntoIterator<Item = (&'a String, &'a Amount)>,
    style: Style,
) {
    let rows: Vec<[String; 4]> = amounts
        .into_iter()
        .map(|(key, a)| [name(key), a.tensors.to_string(), count(a.parameters), bytes(a.bytes)])
        .collect();
    if !rows.is_empty() {
        let _ok = writeln!(out, "\n  {title}");
        table(out, ["", "tensors", "parameters", "bytes"], &rows, style);
    }
}

fn files(out: &mut String, inspection: &Inspection, style: Style) {
    let rows: Vec<[String; 3]> = inspection
        .files
        .iter()
        .map(|f| [name(&f.name), bytes(f.bytes), f.tensors.map(|n| n.to_string()).unwrap_or_default()])
        .collect();
    let _ok = writeln!(out, "\n  files");
    table(out, ["", "bytes", "tensors"], &rows, style);
}

fn parts(out: &mut String, inspection: &Inspection, style: Style) {
    let rows: Vec<[String; 5]> = inspection.parts.iter().map(part).collect();
    if !rows.is_empty() {
        let _ok = writeln!(out, "\n  parts");
        table(out, ["", "class", "tensors", "parameters", "bytes"], &rows, style);
    }
}

/// Folder and class of a part, and the amounts of its tensors.
pub(super) fn part(part: &InspectedPart) -> [String; 5] {
    let figure = |of: fn(&Amount) -> String| part.amount.as_ref().map(of).unwrap_or_default();
    let class = part.class.as_deref().map(name).unwrap_or_default();
    let [parameters, size] = [figure(|a| count(a.parameters)), figure(|a| bytes(a.bytes))];
    [name(&part.folder), class, figure(|a| a.tensors.to_string()), parameters, size]
}

/// What an adapter is, and the modules that it changes.
fn adapter(out: &mut String, summary: &AdapterSummary, style: Style) {
    out.push('\n');
    prose(out, &adapter_line(summary), style);
    let rows: Vec<[String; 3]> = summary.targets.iter().map(target).collect();
    if !rows.is_empty() {
        let _ok = writeln!(out, "\n  targets");
        table(out, ["", "modules", "rank"], &rows, style);
    }
    if summary.others > 0 {
        prose(out, &format!("{} beside the low-rank matrices", plural(summary.others, "tensor")), style);
    }
}

/// `adapter: LORA with r 8 and lora_alpha 16, for meta-llama/Llama-3.1-8B`.
pub(super) fn adapter_line(summary: &AdapterSummary) -> String {
    let kind = summary.kind.as_deref().map_or_else(|| "no peft_type".to_owned(), name);
    let rank = summary.rank.map(|rank| format!("r {rank}"));
    let alpha = summary.alpha.map(|alpha| format!("lora_alpha {alpha}"));
    let figures: Vec<String> = rank.into_iter().chain(alpha).collect();
    let figures = if figures.is_empty() { String::new() } else { format!(" with {}", and(&figures)) };
    let base = summary.base.as_deref().filter(|base| !base.is_empty());
    let base = base.map_or_else(|| "a base model that it does not name".to_owned(), name);
    format!("adapter: {kind}{figures}, for {base}")
}

/// Name, number of modules and ranks of the targets of one name.
pub(super) fn target(target: &AdaptedModules) -> [String; 3] {
    let ranks: Vec<String> = target.ranks.iter().take(8).map(u64::to_string).collect();
    let further = more(target.ranks.len(), 8).map(|more| format!(" {more}")).unwrap_or_default();
    [name(&target.name), target.modules.to_string(), ranks.join(", ") + &further]
}

/// What takes memory, how much, and how that was reckoned.
pub(super) fn memory(found: &Memory) -> Vec<[String; 3]> {
    let dtype = name(&found.dtype);
    let step = format!("weights, gradients and both moments of AdamW in {dtype}, without activations");
    let mut rows = vec![
        ["weights".to_owned(), bytes(found.weights), format!("in {dtype}")],
        ["training step".to_owned(), bytes(found.training), step],
    ];
    if let Some(cache) = &found.cache {
        let size = if cache.at_most { format!("≤ {}", bytes(cache.bytes)) } else { bytes(cache.bytes) };
        let (batch, context) = (plural_of(cache.batch, "sequence"), plural_of(cache.context, "token"));
        let of = format!("keys and values of {batch} of {context} in {dtype}");
        rows.push(["cache".to_owned(), size, of]);
    }
    rows
}

fn plural_of(n: u64, noun: &str) -> String {
    plural(usize::try_from(n).unwrap_or(usize::MAX), noun)
}

fn class(out: &mut String, inspection: &Inspection, style: Style) {
    let paint = Paint(style.color);
    out.push('\n');
    match &inspection.config {
        None => prose(out, "class: no config.json", style),
        Some(config) => {
            let or = |text: &Option<String>, none: &str| text.as_deref().map_or_else(|| none.to_owned(), name);
            let class = paint.strong(&or(&config.class, "none"));
            let model_type = or(&config.model_type, "none");
            let version = config.transformers_version.as_ref();
            let version = version.map(|version| format!(", written by transformers {}", name(version)));
            let method = config.quantization.as_ref().map(|method| format!(", quantised with {}", name(method)));
            let (version, method) = (version.unwrap_or_default(), method.unwrap_or_default());
            prose(out, &format!("class by config: {class} (model_type {model_type}){version}{method}"), style);
        }
    }
    let Some(best) = inspection.classes.first() else { return };
    let fit = best.fit.map(|fit| format!(", {} of names and shapes with the values below", percent(fit)));
    let text = format!(
        "class by tensors: {} ({}): matches {} of names{}; known for transformers {}",
        paint.strong(&name(&best.class)),
        name(&best.architecture),
        percent(best.names),
        fit.unwrap_or_default(),
        and(&best.loaders)
    );
    prose(out, &text, style);
    let others: Vec<&ClassCandidate> = inspection.classes.iter().skip(1).collect();
    if !others.is_empty() {
        let mut shown: Vec<String> =
            others.iter().take(style.cap).map(|c| format!("{} {}", name(&c.class), percent(c.names))).collect();
        shown.extend(more(others.len(), style.cap));
        let _ok = writeln!(out, "    next: {}", shown.join(", "));
    }
}

/// A sentence in lines of the width of the terminal, indented by two columns, and by four from the second line on.
fn prose(out: &mut String, text: &str, style: Style) {
    let wrapped = wrap(text, style.width.map(|width| width.saturating_sub(4)));
    for (number, line) in wrapped.lines().enumerate() {
        let indent = if number == 0 { 2 } else { 4 };
        let _ok = writeln!(out, "{:indent$}{line}", "");
    }
}

fn values(out: &mut String, votes: &Votes, has_config: bool, style: Style) {
    let (outvoted, agreed): (Vec<&Vote>, Vec<&Vote>) = votes.votes.iter().partition(|v| v.outvotes());
    let contradicted = outvoted.len();
    let rows: Vec<[String; 5]> = outvoted.into_iter().chain(agreed).map(value).collect();
    let _ok = writeln!(out, "\n  config values inferred from the tensors");
    let first = if has_config { "config" } else { "default" };
    if style.width.is_none_or(|width| width_of(&rows) <= width) {
        table(out, ["", first, "tensors imply", "votes", "for example"], &rows, style);
    } else {
        narrow(out, first, &rows, contradicted, style.cap);
    }
    let (before, after) = (votes.before, votes.after);
    let fits = |f: crate::check::votes::Fit| {
        format!("{} of {} stored, {} with another shape", f.found, f.expected, f.mismatched)
    };
    let text = match votes.outvoted().count() {
        0 => format!("the tensors contradict no value; tensors of the class: {}", fits(after)),
        n => format!(
            "the tensors contradict {}; tensors of the class: {}; with the inferred values: {}",
            plural(n, "value"),
            fits(before),
            fits(after)
        ),
    };
    prose(out, &text, style);
    for open in &votes.undecided {
        prose(out, &format!("undetermined; only this is known: {}", name(&open.constraint)), style);
    }
}

/// A row of the table of values: key, value in the config, implied value, votes, and a tensor that implies it.
fn value(v: &Vote) -> [String; 5] {
    [
        name(v.pointer.trim_start_matches('/')).replace('/', "."),
        config_value(v),
        name(&v.voted_value.to_string()),
        tally(v),
        v.evidence.first().map(|w| name(&w.to_string())).unwrap_or_default(),
    ]
}

/// Width of these rows as a table, in columns.
fn width_of<const N: usize>(rows: &[[String; N]]) -> usize {
    let widest = |at: usize| rows.iter().filter_map(|row| row.get(at)).map(|cell| cell.chars().count()).max();
    let cells: usize = (0..N).filter_map(widest).sum();
    // A border and two blanks for each column, the last border and the indent.
    cells.saturating_add(N.saturating_mul(3)).saturating_add(3)
}

/// The rows of [`value`] for a terminal that is too narrow for their table: names stand last and are not broken, and tensors
/// are named only for the first rows, whose values are contradicted.
fn narrow(out: &mut String, first: &str, rows: &[[String; 5]], contradicted: usize, cap: usize) {
    let shown: Vec<[String; 4]> = rows
        .iter()
        .take(cap)
        .map(|[key, config, implied, votes, _]| [config, implied, votes, key].map(Clone::clone))
        .collect();
    let mut text = String::new();
    columns(&mut text, [first, "implied", "votes", ""], [Align::Left; 4], &shown, WIDTH);
    for line in text.lines() {
        let _ok = writeln!(out, "  {line}");
    }
    if let Some(more) = more(rows.len(), cap) {
        let _ok = writeln!(out, "    {more}");
    }
    for [key, .., example] in rows.iter().take(contradicted.min(cap)) {
        let _ok = writeln!(out, "  {key} is implied by {example}");
    }
}

/// The value in the config, marked if the tensors contradict it, or in parentheses if the config does not set it.
fn config_value(vote: &Vote) -> String {
    let value = name(&vote.config_value.to_string());
    let value = if vote.given { value } else { format!("({value})") };
    if vote.outvotes() { format!("{value} ✗") } else { value }
}

fn tally(vote: &Vote) -> String {
    let all = vote.votes_for.saturating_add(vote.votes_against);
    if all == 0 { "absence".to_owned() } else { format!("{} of {all}", vote.votes_for) }
}

fn indented(out: &mut String, text: &str) {
    for line in text.lines() {
        let _ok = writeln!(out, "    {line}");
    }
}

fn percent(share: f64) -> String {
    // Rounded down, so that 99.96 % is not printed as 100 %.
    let tenths = (share * 1000.0).floor() / 10.0;
    if tenths >= 100.0 { "100 %".to_owned() } else { format!("{tenths:.1} %") }
}

/// `7.08 billion`.
pub(super) fn count(n: u64) -> String {
    scaled(n, [(" billion", 1_000_000_000), (" million", 1_000_000), (" thousand", 1_000)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearly_all_is_not_all() {
        assert_eq!([percent(1.0), percent(0.9999), percent(0.5)], ["100 %", "99.9 %", "50.0 %"]);
        assert_eq!([count(999), count(7_085_000_000)], ["999", "7.08 billion"]);
    }
}
