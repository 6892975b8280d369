//! The load report: what `from_pretrained` would say of a checkpoint's tensors, and what it would not.
//!
//! Follows `PreTrainedModel._load_pretrained_model` of transformers 4.47.0 step by step, on names and shapes alone.

mod keys;
mod stored;

use std::collections::{BTreeMap, BTreeSet};

use super::finding::{LoadReport, Mismatch, Silent};
use crate::checkpoint::{Fault, Place};
use crate::knowledge::Expected;
use keys::Spelling;

pub use stored::Stored;

/// Names in the message of one fault.
const NAMES_SHOWN: usize = 5;

/// What transformers 4.47.0 says when a class with a head is given base-model keys without prefix, and the head.
const CORRUPTED: &str = "ValueError: The state dictionary of the model you are trying to load is corrupted. Are you sure it was properly saved?";

/// Predicts the loader's lists for a class and the tensors it is given.
///
/// Names are spelled as the loader spells them: as in the file, after its textual renames.
/// Unlike the loader, `mismatched` also has tensors that it would only meet in the exception it raises.
#[must_use]
pub fn predict(expected: &Expected, stored: &Stored) -> LoadReport {
    // File keys after the textual renames; the loader knows no others.
    let file: BTreeSet<String> = stored.names().map(keys::renamed).collect();
    let spelling = Spelling::of(expected, &file);
    let groups = present_groups(expected, &file);
    let in_class =
        || expected.tensors.iter().filter(|(_, t)| t.optional.as_ref().is_none_or(|g| groups.contains(g.as_str())));

    let model: BTreeMap<String, &str> = in_class().map(|(name, _)| (spelling.in_file(name), name.as_str())).collect();
    let buffers: BTreeSet<String> = expected.buffers.iter().map(|name| spelling.in_file(name)).collect();
    let mut missing: Vec<String> = model.keys().filter(|name| !file.contains(*name)).cloned().collect();
    let unexpected: Vec<String> =
        file.iter().filter(|name| !model.contains_key(*name) && !buffers.contains(*name)).cloned().collect();

    let mut silent = Vec::new();
    for group in tied_groups(expected) {
        let group: Vec<String> = group.iter().map(|name| spelling.in_file(name)).collect();
        // One stored tensor stands for all that share its storage.
        if group.iter().any(|name| file.contains(name)) {
            missing.retain(|name| !group.contains(name));
        }
        let kept: Vec<&String> = group.iter().filter(|name| file.contains(*name) && !stored.is_absent(name)).collect();
        silent
            .extend(kept.into_iter().skip(1).map(|name| Silent { name: name.clone(), reason: "tied-over".to_owned() }));
    }
    for name in stored.absent().filter(|name| model.contains_key(&keys::renamed(name))) {
        silent.push(Silent { name: name.to_owned(), reason: "indexed-but-absent".to_owned() });
    }
    for name in keys::hijackers(expected, &file) {
        silent.push(Silent { name: name.to_owned(), reason: "prefix-hijack".to_owned() });
    }
    silent.sort_by(|a, b| (&a.reason, &a.name).cmp(&(&b.reason, &b.name)));

    let mismatched = stored
        .shapes()
        .filter_map(|(name, shape)| {
            let tensor = expected.tensors.get(&spelling.in_model(&keys::renamed(name)))?;
            let differs = tensor.shape != shape;
            differs.then(|| Mismatch { name: name.to_owned(), stored: shape.to_vec(), expected: tensor.shape.clone() })
        })
        .collect();
    let raises = spelling.is_corrupted(expected, &file).then(|| CORRUPTED.to_owned());
    LoadReport { missing, unexpected, mismatched, silent, raises }
}

/// Optional groups of which the file has at least one tensor, with or without the class's prefix.
fn present_groups<'e>(expected: &'e Expected, file: &BTreeSet<String>) -> BTreeSet<&'e str> {
    let prefix = format!("{}.", expected.base_model_prefix);
    let there = |name: &str| {
        file.contains(name)
            || name.strip_prefix(&prefix).is_some_and(|bare| file.contains(bare))
            || file.contains(&format!("{prefix}{name}"))
    };
    expected.tensors.iter().filter_map(|(name, t)| t.optional.as_deref().filter(|_| there(name))).collect()
}

/// Names that share one storage, the one they are tied to first.
fn tied_groups(expected: &Expected) -> Vec<Vec<&str>> {
    let mut groups: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (name, tensor) in &expected.tensors {
        if let Some(to) = &tensor.tied_to {
            groups.entry(to).or_insert_with(|| vec![to]).push(name);
        }
    }
    groups.into_values().collect()
}

/// Faults for the rules to judge: one for each cause, not one for each tensor.
///
/// `indexed-but-absent` is not among them: comparing the index with the shards finds it without a class.
#[must_use]
pub fn faults(report: &LoadReport) -> Vec<Fault> {
    let mut faults = Vec::new();
    for kind in ["prefix-hijack", "tied-over"] {
        let silent = report.silent.iter().filter(|s| s.reason == kind);
        faults.extend(silent.map(|s| Fault::new(kind).at(Place::tensor(&*s.name)).with("tensor", s.name.as_str())));
    }
    if let Some(reason) = &report.raises {
        faults.push(Fault::new("load-raises").with("reason", reason.as_str()));
    }
    // A hijack is the cause of everything else: the lists repeat it a thousand times.
    if !report.silent.iter().any(|s| s.reason == "prefix-hijack") {
        for (kind, names) in [("missing-tensors", &report.missing), ("unexpected-tensors", &report.unexpected)] {
            if !names.is_empty() {
                let mut fault = Fault::new(kind).with("count", names.len()).with("names", listed(names));
                fault.places = names.iter().take(NAMES_SHOWN).map(Place::tensor).collect();
                faults.push(fault);
            }
        }
        faults.extend(report.mismatched.iter().map(|m| {
            let fault = Fault::new("mismatched-tensor").at(Place::tensor(&*m.name)).with("tensor", m.name.as_str());
            fault.with("stored", m.stored.clone()).with("expected", m.expected.clone())
        }));
    }
    faults
}

fn listed(names: &[String]) -> String {
    let shown: Vec<&str> = names.iter().take(NAMES_SHOWN).map(String::as_str).collect();
    match names.len().saturating_sub(shown.len()) {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

#[cfg(test)]
mod tests;
