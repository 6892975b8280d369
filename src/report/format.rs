//! Formatting shared by the renderers: counts, sizes, shapes, evidence, and "and N more".

use std::collections::BTreeMap;

use serde_json::Value;

use super::collapse::{NameGroup, collapse};
use super::model::{Counts, MergeReport, MergeStage, Report};
use crate::check::load::{LoadReport, SilentReason};
use crate::check::{Finding, FixHint, Location, Safety};
use crate::checkpoint::escape;

/// Longest name shown, in characters.
const NAME: usize = 160;
/// Longest sentence shown, in characters.
const SENTENCE: usize = 1_000;
/// Longest evidence value shown, in characters.
const VALUE: usize = 200;
/// Most evidence values shown for one finding.
const VALUES: usize = 8;
/// Most items shown of a list within evidence.
const ITEMS: usize = 6;

/// A name from a checkpoint, safe to show.
pub fn name(text: &str) -> String {
    escape(text, NAME)
}

/// A sentence that may quote a checkpoint, safe to show.
pub fn sentence(text: &str) -> String {
    escape(text, SENTENCE)
}

/// Whether a character steers a terminal, or hides or reorders text.
pub fn hostile(c: char) -> bool {
    c.is_control() || (!c.is_ascii() && !escape(c.encode_utf8(&mut [0; 4]), 1).starts_with(c))
}

/// Breaks text at spaces so that lines stay below `width` characters where words allow it.
pub fn wrap(text: &str, width: Option<usize>) -> String {
    let Some(width) = width else { return text.to_owned() };
    let mut out = String::new();
    let mut used: usize = 0;
    for word in text.split(' ') {
        let long = word.chars().count();
        if used > 0 && used.saturating_add(long) >= width {
            out.push('\n');
            used = 0;
        } else if !out.is_empty() {
            out.push(' ');
        }
        out.push_str(word);
        used = used.saturating_add(long).saturating_add(1);
    }
    out
}

/// `1 shard`, `2 shards`.
pub fn plural(n: usize, noun: &str) -> String {
    if n == 1 { format!("1 {noun}") } else { format!("{n} {noun}s") }
}

/// `2 errors, 1 warning, 3 info`; empty when there is nothing to count.
pub fn counts(counts: Counts) -> String {
    let mut parts = Vec::new();
    if counts.error > 0 {
        parts.push(plural(counts.error, "error"));
    }
    if counts.warning > 0 {
        parts.push(plural(counts.warning, "warning"));
    }
    if counts.info > 0 {
        parts.push(format!("{} info", counts.info));
    }
    parts.join(", ")
}

/// A size in decimal units, three digits: `8.06 GB`.
pub fn bytes(n: u64) -> String {
    const UNITS: [(&str, u64); 5] = [
        ("PB", 1_000_000_000_000_000),
        ("TB", 1_000_000_000_000),
        ("GB", 1_000_000_000),
        ("MB", 1_000_000),
        ("kB", 1_000),
    ];
    let Some((unit, size)) = UNITS.into_iter().find(|(_, size)| n >= *size) else {
        return format!("{n} B");
    };
    let size = u128::from(size);
    let hundredths = u128::from(n).saturating_mul(100).saturating_add(size / 2).checked_div(size).unwrap_or_default();
    let (whole, rest) = (hundredths / 100, hundredths % 100);
    if whole >= 100 {
        format!("{whole} {unit}")
    } else if whole >= 10 {
        format!("{whole}.{} {unit}", rest / 10)
    } else {
        format!("{whole}.{rest:02} {unit}")
    }
}

/// `[2304, 1152]`.
pub fn shape(dims: &[u64]) -> String {
    const DIMS: usize = 12;
    let mut parts: Vec<String> = dims.iter().take(DIMS).map(u64::to_string).collect();
    parts.extend(more(dims.len(), DIMS));
    format!("[{}]", parts.join(", "))
}

/// `path/file`, or what there is of it.
pub fn place(path: &str, location: Option<&Location>) -> String {
    match location.and_then(|l| l.file.as_deref()) {
        Some(file) if path.is_empty() || path == "." => name(file),
        Some(file) => format!("{}/{}", name(path).trim_end_matches('/'), name(file)),
        None => name(path),
    }
}

