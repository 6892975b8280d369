//! The page of a check: the table of the models, and what was found in each.

use std::fmt::Write as _;

use super::super::collapse::{NameGroup, collapse};
use super::super::format::{
    self, agreeing, alike, bytes, capped, headline, kind, more, name, notes, objects, plural, summary,
};
use super::super::inspect::count;
use super::super::model::{CheckpointReport, Report, Verdict};
use super::super::overview::{Overview, OverviewRow, shared_folder};
use super::{Column, code, finding, list, merge, page, table, text, titled, verdict, words};
use crate::check::load::LoadReport;
use crate::check::verdict::{LoadVerdict, PredictedLoad};
use crate::checkpoint::files::Object;

/// Findings of one code in one checkpoint, and names in one list.
const CAP: usize = 100;

/// The page of a check or of a merge.
#[must_use]
pub fn render(report: &Report) -> String {
    let mut body = String::new();
    let title = match (&report.merge, report.checkpoints.as_slice()) {
        (Some(merge), _) => format!("Merge {}", name(&merge.recipe)),
        (None, [one]) => name(&one.path),
        (None, several) => plural(several.len(), "checkpoint"),
    };
    let verdict = format!("{}: {}", report.summary.verdict.name(), summary(report));
    if let Some(merge) = &report.merge {
        merge::maps(&mut body, &report.maps);
        merge::render(&mut body, merge);
    } else if let Some(overview) = Overview::of_several(report) {
        models(&mut body, &overview);
    }
    if !report.unchecked.is_empty() {
        let reasons = report.unchecked.iter().map(|path| format!("{}: {}", code(&path.path), words(&path.reason)));
        titled(&mut body, "Not checked", &reasons.collect::<Vec<_>>());
    }
    for (at, checkpoint) in format::worst_first(report).into_iter().enumerate() {
        section(&mut body, checkpoint, &section_id(at));
    }
    page(&title, &verdict, &body)
}

fn section_id(at: usize) -> String {
    format!("model-{}", at.saturating_add(1))
}

/// The table of the models, the worst first as their sections.
fn models(out: &mut String, overview: &Overview<'_>) {
    out.push_str(
        "<div class=\"tools\" data-filters=\"models\" hidden><label>Search <input type=\"search\"></label>\
         <label><input type=\"checkbox\"> with findings only</label><output></output></div>\n<div class=\"tools\"><button type=\"button\" data-fold=\"open\" hidden>Open all</button>\
         <button type=\"button\" data-fold=\"close\" hidden>Close all</button></div>\n<div class=\"wide\" tabindex=\"0\">\
         <table id=\"models\"><caption>Models, and what versions of transformers do with them</caption>\n<thead><tr><th scope=\"col\">model</th><th scope=\"col\">class</th>\
         <th scope=\"col\" class=\"n\">parameters</th><th scope=\"col\" class=\"n\">size</th>",
    );
    for loader in &overview.loaders {
        let _ok = write!(out, "<th scope=\"col\">{}</th>", text(&name(loader)));
    }
    out.push_str(
        "<th scope=\"col\" class=\"n\">errors</th><th scope=\"col\" class=\"n\">warnings</th></tr></thead>\n<tbody>\n",
    );
    let paths: Vec<&str> = overview.rows.iter().map(|row| row.checkpoint.path.as_str()).collect();
    let shared = shared_folder(&paths);
    for (at, row) in overview.rows.iter().enumerate() {
        model(out, row, &overview.loaders, shared, &section_id(at));
    }
    out.push_str("</tbody></table></div>\n");
}

fn model(out: &mut String, row: &OverviewRow<'_>, loaders: &[&str], shared: usize, section: &str) {
    let checkpoint = row.checkpoint;
    let shown = name(checkpoint.path.get(shared..).unwrap_or(&checkpoint.path));
    let (path, class) = (name(&checkpoint.path), row.class().map_or_else(|| "-".to_owned(), name));
    let known = |shown: String| if checkpoint.tensors > 0 { shown } else { "-".to_owned() };
    let clean = if checkpoint.verdict == Verdict::Clean { " data-clean" } else { "" };
    let _ok = write!(
        out,
        "<tr data-find=\"{} {}\" data-section=\"{section}\"{clean}><th scope=\"row\"><a href=\"#{section}\">{}</a></th>\
         <td>{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td>",
        text(&path),
        text(&class),
        text(&shown).replace('/', "/<wbr>"),
        text(&class),
        known(count(checkpoint.parameters)),
        known(bytes(checkpoint.bytes))
    );
    for (loader, worst) in loaders.iter().zip(&row.verdicts) {
        let load = checkpoint.loads.iter().find(|load| load.loader == *loader);
        let Some((worst, load)) = worst.zip(load) else {
            out.push_str("<td></td>");
            continue;
        };
        // The model is the verdict, unless another object has a worse one.
        let others =
            load.objects.iter().filter(|one| one.object != Object::Model && one.verdict >= LoadVerdict::LoadsWrong);
        let others: Vec<String> = others.map(|one| format!("{} {}", one.object.name(), one.verdict.name())).collect();
        let small = if others.is_empty() { String::new() } else { format!("<small>{}</small>", others.join(", ")) };
        let _ok = write!(out, "<td>{}{small}</td>", verdict(worst));
    }
    let counts = checkpoint.counts;
    let _ok = writeln!(out, "<td class=\"n\">{}</td><td class=\"n\">{}</td></tr>", counts.error, counts.warning);
}

