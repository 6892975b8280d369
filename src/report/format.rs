//! Formatting shared by the renderers: counts, sizes, shapes, and lists cut to "and N more".

use std::collections::{BTreeMap, BTreeSet};

use super::collapse::{NameGroup, collapse, collapse_with};
use super::model::{CheckpointReport, Counts, MergeReport, MergeStage, NewRows, Report, TokenIds, Training};
use crate::check::finding::Object;
use crate::check::load::{LoadReport, SilentReason};
use crate::check::verdict::{LoadVerdict, ONLY_FAULTS, ObjectVerdict, PredictedLoad, is_program};
use crate::check::{Finding, FixHint, Location};
use crate::checkpoint::escape;
pub use crate::checkpoint::file_size as bytes;

/// Maximum length of a name, in characters.
const NAME: usize = 160;
/// Maximum length of a sentence, in characters.
const SENTENCE: usize = 1_000;

/// A name from a checkpoint, escaped for display.
pub fn name(text: &str) -> String {
    escape(text, NAME)
}

/// A sentence that may quote a checkpoint, escaped for display.
pub fn sentence(text: &str) -> String {
    escape(text, SENTENCE)
}

/// Whether a character controls a terminal, or hides or reorders text.
pub fn hostile(c: char) -> bool {
    c.is_control() || (!c.is_ascii() && !escape(c.encode_utf8(&mut [0; 4]), 1).starts_with(c))
}

/// Breaks text at spaces into lines shorter than `width` characters, except for longer words.
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

/// A name of at most `width` characters: of a longer one, its start and its end, of which the end tells more.
pub fn shortened(text: &str, width: Option<usize>) -> String {
    let long = text.chars().count();
    let Some(width) = width.filter(|width| long > *width) else { return text.to_owned() };
    let kept = width.saturating_sub(1);
    let first = kept / 3;
    let start: String = text.chars().take(first).collect();
    let end: String = text.chars().skip(long.saturating_sub(kept.saturating_sub(first))).collect();
    format!("{start}…{end}")
}

/// `1 shard`, `2 shards`.
pub fn plural(n: usize, noun: &str) -> String {
    if n == 1 { format!("1 {noun}") } else { format!("{n} {noun}s") }
}

/// A number with two decimals in the first unit that it reaches: `7.08 billion`.
pub fn scaled(n: u64, units: [(&str, u64); 3]) -> String {
    let Some((unit, size)) = units.into_iter().find(|(_, size)| n >= *size) else { return n.to_string() };
    let hundredths = u128::from(n).saturating_mul(100).checked_div(u128::from(size)).unwrap_or_default();
    let (whole, rest) = (hundredths / 100, hundredths % 100);
    format!("{whole}.{rest:02}{unit}")
}

/// `2 errors, 1 warning, 3 info`; empty without findings.
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

/// `[2304, 1152]`.
pub fn shape(dims: &[u64]) -> String {
    const DIMS: usize = 12;
    let mut parts: Vec<String> = dims.iter().take(DIMS).map(u64::to_string).collect();
    parts.extend(more(dims.len(), DIMS));
    format!("[{}]", parts.join(", "))
}

/// `path/file`, or `path` without a file.
pub fn place(path: &str, location: Option<&Location>) -> String {
    match location.and_then(|l| l.file.as_deref()) {
        Some(file) if path.is_empty() || path == "." => name(file),
        Some(file) => format!("{}/{}", name(path).trim_end_matches('/'), name(file)),
        None => name(path),
    }
}

/// The tensors of a finding, with numbered names collapsed; at most `cap` lines, then the number of further ones. None when
/// the message names all of them.
pub fn tensors(message: &str, locations: &[Location], cap: usize) -> Vec<String> {
    let names: Vec<&str> = locations.iter().filter_map(|l| l.tensor.as_deref()).collect();
    let words: BTreeSet<&str> = message.split([' ', ',', ';', ':']).collect();
    if names.iter().all(|name| words.contains(name)) {
        return Vec::new();
    }
    let groups = collapse(names);
    let mut lines: Vec<String> = groups.iter().take(cap).map(|g| name(&g.pattern)).collect();
    lines.extend(more(groups.len(), cap));
    lines
}

