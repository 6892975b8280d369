//! transformers 4.47.0: `PreTrainedModel._load_pretrained_model`, step by step, on names and shapes.
//!
//! Names are spelled as the loader spells them: as in the file, after its textual renames. Unlike the loader,
//! `mismatched` also has tensors that it would only meet in the exception it raises.

use std::collections::{BTreeMap, BTreeSet};

use super::keys::{self, Spelling};
use super::{LoadReport, Mismatch, Silent, SilentReason, Stored, absent_groups, pattern};
use crate::knowledge::{Evidence, Expected};

/// What it says when a class with a head is given base-model keys without prefix, and the head.
pub(super) const CORRUPTED: &str = "ValueError: The state dictionary of the model you are trying to load is corrupted. Are you sure it was properly saved?";

pub(super) fn predict(expected: &Expected, stored: &Stored) -> LoadReport {
    // File keys after the textual renames; the loader knows no others.
    let file: BTreeSet<String> = stored.names().map(keys::renamed).collect();
    let spelling = Spelling::of(expected, &file);
    let prefix = format!("{}.", expected.base_model_prefix);
    let absent = absent_groups(expected, |name| {
        file.contains(name)
            || name.strip_prefix(&prefix).is_some_and(|bare| file.contains(bare))
            || file.contains(&format!("{prefix}{name}"))
    });
    let in_class =
        expected.tensors.iter().filter(|(_, t)| t.optional.as_ref().is_none_or(|g| !absent.contains(g.as_str())));

    let model: BTreeMap<String, &str> = in_class.map(|(name, _)| (spelling.in_file(name), name.as_str())).collect();
    let buffers: BTreeSet<String> = expected.buffers.iter().map(|name| spelling.in_file(name)).collect();
    let mut missing: Vec<String> = model.keys().filter(|name| !file.contains(*name)).cloned().collect();
    let mut unexpected: Vec<String> =
        file.iter().filter(|name| !model.contains_key(*name) && !buffers.contains(*name)).cloned().collect();

    let mut silent = Vec::new();
    for group in tied_groups(expected) {
        let group: Vec<String> = group.iter().map(|name| spelling.in_file(name)).collect();
        // One stored tensor stands for all that share its storage.
        if group.iter().any(|name| file.contains(name)) {
            missing.retain(|name| !group.contains(name));
        }
        let kept: Vec<&String> = group.iter().filter(|name| file.contains(*name) && !stored.is_absent(name)).collect();
        let by = kept.first().map(|name| (*name).clone());
        let over = |name: &String| Silent { name: name.clone(), reason: SilentReason::TiedOver, by: by.clone() };
        silent.extend(kept.into_iter().skip(1).map(over));
    }
    pattern::ignore(&mut missing, &expected.ignore_missing);
    pattern::ignore(&mut unexpected, &expected.ignore_unexpected);
    for name in stored.absent().filter(|name| model.contains_key(&keys::renamed(name))) {
        silent.push(Silent { name: name.to_owned(), reason: SilentReason::IndexedButAbsent, by: None });
    }
    for name in keys::hijackers(expected, &file, |file, most| keys::recognised(expected, file, most)) {
        silent.push(Silent { name: name.to_owned(), reason: SilentReason::PrefixHijack, by: None });
    }
    silent.sort_by(|a, b| (a.reason, &a.name).cmp(&(b.reason, &b.name)));

    let mismatched = stored
        .shapes()
        .filter_map(|(name, shape)| {
            let tensor = expected.tensors.get(&spelling.in_model(&keys::renamed(name)))?;
            let differs = tensor.shape != shape;
            differs.then(|| Mismatch { name: name.to_owned(), stored: shape.to_vec(), expected: tensor.shape.clone() })
        })
        .collect();
    let raises = spelling.is_corrupted(expected, &file).then(|| CORRUPTED.to_owned());
    LoadReport { missing, unexpected, mismatched, silent, raises, ..LoadReport::default() }
}

/// The stored tensors under the class's names.
pub(super) fn in_model(expected: &Expected, stored: &Stored) -> Evidence {
    let file: BTreeSet<String> = stored.names().map(keys::renamed).collect();
    let spelling = Spelling::of(expected, &file);
    let shapes: BTreeMap<&str, &[u64]> = stored.shapes().collect();
    let names: BTreeSet<&str> = stored.names().chain(shapes.keys().copied()).collect();
    let named = |name: &str| (spelling.in_model(&keys::renamed(name)), shapes.get(name).map(|s| s.to_vec()));
    names.into_iter().map(named).collect()
}

/// Names that share one storage, the one they are tied to first.
pub(super) fn tied_groups(expected: &Expected) -> Vec<Vec<&str>> {
    let mut groups: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (name, tensor) in &expected.tensors {
        if let Some(to) = &tensor.tied_to {
            groups.entry(to).or_insert_with(|| vec![to]).push(name);
        }
    }
    groups.into_values().collect()
}
