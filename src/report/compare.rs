//! The result of `diff`, for people or as JSON.

use std::fmt::Write as _;

use serde::Serialize;
use serde_json::Value;

use super::Style;
use super::collapse::{NameGroup, collapse_with};
use super::format::{more, name, plural, sentence, shape, shortened, wrap};
use super::json::pretty;
use super::model::ToolInfo;
use super::terminal::paint::Paint;
use crate::check::compare::{
    ComparedBytes, Converted, Differences, DocumentChange, OneSided, PrefixChange, TensorDifferences,
};
use crate::checkpoint::{DifferenceRank, Distance, escape};

/// Columns before a line that goes on with the one above.
const INDENT: usize = 6;

/// Maximum length of a value, in characters.
const VALUE: usize = 60;

#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct DiffDocument<'a> {
    schema: u32,
    tool: ToolInfo,
    /// The first path.
    before: &'a str,
    /// The second path.
    after: &'a str,
    #[serde(flatten)]
    differences: &'a Differences,
}

/// All differences as JSON.
#[must_use]
pub fn json(before: &str, after: &str, differences: &Differences) -> String {
    pretty(&DiffDocument { schema: 1, tool: ToolInfo::this(), before, after, differences })
}

/// The differences for a terminal. Of long lists, the first lines are printed and the others counted.
#[must_use]
pub fn full(before: &str, after: &str, differences: &Differences, style: Style) -> String {
    let paint = Paint(style.color);
    let mut out = String::new();
    let [one, other] = [before, after].map(|path| paint.strong(&name(path)));
    let verdict = if differences.differ { " differ".to_owned() } else { format!(": {}", outcome(differences)) };
    let _ok = writeln!(out, "{one} and {other}{verdict}");
    tensors(&mut out, &differences.tensors, style);
    for DocumentChange { file, values, further } in &differences.documents {
        let line = |at: &str, before: &Option<Value>, after: &Option<Value>| {
            format!("{}: {} -> {}", name(at), value(before.as_ref()), value(after.as_ref()))
        };
        let lines = values.iter().map(|change| line(&change.pointer, &change.before, &change.after));
        section(&mut out, &name(file), lines, *further, style);
    }
    if let Some(tokens) = &differences.tokens {
        let id = |id: Option<u64>| id.map_or_else(|| "none".to_owned(), |id| id.to_string());
        let (token, before, after) = (name(&tokens.first), id(tokens.before), id(tokens.after));
        let first =
            format!("{} with another id, the first is {token}: {before} -> {after}", plural(tokens.tokens, "token"));
        section(&mut out, "tokenizer", std::iter::once(first), 0, style);
    }
    let files = &differences.files;
    let marked = |mark: &str, names: &[String]| names.iter().map(|file| format!("{mark} {}", name(file))).collect();
    let lists: [Vec<String>; 3] =
        [("-", &files.removed), ("+", &files.added), ("~", &files.changed)].map(|(mark, names)| marked(mark, names));
    section(&mut out, "files", lists.into_iter().flatten(), 0, style);
    section(&mut out, "not compared", differences.unknown.iter().map(|text| sentence(text)), 0, style);
    out
}

/// The answer in a few words.
pub(super) fn outcome(differences: &Differences) -> &'static str {
    let is_whole = differences.unknown.is_empty() && differences.tensors.bytes != ComparedBytes::Sampled;
    match (differences.differ, is_whole) {
        (true, _) => "they differ",
        (false, true) => "no difference found",
        (false, false) => "no difference found in what was compared",
    }
}

/// In what the tensors are equal that are counted as equal.
pub(super) const fn equal(bytes: ComparedBytes) -> &'static str {
    match bytes {
        ComparedBytes::Sampled => "equal in type, shape, and their first, middle and last bytes (--bytes compares all)",
        ComparedBytes::All | ComparedBytes::Measured | ComparedBytes::Ranked => "equal in type, shape and bytes",
    }
}

/// The tensors that a loader turns into the same ones, in a sentence.
pub(super) fn conversion(found: &Converted) -> String {
    let (one, other) = (plural(found.before, "tensor"), plural(found.after, "tensor"));
    format!(
        "{one} of the first and {other} of the second have the same names and shapes once transformers {} has opened them; their bytes were not compared",
        name(&found.loader)
    )
}

fn tensors(out: &mut String, found: &TensorDifferences, style: Style) {
    let counts = format!("{} in the first, {} in the second", plural(found.before, "tensor"), found.after);
    let lines = [counts, format!("{} {}", found.equal, equal(found.bytes))]
        .into_iter()
        .filter(|_| (found.before, found.after) != (0, 0));
    section(out, "tensors", lines, 0, style);
    let renamed = found.renamed.iter().map(|PrefixChange { from, to, tensors }| {
        let change = match (name(from), name(to)) {
            (from, _) if to.is_empty() => format!("{from} removed"),
            (_, to) if from.is_empty() => format!("{to} added"),
            (from, to) => format!("{from} -> {to}"),
        };
        format!("{change} ({})", plural(*tensors, "tensor"))
    });
    section(out, "renamed tensors, by prefix", renamed, 0, style);
    let converted = found.converted.iter().map(conversion);
    section(out, "converted tensors", converted, 0, style);
    section(out, "tensors of the first alone", one_sided(&found.removed, style), 0, style);
    section(out, "tensors of the second alone", one_sided(&found.added, style), 0, style);
    let reshaped = found.reshaped.iter().map(|r| (format!("{} -> {}", shape(&r.before), shape(&r.after)), &*r.name));
    section(out, "tensors of another shape", grouped(reshaped, style), 0, style);
    let recast =
        found.recast.iter().map(|r| (format!("{} -> {}", r.before, r.after), &*r.name, Distances::of(r.by, None)));
    section(out, "tensors of another type", measured(recast, style), 0, style);
    let changed = found.changed.iter().map(|c| (String::new(), &*c.name, Distances::of(c.by, c.rank)));
    section(out, "tensors with other bytes", measured(changed, style), 0, style);
}

