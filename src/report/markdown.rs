//! Renders reports as Markdown. The output contains no times, so that `merge-report.md` inside a merged checkpoint is
//! reproducible; the merge omits the names of directories from it.

use std::fmt::Write as _;

use super::collapse::{NameGroup, collapse};
use super::format::{self, advice, bytes, capped, details, more, name, plural, sentence, shape, summary, tensors};
use super::model::{CheckpointReport, MergeReport, NewRows, Report, ShapedName, Training};
use super::overview::Overview;
use crate::check::load::LoadReport;
use crate::check::verdict::{LoadVerdict, PredictedLoad, is_program};
use crate::check::{Finding, Location};

pub fn render(report: &Report, cap: usize) -> String {
    let mut out = String::new();
    if let Some(merge) = &report.merge {
        merged(&mut out, merge, cap);
    } else {
        out.push_str("# Checkpoint report\n");
    }
    if let Some(overview) = Overview::of_several(report) {
        checkpoints(&mut out, &overview);
    }
    if !report.unchecked.is_empty() {
        let _ok = writeln!(out, "\n## Not checked\n");
        for path in &report.unchecked {
            let _ok = writeln!(out, "- {}: {}", code(&name(&path.path)), text(&sentence(&path.reason)));
        }
    }
    for checkpoint in format::worst_first(report) {
        section(&mut out, checkpoint, cap);
    }
    let _ok = writeln!(out, "\n---\n\nVerdict: **{}**. {}.", report.summary.verdict.name(), summary(report));
    let _ok = writeln!(out, "\n{} {}", report.tool.name, report.tool.version);
    out
}

/// The table of several checkpoints.
fn checkpoints(out: &mut String, overview: &Overview<'_>) {
    let loaders = overview.loaders.iter().map(|loader| {
        let title = if is_program(loader) { "" } else { "transformers " };
        format!("{title}{}", text_name(loader))
    });
    let mut header: Vec<String> = ["model", "class", "parameters", "size"].map(str::to_owned).into();
    header.extend(loaders);
    header.extend(["errors", "warnings"].map(str::to_owned));
    let _ok = writeln!(out, "\n| {} |\n|{}", header.join(" | "), " --- |".repeat(header.len()));
    for row in &overview.rows {
        let checkpoint = row.checkpoint;
        let known = |text: String| if checkpoint.tensors > 0 { text } else { "-".to_owned() };
        let mut cells = vec![
            code(&name(&checkpoint.path)),
            row.class().map_or_else(|| "-".to_owned(), text_name),
            known(checkpoint.parameters.to_string()),
            known(bytes(checkpoint.bytes)),
        ];
        cells.extend(row.verdicts.iter().map(|verdict| verdict.map_or("", LoadVerdict::name).to_owned()));
        cells.extend([checkpoint.counts.error, checkpoint.counts.warning].map(|n| n.to_string()));
        let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
        let _ok = writeln!(out, "| {} |", cells.join(" | "));
    }
}

fn section(out: &mut String, checkpoint: &CheckpointReport, cap: usize) {
    let title = match &checkpoint.role {
        Some(role) => text(&role.to_string()),
        None => code(&name(&checkpoint.path)),
    };
    let kind = format::kind(checkpoint, text_name);
    let verdict = checkpoint.verdict.name();
    let _ok = writeln!(out, "\n## {title}: {verdict}");
    if !checkpoint.loads.is_empty() {
        let _ok = writeln!(out, "\nVerdict: {}", text(&format::headline(&checkpoint.loads)));
    }
    let _ok = writeln!(out, "\n{kind}, {}, {}", plural(checkpoint.tensors, "tensor"), bytes(checkpoint.bytes));
    let mut objects = format::objects(&checkpoint.loads);
    objects.extend(format::notes(checkpoint));
    objects.extend(format::fixed(checkpoint));
    if !objects.is_empty() {
        out.push('\n');
    }
    for line in objects {
        let _ok = writeln!(out, "- {}", text(&line));
    }
    if let Some(governed) = format::governed(checkpoint) {
        let _ok = writeln!(out, "\n{}", text(&governed));
    }
    let (shown, hidden) = capped(&checkpoint.findings, cap);
    for finding in format::alike(shown.into_iter().filter(|finding| !finding.is_note()).collect()) {
        render_finding(out, &finding);
    }
    for (code, n) in hidden {
        let _ok = writeln!(out, "\nand {n} more {}", text_name(code));
    }
    for (load, loaders) in format::agreeing(&checkpoint.loads) {
        render_load(out, load, &loaders, cap);
    }
}