/// Name, treatment, and type and shape before and after of the changed tensors of a merge. Plain casts have their own
/// sentences, [`MergeReport::casts`].
pub fn changed(merge: &MergeReport) -> impl Iterator<Item = [String; 4]> {
    merge.changed.iter().filter(|changed| !changed.is_plain_cast()).map(|changed| {
        let typed = |dtype: Option<&str>, dims: &[u64]| match dtype {
            Some(dtype) => format!("{dtype} {}", shape(dims)),
            None => shape(dims),
        };
        let from = |dims: &Vec<u64>| typed(changed.cast.as_ref().map(|cast| cast.from), dims);
        let to = typed(changed.cast.as_ref().map(|cast| cast.to), &changed.to);
        [name(&changed.name), changed.how(), changed.from.as_ref().map_or_else(|| "new".to_owned(), from), to]
    })
}

/// Name pattern, number of values, and ids of new rows of the tensors to train.
pub fn trained(training: &Training) -> Vec<[String; 3]> {
    let sizes = training.sizes.iter().map(|size| (size.name.as_str(), (size.values, size.new_rows.as_ref())));
    let groups = collapse_with(sizes, |(one, rows), (other, _)| (one.saturating_add(other), rows));
    let row = |(group, (values, rows)): (NameGroup, (u64, Option<&NewRows>))| {
        let new = rows.map(|rows| format!("{} to {}", rows.first, rows.last)).unwrap_or_default();
        [name(&group.pattern), values.to_string(), new]
    };
    groups.into_iter().map(row).collect()
}

/// Text, ids and use of the tokens that prompts and training code name.
pub fn tokens_used(merge: &MergeReport) -> Vec<[String; 3]> {
    let row = |used: &TokenIds| {
        let ids =
            if used.first == used.last { used.first.to_string() } else { format!("{} to {}", used.first, used.last) };
        [used.text.as_deref().map(name).unwrap_or_default(), ids, sentence(&used.used_as.join(", "))]
    };
    merge.tokens_used.iter().map(row).collect()
}

/// Name pattern, stored shape and expected shape of mismatched tensors, grouped by shapes.
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

/// Tensors that load incorrectly without a message, grouped by reason.
pub fn silent(load: &LoadReport) -> Vec<(String, Vec<NameGroup>)> {
    let mut reasons: BTreeMap<SilentReason, Vec<&str>> = BTreeMap::new();
    for one in &load.silent {
        reasons.entry(one.reason).or_default().push(&one.name);
    }
    reasons.into_iter().map(|(reason, names)| (silence(reason).to_owned(), collapse(names))).collect()
}

/// Describes a reason.
const fn silence(reason: SilentReason) -> &'static str {
    match reason {
        SilentReason::IndexedButAbsent => "in the index, but in no shard, so it stays randomly initialised",
        SilentReason::PrefixHijack => {
            "one stray key with the base-model prefix, so every tensor is randomly initialised"
        }
        SilentReason::TiedOver => "tied to another tensor, which overwrites it",
    }
}

/// The verdict of a run, without the final full stop.
pub fn summary(report: &Report) -> String {
    let found = counts(report.summary.counts);
    let checkpoints = plural(report.summary.checkpoints, "checkpoint");
    let checkpoints = match report.summary.suppressed {
        0 => checkpoints,
        n => format!("{checkpoints}, {n} suppressed"),
    };
    let checkpoints = match report.summary.hidden {
        0 => checkpoints,
        n => format!("{checkpoints}, {n} hidden by --min-severity"),
    };
    let checkpoints = match report.summary.unchecked {
        0 => checkpoints,
        n => format!("{checkpoints}; {} could not be checked", plural(n, "path")),
    };
    let outcome = report.merge.as_ref().and_then(outcome);
    match (outcome, found.is_empty()) {
        (None, true) if report.summary.checkpoints == 0 && report.merge.is_none() => {
            format!("Nothing was checked: {checkpoints}")
        }
        (None, true) if report.summary.unchecked > 0 => format!("Found nothing in {checkpoints}"),
        (None, true) => format!("All clean: {checkpoints}"),
        (None, false) => format!("Found {found} in {checkpoints}"),
        (Some(outcome), true) => outcome,
        (Some(outcome), false) => format!("{outcome}. Found {found} in {checkpoints}"),
    }
}