fn section(out: &mut String, checkpoint: &CheckpointReport, id: &str) {
    let title = match &checkpoint.role {
        Some(role) => text(&role.to_string()),
        None => code(&checkpoint.path),
    };
    let word = checkpoint.verdict.name();
    let class = match checkpoint.verdict {
        Verdict::Clean => "good",
        Verdict::Info | Verdict::NotChecked => "unknown",
        Verdict::Warning => "warning",
        Verdict::Error => "bad",
    };
    let _ok = writeln!(
        out,
        "<section id=\"{id}\"><h2>{title} <span class=\"badge {class}\">{word}</span></h2>\n<p>{}, {}, {}</p>",
        kind(checkpoint, |architecture| text(&name(architecture))),
        plural(checkpoint.tensors, "tensor"),
        bytes(checkpoint.bytes)
    );
    if !checkpoint.loads.is_empty() {
        let _ok = writeln!(out, "<p>{}</p>", words(&headline(&checkpoint.loads)));
    }
    by_object(out, &checkpoint.loads);
    let mut said = objects(&checkpoint.loads);
    said.extend(notes(checkpoint));
    said.extend(format::governed(checkpoint));
    said.extend(format::fixed(checkpoint));
    list(out, &said.iter().map(|line| text(line)).collect::<Vec<_>>());
    let (shown, hidden) = capped(&checkpoint.findings, CAP);
    for finding in alike(shown.into_iter().filter(|finding| !finding.is_note()).collect()) {
        finding::render(out, &finding, checkpoint);
    }
    for (code, n) in hidden {
        let _ok = writeln!(out, "<p class=\"dim\">and {n} more {}</p>", text(&name(code)));
    }
    for (load, loaders) in agreeing(&checkpoint.loads) {
        lists(out, load, &loaders);
    }
    out.push_str("</section>\n");
}

/// The verdict of each loader on each object.
fn by_object(out: &mut String, loads: &[PredictedLoad]) {
    let mut objects: Vec<Object> = loads.iter().flat_map(|load| load.objects.iter().map(|one| one.object)).collect();
    objects.sort_unstable();
    objects.dedup();
    let named: Vec<String> = loads.iter().map(|load| name(&load.loader)).collect();
    let mut columns = vec![("object", Column::Left)];
    columns.extend(named.iter().map(|loader| (loader.as_str(), Column::Left)));
    let row = |object: &Object| {
        let of = |load: &PredictedLoad| {
            let found = load.objects.iter().find(|one| one.object == *object);
            found.map_or_else(String::new, |one| verdict(one.verdict))
        };
        std::iter::once(object.name().to_owned()).chain(loads.iter().map(of)).collect()
    };
    table(out, "Objects by version", &columns, &objects.iter().map(row).collect::<Vec<_>>());
}

/// The lists of a load report.
fn lists(out: &mut String, load: &LoadReport, loaders: &[&PredictedLoad]) {
    if load.lengths() == [0; 4] {
        return;
    }
    let [missing, unexpected, mismatched, silent] = load.lengths();
    let _ok = writeln!(
        out,
        "<details><summary>Predicted load by {}: {missing} missing, {unexpected} unexpected, {mismatched} mismatched, {silent} \
         silent</summary>",
        text(&format::versions(loaders))
    );
    if let Some(exception) = &load.raises {
        let _ok = writeln!(out, "<p>Before it reports any of these, the loader raises: {}</p>", words(exception));
    }
    let groups = |out: &mut String, title: &str, groups: &[NameGroup], unlisted: usize| {
        let item = |group: &NameGroup| match group.count {
            1 => code(&group.pattern),
            n => format!("{} ({n})", code(&group.pattern)),
        };
        let mut items: Vec<String> = groups.iter().take(CAP).map(item).collect();
        items.extend(more(groups.len(), CAP));
        items.extend((unlisted > 0).then(|| format!("and {unlisted} tensors that are not listed")));
        if !items.is_empty() {
            let _ok = writeln!(out, "<h3>{}</h3>", text(title));
            list(out, &items);
        }
    };
    let collapsed = |names: &[String]| collapse(names.iter().map(String::as_str));
    let further = load.unlisted;
    groups(out, "Missing: initialised with random values", &collapsed(&load.missing), further.missing);
    groups(out, "Unexpected: ignored", &collapsed(&load.unexpected), further.unexpected);
    let rows: Vec<Vec<String>> = format::mismatched(load)
        .into_iter()
        .take(CAP)
        .map(|[tensor, stored, expected]| vec![code(&tensor), text(&stored), text(&expected)])
        .collect();
    let columns = [("tensor", Column::Left), ("stored", Column::Left), ("expected", Column::Left)];
    table(out, "Mismatched: the loader raises an exception", &columns, &rows);
    for (reason, names) in format::silent(load) {
        groups(out, &format!("Silent, loaded without a warning: {}", name(&reason)), &names, 0);
    }
    out.push_str("</details>\n");
}