fn render_finding(out: &mut String, finding: &Finding) {
    const PLACES: usize = 6;
    let _ok = writeln!(
        out,
        "\n### {}[{}]: {}\n",
        finding.severity.name(),
        text_name(&finding.code),
        text(&sentence(&finding.message))
    );
    let _ok = writeln!(out, "- rule: {}", text_name(&finding.name));
    let mut places: Vec<String> = Vec::new();
    for place in finding.locations.iter().filter_map(place) {
        if places.last() != Some(&place) {
            places.push(place);
        }
    }
    for place in places.iter().take(PLACES) {
        let _ok = writeln!(out, "- at: {place}");
    }
    if let Some(more) = more(places.len(), PLACES) {
        let _ok = writeln!(out, "- {more}");
    }
    for tensor in tensors(&finding.message, &finding.locations, PLACES) {
        let _ok = writeln!(out, "- tensor: {}", code(&tensor));
    }
    for detail in details(finding) {
        let _ok = writeln!(out, "- note: {}", text(&detail));
    }
    for step in finding.fix.iter().flat_map(advice) {
        let _ok = writeln!(out, "- help: {}", text(&step));
    }
}

fn place(location: &Location) -> Option<String> {
    let mut parts = Vec::new();
    if let Some(file) = &location.file {
        let mut at = name(file);
        for n in [location.line, location.column].into_iter().map_while(|n| n) {
            let _ok = write!(at, ":{n}");
        }
        parts.push(code(&at));
    }
    parts.extend(location.pointer.as_deref().filter(|p| !p.is_empty()).map(|p| code(&name(p))));
    (!parts.is_empty()).then(|| parts.join(" "))
}

fn render_load(out: &mut String, load: &LoadReport, loaders: &[&PredictedLoad], cap: usize) {
    let versions = text(&format::versions(loaders));
    let [missing, unexpected, mismatched, silent] = load.lengths();
    if load.lengths() == [0; 4] {
        return;
    }
    let _ok = writeln!(
        out,
        "\nPredicted load by {versions}: {missing} missing, {unexpected} unexpected, {mismatched} mismatched, {silent} silent"
    );
    if let Some(exception) = &load.raises {
        let _ok = writeln!(out, "\nBefore it reports any of these, the loader raises: {}", text(&sentence(exception)));
    }
    let names = |list: &[String]| collapse(list.iter().map(String::as_str));
    groups(out, "Missing: the loader initialises these with random values", &names(&load.missing), cap);
    unlisted(out, load.unlisted.missing);
    groups(out, "Unexpected: the loader ignores these", &names(&load.unexpected), cap);
    unlisted(out, load.unlisted.unexpected);
    if !load.mismatched.is_empty() {
        let rows: Vec<_> = format::mismatched(load)
            .into_iter()
            .map(|[tensor, stored, expected]| [code(&tensor), stored, expected])
            .collect();
        let _ok = writeln!(out, "\nMismatched: the loader raises an exception");
        table(out, ["tensor", "stored", "expected"], &rows, cap);
        unlisted(out, load.unlisted.mismatched);
    }
    for (reason, names) in format::silent(load) {
        groups(out, &format!("Silent, loaded without a warning: {}", text(&reason)), &names, cap);
    }
    unlisted(out, load.unlisted.silent);
}