/// Describes the end of a merge; `None` in the report that is written into the result.
fn outcome(merge: &MergeReport) -> Option<String> {
    let size = || format!("{}, {}", plural(merge.tensors, "tensor"), bytes(merge.bytes));
    Some(match merge.stage? {
        MergeStage::Seam => {
            let verb = if merge.seams.len() == 1 { "does" } else { "do" };
            format!("Nothing written: {} {verb} not fit", plural(merge.seams.len(), "seam"))
        }
        MergeStage::Donors => "Nothing written: a donor has errors".to_owned(),
        MergeStage::Planned => "Nothing written: the planned checkpoint has errors".to_owned(),
        MergeStage::DryRun => format!("Nothing written (--dry-run): {} planned", size()),
        MergeStage::Written => format!("Written: {}", size()),
    })
}

/// The details of a finding, escaped for display.
pub fn details(finding: &Finding) -> Vec<String> {
    finding.details.iter().map(|detail| sentence(detail)).collect()
}

/// What a checkpoint is, for its header: the architecture of its class, or an adapter. The name of an architecture is escaped by
/// `escaped`.
pub fn kind(checkpoint: &CheckpointReport, escaped: impl Fn(&str) -> String) -> String {
    let offers = |object| checkpoint.loads.iter().flat_map(|load| &load.objects).any(|one| one.object == object);
    match &checkpoint.architecture {
        Some(architecture) => escaped(architecture),
        None if offers(Object::Adapter) && !offers(Object::Model) => "adapter".to_owned(),
        None => "unknown architecture".to_owned(),
    }
}

/// The findings for the header of a checkpoint, one line each: `info[ARC001]: unknown class …`.
pub fn notes(checkpoint: &CheckpointReport) -> Vec<String> {
    let notes = checkpoint.findings.iter().filter(|finding| finding.is_note());
    notes.map(|note| format!("{}[{}]: {}", note.severity.name(), name(&note.code), sentence(&note.message))).collect()
}