fn one_sided(tensors: &[OneSided], style: Style) -> impl Iterator<Item = String> {
    grouped(
        tensors.iter().map(|tensor| {
            let size = tensor.shape.as_deref().map(shape);
            let words: Vec<String> = size.into_iter().chain(tensor.dtype.clone()).collect();
            (words.join(" "), tensor.name.as_str())
        }),
        style,
    )
}

fn grouped<'n>(named: impl Iterator<Item = (String, &'n str)>, style: Style) -> impl Iterator<Item = String> {
    measured(named.map(|(what, tensor)| (what, tensor, None)), style)
}

/// A tensor, and how far it is from its partner where that was measured.
type Apart<'n> = (&'n str, Option<Distances>);

/// How far tensors are apart, and the ranks of their differences, if all were told: the smallest and the largest.
#[derive(Clone, Copy)]
struct Distances {
    by: Distance,
    ranks: Option<[DifferenceRank; 2]>,
}

impl Distances {
    fn of(by: Option<Distance>, rank: Option<DifferenceRank>) -> Option<Self> {
        Some(Self { by: by?, ranks: rank.map(|rank| [rank; 2]) })
    }

    fn and(self, other: Self) -> Self {
        let ranks = self.ranks.zip(other.ranks);
        let ranks = ranks.map(|([least, most], [low, high])| [least.min(low), most.max(high)]);
        Self { by: self.by.and(other.by), ranks }
    }
}

/// One line for the names of the same description, with numbered ones collapsed, and how far they are apart together.
fn measured<'n>(
    named: impl Iterator<Item = (String, &'n str, Option<Distances>)>,
    style: Style,
) -> impl Iterator<Item = String> {
    let mut kinds: Vec<(String, Vec<Apart<'_>>)> = Vec::new();
    for (what, tensor, by) in named {
        match kinds.iter_mut().find(|(kind, _)| *kind == what) {
            Some((_, tensors)) => tensors.push((tensor, by)),
            None => kinds.push((what, vec![(tensor, by)])),
        }
    }
    let room = style.width.map(|width| width.saturating_sub(INDENT));
    kinds.into_iter().flat_map(move |(what, tensors)| {
        let line = move |(group, by): (NameGroup, Option<Distances>)| {
            let counted = if group.count > 1 { format!(" ({} tensors)", group.count) } else { String::new() };
            let pattern = shortened(&name(&group.pattern), room);
            let described = format!("{pattern} {what}").trim_end().to_owned() + &counted;
            by.map_or(described.clone(), |by| format!("{described}: {}", amount(by)))
        };
        collapse_with(tensors, |one, other| Some(one?.and(other?))).into_iter().map(line).collect::<Vec<_>>()
    })
}

/// `relative 0.012, largest 0.030, cosine 0.999928, rank 16`, as docs/inspecting.md explains them.
fn amount(Distances { by, ranks }: Distances) -> String {
    let relative = by.relative().map(|share| format!("relative {}, ", figures(share))).unwrap_or_default();
    let cosine = by.cosine().map(|cosine| format!(", cosine {cosine:.6}")).unwrap_or_default();
    let rank = |rank: DifferenceRank| format!("{}{}", if rank.at_least { "≥ " } else { "" }, rank.rank);
    let rank = ranks.map(|[least, most]| match (rank(least), rank(most)) {
        (least, most) if least == most => format!(", rank {most}"),
        (least, most) => format!(", rank {least} to {most}"),
    });
    format!("{relative}largest {}{cosine}{}", figures(by.largest_difference), rank.unwrap_or_default())
}

/// A number with three decimals, or with an exponent where these would tell little.
pub(super) fn figures(number: f64) -> String {
    if number == 0.0 || (0.001..1000.0).contains(&number) { format!("{number:.3}") } else { format!("{number:.2e}") }
}

/// A title and its lines, if there are any, with the number of `further` ones.
fn section(out: &mut String, title: &str, lines: impl Iterator<Item = String>, further: usize, style: Style) {
    let lines: Vec<String> = lines.collect();
    if lines.is_empty() {
        return;
    }
    let _ok = writeln!(out, "\n  {}", Paint(style.color).strong(title));
    for line in lines.iter().take(style.cap) {
        let wrapped = wrap(line, style.width.map(|width| width.saturating_sub(INDENT)));
        for (number, part) in wrapped.lines().enumerate() {
            let indent = if number == 0 { 4 } else { INDENT };
            let _ok = writeln!(out, "{:indent$}{part}", "");
        }
    }
    if let Some(more) = more(lines.len().saturating_add(further), style.cap) {
        let _ok = writeln!(out, "    {more}");
    }
}

/// A value of a document, shortened; `missing` without one.
pub(super) fn value(value: Option<&Value>) -> String {
    value.map_or_else(|| "missing".to_owned(), |value| escape(&value.to_string(), VALUE))
}