/// The number of names that the report does not have.
fn unlisted(out: &mut String, count: usize) {
    if count > 0 {
        let _ok = writeln!(out, "\nAnd {count} tensors that are not listed.");
    }
}

fn groups(out: &mut String, title: &str, groups: &[NameGroup], cap: usize) {
    if groups.is_empty() {
        return;
    }
    let _ok = writeln!(out, "\n{title}\n");
    for group in groups.iter().take(cap) {
        let times = if group.count > 1 { format!(" ({})", group.count) } else { String::new() };
        let _ok = writeln!(out, "- {}{times}", code(&name(&group.pattern)));
    }
    if let Some(more) = more(groups.len(), cap) {
        let _ok = writeln!(out, "- {more}");
    }
}

fn merged(out: &mut String, merge: &MergeReport, cap: usize) {
    let _ok = writeln!(out, "# Merge report: {}", text_name(&merge.recipe));
    if !merge.donors.is_empty() {
        let donors = merge.donors.iter().map(|(role, path)| [text_name(role), code(&name(last(path)))]);
        table(out, ["donor", "directory"], &donors.collect::<Vec<_>>(), cap);
    }
    if !merge.options.is_empty() {
        let options: Vec<_> = merge.options.iter().map(|(k, v)| [text_name(k), code(&name(v))]).collect();
        table(out, ["option", "value"], &options, cap);
    }
    let _ok = writeln!(out, "\n## Stages\n");
    for (n, stage) in (1_usize..).zip(&merge.stages).take(cap) {
        let _ok = writeln!(out, "{n}. {}: {}", text_name(&stage.name), text(&sentence(&stage.outcome)));
    }
    seams(out, merge, cap);
    merged_tensors(out, merge, cap);
    sentences(out, "Repaired", &merge.repairs, cap);
    sentences(out, "Notes", &merge.notes, usize::MAX);
    training(out, merge);
    tokens_used(out, merge);
    usage(out, merge);
    if !merge.files.is_empty() {
        let rows: Vec<_> = merge.files.iter().map(|f| [code(&name(&f.name)), text(&sentence(&f.origin))]).collect();
        let _ok = writeln!(out, "\n## Files");
        table(out, ["file", "from"], &rows, cap);
    }
}

/// The tensors of a merge: their transforms, and those that were dropped.
fn merged_tensors(out: &mut String, merge: &MergeReport, cap: usize) {
    if !merge.transforms.is_empty() {
        let how: Vec<String> = merge.transforms.iter().map(|(how, n)| format!("{n} {}", how.name())).collect();
        let (tensors, size) = (plural(merge.tensors, "tensor"), bytes(merge.bytes));
        let _ok = writeln!(out, "\n## Tensors\n\n{tensors}, {size}: {}", how.join(", "));
    }
    for cast in merge.casts() {
        let _ok = writeln!(out, "\n{cast}");
    }
    let changed: Vec<_> =
        format::changed(merge).map(|[tensor, how, from, to]| [code(&tensor), how, from, to]).collect();
    if !changed.is_empty() {
        table(out, ["changed tensor", "how", "from", "to"], &changed, cap);
    }
    if !merge.dropped.is_empty() {
        let dropped = merge.dropped.iter();
        let row = dropped
            .map(|d| [text_name(&d.donor), code(&name(&d.pattern)), d.count.to_string(), text(&sentence(&d.why))]);
        let _ok = writeln!(out, "\n## Dropped");
        table(out, ["donor", "tensors", "count", "why"], &row.collect::<Vec<_>>(), cap);
    }
}