/// At most `cap` findings of each code, and the number of omitted findings by code.
pub fn capped(findings: &[Finding], cap: usize) -> (Vec<&Finding>, Vec<(&str, usize)>) {
    let mut shown = Vec::new();
    let mut seen: BTreeMap<&str, (usize, usize)> = BTreeMap::new();
    for finding in findings {
        let (kept, hidden) = seen.entry(&finding.code).or_default();
        *hidden = hidden.saturating_add(usize::try_from(finding.hidden).unwrap_or(usize::MAX));
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

/// Merges consecutive findings that differ only in their places and in the edits there.
pub fn alike(findings: Vec<&Finding>) -> Vec<Finding> {
    let mut together: Vec<Finding> = Vec::new();
    for finding in findings {
        let step = |f: &Finding| f.fix.as_ref().map(advice);
        let same = |last: &Finding| {
            (&last.code, last.severity, &last.message) == (&finding.code, finding.severity, &finding.message)
                && step(last) == step(finding)
                && last.details == finding.details
        };
        match together.last_mut() {
            Some(last) if same(last) => {
                last.locations.extend(finding.locations.iter().cloned());
                if let Some((all, more)) = last.fix.as_mut().zip(finding.fix.as_ref()) {
                    all.edits.extend(more.edits.iter().cloned());
                }
            }
            _ => together.push(finding.clone()),
        }
    }
    together
}

/// The fixes applied to a checkpoint, and those that were rolled back, one line each.
pub fn fixed(checkpoint: &CheckpointReport) -> Vec<String> {
    let made = together(checkpoint.fixed.iter().map(|f| (&*f.code, f.file.as_deref(), &*f.title)));
    let made = made.into_iter().map(|(many, (code, file, title))| {
        let file = file.map(|file| format!(" in {}", name(file))).unwrap_or_default();
        format!("fixed {}{file}: {}{many}", name(code), sentence(title))
    });
    let withdrawn = checkpoint
        .withdrawn
        .iter()
        .map(|one| format!("not fixed {}: {}; {}", name(&one.code), sentence(&one.title), sentence(&one.reason)));
    made.chain(withdrawn).collect()
}

/// Groups equal lines, with the size of each group.
fn together<T: PartialEq>(lines: impl Iterator<Item = T>) -> Vec<(String, T)> {
    let mut counted: Vec<(usize, T)> = Vec::new();
    for line in lines {
        match counted.iter_mut().find(|(_, other)| *other == line) {
            Some((count, _)) => *count = count.saturating_add(1),
            None => counted.push((1, line)),
        }
    }
    let many = |n: usize| if n > 1 { format!(" ({n} times)") } else { String::new() };
    counted.into_iter().map(|(n, line)| (many(n), line)).collect()
}

/// The checkpoints in the order of the formats for people: the worst first, by severity, verdict and number of findings. The
/// checkpoints of a merge stay in the order of its stages.
pub fn worst_first(report: &Report) -> Vec<&CheckpointReport> {
    let mut sorted: Vec<&CheckpointReport> = report.checkpoints.iter().collect();
    if report.merge.is_none() {
        sorted.sort_by_key(|c| {
            let load = c.loads.iter().map(|load| load.verdict).max();
            std::cmp::Reverse((c.verdict, load, c.counts.error, c.counts.warning, c.counts.info))
        });
    }
    sorted
}

/// The predicted load reports that differ, each with its loaders.
pub fn agreeing(loads: &[PredictedLoad]) -> Vec<(&LoadReport, Vec<&PredictedLoad>)> {
    let mut together: Vec<(&LoadReport, Vec<&PredictedLoad>)> = Vec::new();
    for load in loads {
        let Some(report) = &load.tensors else { continue };
        match together.iter_mut().find(|(first, _)| first.agrees(report)) {
            Some((_, loaders)) => loaders.push(load),
            None => together.push((report, vec![load])),
        }
    }
    together
}

/// `transformers 4.51.3 (judged as 4.47.0) and 5.23.0`.
pub fn versions(loaders: &[&PredictedLoad]) -> String {
    listed(loaders, "transformers ")
}

/// The versions of transformers after `title`, and then the other programs.
fn listed(loaders: &[&PredictedLoad], title: &str) -> String {
    let (programs, own): (Vec<&PredictedLoad>, Vec<&PredictedLoad>) =
        loaders.iter().copied().partition(|load| is_program(&load.loader));
    let names = |loads: Vec<&PredictedLoad>| loads.iter().map(|load| name(&load.version())).collect::<Vec<_>>();
    let own = and(&names(own));
    let programs = and(&names(programs));
    match (own.is_empty(), programs.is_empty()) {
        (false, false) => format!("{title}{own}, and {programs}"),
        (false, true) => format!("{title}{own}"),
        (true, _) => programs,
    }
}

/// `a`, `a and b`, `a, b and c`.
pub fn and<T: AsRef<str>>(items: &[T]) -> String {
    let items: Vec<&str> = items.iter().map(AsRef::as_ref).collect();
    match items.split_last() {
        Some((last, [])) => (*last).to_owned(),
        Some((last, others)) => format!("{} and {last}", others.join(", ")),
        None => String::new(),
    }
}

/// Under which settings the verdict was made: `settings: ckpt-doctor.json5 (175 rules off), 2 suppressed`; `None` when the
/// rules apply as they are.
pub fn governed(checkpoint: &CheckpointReport) -> Option<String> {
    let mut changes = Vec::new();
    if let Some(overrides) = checkpoint.overrides {
        let mut change = |n: usize, one: &str, rest: &str| {
            if n > 0 {
                changes.push(format!("{}{rest}", plural(n, one)));
            }
        };
        change(overrides.rules_off, "rule", " off");
        change(overrides.regraded, "rule", " regraded");
        change(overrides.paths, "path", " with settings of its own");
        if overrides.metadata_only {
            changes.push("weights not required".to_owned());
        }
    }
    let changes = changes.join(", ");
    let by = match (&checkpoint.settings, changes.is_empty()) {
        (Some(file), true) => Some(format!("settings: {}", name(file))),
        (Some(file), false) => Some(format!("settings: {} ({changes})", name(file))),
        (None, true) => None,
        (None, false) => Some(format!("options: {changes}")),
    };
    let suppressed = (!checkpoint.suppressed.is_empty()).then(|| format!("{} suppressed", checkpoint.suppressed.len()));
    let parts: Vec<String> = by.into_iter().chain(suppressed).collect();
    (!parts.is_empty()).then(|| parts.join(", "))
}

/// The verdicts in one line: `loads with transformers 5.23.0 (raises with 4.57.6)`.
pub fn headline(loads: &[PredictedLoad]) -> String {
    let (first, others) = headlines(loads);
    others.map_or_else(|| first.clone(), |others| format!("{first} {others}"))
}

/// The verdicts on the version that wrote the checkpoint, or on the loaders that the user named, and then in brackets those on
/// other versions. In each, the worst come first and those that are not predicted last.
pub fn headlines(loads: &[PredictedLoad]) -> (String, Option<String>) {
    let (first, others): (Vec<&PredictedLoad>, Vec<&PredictedLoad>) =
        loads.iter().partition(|load| load.leads || is_program(&load.loader));
    if first.is_empty() {
        return (by_verdict(&others, "transformers "), None);
    }
    let leading = by_verdict(&first, "transformers ");
    let title = if leading.contains("transformers ") { "" } else { "transformers " };
    let others = (!others.is_empty()).then(|| format!("({})", by_verdict(&others, title)));
    (leading, others)
}

/// `raises with transformers 5.23.0; loads with 4.47.0`; `title` stands before the first version.
fn by_verdict(loads: &[&PredictedLoad], title: &str) -> String {
    let order = [LoadVerdict::Raises, LoadVerdict::LoadsWrong, LoadVerdict::Loads, LoadVerdict::NotPredicted];
    let mut parts: Vec<String> = Vec::new();
    for verdict in order {
        let loaders: Vec<&PredictedLoad> = loads.iter().copied().filter(|load| load.verdict == verdict).collect();
        if !loaders.is_empty() {
            let title = if parts.iter().any(|part| part.contains("transformers ")) { "" } else { title };
            parts.push(format!("{} with {}", verdict.name(), listed(&loaders, title)));
        }
    }
    parts.join("; ")
}

/// A sentence for each object that does not load, and for a model or adapter that is not predicted; then one for the other objects.
pub fn objects(loads: &[PredictedLoad]) -> Vec<String> {
    let is_beside = |object: Object| !matches!(object, Object::Model | Object::Adapter);
    let mut lines = Vec::new();
    let mut unjudged: Vec<&ObjectVerdict> = Vec::new();
    let mut same: Vec<(&ObjectVerdict, Vec<&PredictedLoad>)> = Vec::new();
    for load in loads {
        for object in &load.objects {
            match same.iter_mut().find(|(one, _)| *one == object) {
                Some((_, loaders)) => loaders.push(load),
                None => same.push((object, vec![load])),
            }
        }
    }
    let failing: Vec<Object> =
        same.iter().filter(|(o, _)| o.verdict > LoadVerdict::NotPredicted).map(|(o, _)| o.object).collect();
    for (object, loaders) in same {
        let of = object.object.name();
        let why = sentence(object.why.as_deref().unwrap_or_default());
        match object.verdict {
            LoadVerdict::Loads => {}
            LoadVerdict::NotPredicted if is_beside(object.object) && object.why.as_deref() == Some(ONLY_FAULTS) => {
                unjudged.push(object);
            }
            LoadVerdict::NotPredicted if is_beside(object.object) && failing.contains(&object.object) => {}
            verdict => {
                let codes: Vec<String> = object.findings.iter().map(|code| name(code)).collect();
                let codes = if codes.is_empty() { String::new() } else { format!(" ({})", codes.join(", ")) };
                lines.push(format!("{of} {} with {}{codes}: {why}", verdict.name(), versions(&loaders)));
            }
        }
    }
    unjudged.retain(|object| !failing.contains(&object.object));
    unjudged.dedup_by_key(|object| object.object);
    if !unjudged.is_empty() {
        let names: Vec<&str> = unjudged.iter().map(|object| object.object.name()).collect();
        lines.push(format!("{} not predicted: {ONLY_FAULTS}", names.join(", ")));
    }
    lines
}

/// `and 3 more`, for a list of `total` items cut at `cap`.
pub fn more(total: usize, cap: usize) -> Option<String> {
    total.checked_sub(cap).filter(|n| *n > 0).map(|n| format!("and {n} more"))
}

/// The edits of a fix with their safety, then the advice for a person.
pub fn advice(hint: &FixHint) -> Vec<String> {
    let title = hint.title.as_ref().map(|title| format!("{} ({} fix)", sentence(title), hint.safety.name()));
    title.into_iter().chain(hint.help.as_deref().map(sentence)).collect()
}

#[cfg(test)]
mod tests {
    use super::{bytes, shortened, wrap};

    #[test]
    fn a_long_name_keeps_its_start_and_its_end() {
        assert_eq!(shortened("model.layers.0.mlp.up_proj.weight", Some(16)), "model…roj.weight");
        assert_eq!(shortened("model.norm", Some(10)), "model.norm");
        assert_eq!(shortened("model.norm", None), "model.norm");
        assert_eq!(["ä".repeat(9), "ab".to_owned()].map(|name| shortened(&name, Some(0))), ["…", "…"]);
    }

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
}