/// The tensors among locations, numbered ones collapsed, at most `cap` lines and how many more.
pub fn tensors(locations: &[Location], cap: usize) -> Vec<String> {
    let groups = collapse(locations.iter().filter_map(|l| l.tensor.as_deref()));
    let mut lines: Vec<String> = groups.iter().take(cap).map(|g| name(&g.pattern)).collect();
    lines.extend(more(groups.len(), cap));
    lines
}

/// Name pattern, stored and expected shape of the tensors that do not match; alike ones together.
pub fn mismatched(load: &LoadReport) -> Vec<[String; 3]> {
    let mut alike: BTreeMap<(&[u64], &[u64]), Vec<&str>> = BTreeMap::new();
    for m in &load.mismatched {
        alike.entry((&m.stored, &m.expected)).or_default().push(&m.name);
    }
    let rows = alike.into_iter().flat_map(|((stored, expected), names)| {
        collapse(names).into_iter().map(move |g| [name(&g.pattern), shape(stored), shape(expected)])
    });
    rows.collect()
}

/// Silent tensors by reason, in words.
pub fn silent(load: &LoadReport) -> Vec<(String, Vec<NameGroup>)> {
    let mut reasons: BTreeMap<SilentReason, Vec<&str>> = BTreeMap::new();
    for one in &load.silent {
        reasons.entry(one.reason).or_default().push(&one.name);
    }
    reasons.into_iter().map(|(reason, names)| (silence(reason).to_owned(), collapse(names))).collect()
}

/// Why a tensor loads wrong without a message, in words.
const fn silence(reason: SilentReason) -> &'static str {
    match reason {
        SilentReason::IndexedButAbsent => "in the index and in no shard, so it stays randomly initialised",
        SilentReason::PrefixHijack => {
            "one stray key with the base-model prefix, so every tensor is randomly initialised"
        }
        SilentReason::TiedOver => "tied to another tensor, which overwrites it",
    }
}

/// The verdict over everything, as sentences without the last full stop.
pub fn summary(report: &Report) -> String {
    let found = counts(report.summary.counts);
    let checkpoints = plural(report.summary.checkpoints, "checkpoint");
    let checkpoints = match report.summary.suppressed {
        0 => checkpoints,
        n => format!("{checkpoints}, {n} suppressed"),
    };
    let outcome = report.merge.as_ref().and_then(outcome);
    match (outcome, found.is_empty()) {
        (None, true) => format!("All clean: {checkpoints}"),
        (None, false) => format!("Found {found} in {checkpoints}"),
        (Some(outcome), true) => outcome,
        (Some(outcome), false) => format!("{outcome}. Found {found} in {checkpoints}"),
    }
}

/// How a merge ended; `None` in the report that is written with the result.
fn outcome(merge: &MergeReport) -> Option<String> {
    let size = || format!("{}, {}", plural(merge.tensors, "tensor"), bytes(merge.bytes));
    Some(match merge.stage? {
        MergeStage::Seam => {
            let verb = if merge.seams.len() == 1 { "does" } else { "do" };
            format!("Nothing written: {} {verb} not fit", plural(merge.seams.len(), "seam"))
        }
        MergeStage::Donors => "Nothing written: a donor is not sound".to_owned(),
        MergeStage::Planned => "Nothing written: the planned checkpoint is not sound".to_owned(),
        MergeStage::DryRun => format!("Nothing written, as asked: {} planned", size()),
        MergeStage::Written => format!("Written: {}", size()),
    })
}

/// What the message leaves unsaid: `key = value` for each piece of evidence whose value it does not quote.
pub fn evidence(finding: &Finding) -> Vec<String> {
    let mut unsaid: Vec<String> = finding
        .evidence
        .iter()
        .map(|(key, v)| (key, v, value(v)))
        .filter(|(_, v, text)| !quotes(&finding.message, v.as_str().unwrap_or(text)))
        .map(|(key, _, text)| format!("{} = {text}", name(key)))
        .collect();
    let rest = more(unsaid.len(), VALUES);
    unsaid.truncate(VALUES);
    unsaid.extend(rest);
    unsaid
}