/// The tensors to train, with the lines of Python that select them.
pub(super) fn training(out: &mut String, merge: &MergeReport) {
    let Some(training) = &merge.training else { return };
    let Some(pattern) = &training.pattern else { return };
    let (train, all) = (training.train.len(), plural(merge.tensors, "tensor"));
    let _ok = writeln!(
        out,
        "\n## Training\n\n{train} of {all}, with {} parameters, have new values, or meet tensors of another donor, and must \
         be trained. The others can be frozen meanwhile.",
        training.values()
    );
    let rows: Vec<_> =
        format::trained(training).into_iter().map(|[names, values, new]| [code(&names), values, new]).collect();
    table(out, ["tensor", "parameters", "new rows"], &rows, usize::MAX);
    let lines = [
        "import re".to_owned(),
        format!("train = re.compile({})", python_string(pattern)),
        "for name, p in model.named_parameters(): p.requires_grad_(train.match(name) is not None)".to_owned(),
    ];
    block(out, &lines);
    let models = match training.versions.as_slice() {
        [] => String::new(),
        versions => format!(", and those in models of transformers {}", format::and(versions)),
    };
    let _ok = writeln!(
        out,
        "\nThe names are those in the files{models}. Another version may rename tensors when it loads them: compare them with \
         `model.named_parameters()` first."
    );
    new_rows(out, training);
}

/// The lines of Python that train no other rows of a tensor than the new ones.
fn new_rows(out: &mut String, training: &Training) {
    let names = |(name, rows): (&str, &NewRows)| {
        let names = std::iter::once(name).chain(rows.in_models.iter().map(String::as_str));
        names.map(|name| format!("{}: {}", python_string(name), rows.first)).collect::<Vec<_>>()
    };
    let first: Vec<String> = training.with_new_rows().flat_map(names).collect();
    if first.is_empty() {
        return;
    }
    let _ok = writeln!(
        out,
        "\n{} of the parameters are in new rows. To keep the other rows of these tensors as they are, train with weight decay \
         0 for them, and run this first:",
        training.new_values()
    );
    let lines = [
        "import torch".to_owned(),
        format!("first_new = {{{}}}", first.join(", ")),
        "for name, p in model.named_parameters():".to_owned(),
        "    if name in first_new: p.register_hook(lambda grad, n=first_new[name]: grad.index_fill(0, torch.arange(n, device=grad.device), 0))".to_owned(),
    ];
    block(out, &lines);
}

/// The tokens that prompts and training code name.
pub(super) fn tokens_used(out: &mut String, merge: &MergeReport) {
    if merge.tokens_used.is_empty() {
        return;
    }
    out.push_str("\n## Tokens\n");
    let rows: Vec<_> = format::tokens_used(merge)
        .into_iter()
        .map(|[token, ids, used_as]| [if token.is_empty() { token } else { code(&token) }, ids, text(&used_as)])
        .collect();
    table(out, ["token", "id", "used as"], &rows, usize::MAX);
}

/// A string as Python spells it: raw if that is possible. Names of tensors in it may be chosen to end the string.
fn python_string(text: &str) -> String {
    if !text.contains(|c| c == '"' || format::hostile(c)) && !text.ends_with('\\') {
        return format!("r\"{text}\"");
    }
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if format::hostile(c) => {
                let _ok = write!(out, "\\U{:08x}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

/// The statements that load the result.
pub(super) fn usage(out: &mut String, merge: &MergeReport) {
    if !merge.usage.is_empty() {
        out.push_str("\n## Load it like this\n");
        block(out, &merge.usage);
    }
    if !merge.prompt.is_empty() {
        out.push_str("\n## Ask about a picture\n");
        block(out, &merge.prompt);
    }
}

/// A block of Python; characters that no reader would see are replaced.
fn block(out: &mut String, lines: &[String]) {
    let longest = lines.iter().flat_map(|line| line.split(|c| c != '`')).map(str::len).max().unwrap_or(0);
    let fence = "`".repeat(longest.saturating_add(1).max(3));
    let _ok = writeln!(out, "\n{fence}python");
    for line in lines {
        let line: String = line.chars().map(|c| if format::hostile(c) { '\u{fffd}' } else { c }).collect();
        let _ok = writeln!(out, "{line}");
    }
    let _ok = writeln!(out, "{fence}");
}

/// A titled list of sentences; nothing for an empty list.
pub(super) fn sentences(out: &mut String, title: &str, sentences: &[String], cap: usize) {
    if sentences.is_empty() {
        return;
    }
    let _ok = writeln!(out, "\n## {title}\n");
    for one in sentences.iter().take(cap) {
        let _ok = writeln!(out, "- {}", text(&sentence(one)));
    }
    if let Some(more) = more(sentences.len(), cap) {
        let _ok = writeln!(out, "- {more}");
    }
}

fn seams(out: &mut String, merge: &MergeReport, cap: usize) {
    if merge.seams.is_empty() {
        return;
    }
    let _ok = writeln!(out, "\n## Seams that do not fit\n\nNothing was written.");
    for seam in merge.seams.iter().take(cap) {
        let _ok = writeln!(out, "\n### {}", text(&sentence(&seam.message)));
        let row = |what: &str, part: &ShapedName, needed: Option<&[u64]>| {
            [
                what.to_owned(),
                text_name(&part.donor),
                code(&name(&part.name)),
                shape(&part.shape),
                needed.map_or_else(String::new, shape),
            ]
        };
        let tensor = seam.tensor.iter().map(|t| row("mismatch", t, seam.needed.as_deref()));
        let rows: Vec<_> = tensor.chain(seam.meets.iter().map(|m| row("must match", m, None))).collect();
        if !rows.is_empty() {
            table(out, ["", "donor", "tensor", "shape", "needed"], &rows, cap);
        }
        if !seam.options.is_empty() {
            let options: Vec<String> = seam.options.iter().take(cap).map(|o| code(&sentence(o))).collect();
            let _ok = writeln!(out, "\nTry {}", options.join(" or "));
        }
    }
    if let Some(more) = more(merge.seams.len(), cap) {
        let _ok = writeln!(out, "\n{more}");
    }
}

/// A table of at most `cap` rows; cells are Markdown, except that pipes are not escaped yet.
pub(super) fn table<const N: usize>(out: &mut String, header: [&str; N], rows: &[[String; N]], cap: usize) {
    let _ok = writeln!(out, "\n| {} |\n|{}", header.join(" | "), " --- |".repeat(N));
    for row in rows.iter().take(cap) {
        let cells: Vec<String> = row.iter().map(|cell| cell.replace('|', "\\|")).collect();
        let _ok = writeln!(out, "| {} |", cells.join(" | "));
    }
    if let Some(more) = more(rows.len(), cap) {
        let _ok = writeln!(out, "\n{more}");
    }
}

/// The last component of a path.
fn last(path: &str) -> &str {
    path.trim_end_matches('/').rsplit('/').next().unwrap_or(path)
}

pub(super) fn text_name(raw: &str) -> String {
    text(&name(raw))
}

/// Escapes every character that Markdown or HTML would interpret, except pipes (see [`table`]).
pub(super) fn text(plain: &str) -> String {
    let mut out = String::with_capacity(plain.len());
    let mut before = ' ';
    let mut chars = plain.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            // An underscore inside a word has no effect in Markdown.
            '_' if before.is_alphanumeric() && chars.peek().is_some_and(|c| c.is_alphanumeric()) => out.push(c),
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            // An at sign would create a mention.
            '@' => out.push_str("&#64;"),
            '\\' | '`' | '*' | '_' | '[' | ']' | '#' | '~' | '!' | '$' => out.extend(['\\', c]),
            c => out.push(c),
        }
        before = c;
    }
    // A bare URL would become a link.
    out.replace("://", ":&#8203;//").replace("www.", "www&#46;")
}

/// A code span for a text without line breaks.
pub(super) fn code(plain: &str) -> String {
    let longest = plain.split(|c| c != '`').map(str::len).max().unwrap_or(0);
    let fence = "`".repeat(longest.saturating_add(1));
    let pad = if plain.starts_with('`') || plain.ends_with('`') || plain.is_empty() { " " } else { "" };
    format!("{fence}{pad}{plain}{pad}{fence}")
}