/// The findings to show, at most `cap` of each code, and how many of which code are left out.
pub fn capped(findings: &[Finding], cap: usize) -> (Vec<&Finding>, Vec<(&str, usize)>) {
    let mut shown = Vec::new();
    let mut seen: BTreeMap<&str, (usize, usize)> = BTreeMap::new();
    for finding in findings {
        let (kept, hidden) = seen.entry(&finding.code).or_default();
        if *kept < cap {
            *kept = kept.saturating_add(1);
            shown.push(finding);
        } else {
            *hidden = hidden.saturating_add(1);
        }
    }
    let hidden = seen.into_iter().filter(|(_, (_, hidden))| *hidden > 0).map(|(code, (_, hidden))| (code, hidden));
    (shown, hidden.collect())
}

/// Findings that say the same of several places, as one each.
pub fn alike(findings: Vec<&Finding>) -> Vec<Finding> {
    let mut together: Vec<Finding> = Vec::new();
    for finding in findings {
        let step = |f: &Finding| f.fix.as_ref().map(|fix| (fix.safety, fix.title.clone()));
        let same = |last: &Finding| {
            (&last.code, last.severity, &last.message) == (&finding.code, finding.severity, &finding.message)
                && step(last) == step(finding)
                && evidence(last) == evidence(finding)
        };
        match together.last_mut() {
            Some(last) if same(last) => last.locations.extend(finding.locations.iter().cloned()),
            _ => together.push(finding.clone()),
        }
    }
    together
}

/// Load reports of which the loaders say the same, together.
pub fn agreeing(loads: &[LoadReport]) -> Vec<Vec<&LoadReport>> {
    let mut together: Vec<Vec<&LoadReport>> = Vec::new();
    for load in loads {
        match together.iter_mut().find(|group| group.first().is_some_and(|first| first.agrees(load))) {
            Some(group) => group.push(load),
            None => together.push(vec![load]),
        }
    }
    together
}

/// `transformers 4.51.3 (judged as 4.47.0) and 5.23.0`.
pub fn versions(loaders: &[&LoadReport]) -> String {
    let versions: Vec<String> = loaders.iter().map(|load| name(&load.version())).collect();
    format!("transformers {}", versions.join(" and "))
}

/// `and 3 more`, when a list of `total` is cut at `cap`.
pub fn more(total: usize, cap: usize) -> Option<String> {
    total.checked_sub(cap).filter(|n| *n > 0).map(|n| format!("and {n} more"))
}

/// The step a fix proposes, with what kind of fix it is when it is not a manual one.
pub fn fix(hint: &FixHint) -> String {
    let title = sentence(&hint.title);
    if hint.safety == Safety::Manual { title } else { format!("{title} ({} fix)", hint.safety.name()) }
}

fn value(v: &Value) -> String {
    match v {
        Value::String(s) => escape(s, VALUE),
        Value::Array(items) => {
            let mut parts: Vec<String> = items.iter().take(ITEMS).map(value).collect();
            parts.extend(more(items.len(), ITEMS));
            let text = parts.join(", ");
            if items.iter().all(Value::is_string) { text } else { format!("[{text}]") }
        }
        other => escape(&other.to_string(), VALUE),
    }
}

/// Whether `message` holds `text` as a word of its own.
fn quotes(message: &str, text: &str) -> bool {
    let joins = |c: Option<char>| c.is_some_and(|c| c.is_alphanumeric() || c == '_');
    !text.is_empty()
        && message.match_indices(text).any(|(at, _)| {
            let (before, after) = message.split_at(at);
            !joins(before.chars().next_back()) && !joins(after.strip_prefix(text).and_then(|rest| rest.chars().next()))
        })
}

#[cfg(test)]
mod tests {
    use super::{bytes, quotes, wrap};

    #[test]
    fn lines_are_broken_at_spaces_alone() {
        assert_eq!(wrap("one two three", Some(8)), "one two\nthree");
        assert_eq!(wrap("incompressible a", Some(4)), "incompressible\na");
        assert_eq!(wrap("one two three", None), "one two three");
    }

    #[test]
    fn sizes_keep_three_digits() {
        let shown: Vec<String> = [0, 999, 1_000, 12_345, 999_999, 8_055_709_462, u64::MAX].map(bytes).into();
        assert_eq!(shown, ["0 B", "999 B", "1.00 kB", "12.3 kB", "1000 kB", "8.06 GB", "18446 PB"]);
    }

    #[test]
    fn a_figure_inside_a_longer_one_is_not_quoted() {
        assert!(quotes("7 heads do not divide 4096", "4096"));
        assert!(!quotes("7 heads do not divide 4096", "40"));
        assert!(!quotes("anything", ""));
    }
}
