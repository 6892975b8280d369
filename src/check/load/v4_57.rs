//! transformers 4.57.6: `PreTrainedModel._load_pretrained_model`, step by step, on names and shapes.
//!
//! Unlike 4.47 it renames each key of the file once, puts the class's prefix on or takes it off there, and compares in
//! the model's names. Missing and mismatched names are the model's; an unexpected name loses the prefix that was put on.

use std::collections::{BTreeMap, BTreeSet};

use super::pattern::Pattern;
use super::v4::{CORRUPTED, tied_groups};
use super::{LoadReport, Mismatch, Silent, SilentReason, Stored, absent_groups, keys, pattern};
use crate::knowledge::{Evidence, Expected};

pub(super) fn predict(expected: &Expected, stored: &Stored) -> LoadReport {
    let renaming = Renaming::of(expected, stored.names());
    // The last of several keys that come to one name is the one that is read.
    let mut file: BTreeMap<String, &str> = BTreeMap::new();
    let mut unexpected: BTreeSet<String> = BTreeSet::new();
    let mut raises = None;
    for key in stored.names() {
        match renaming.name(key) {
            Renamed::Is(name) => {
                file.insert(name, key);
            }
            Renamed::Outside => {}
            Renamed::Corrupted => raises = Some(CORRUPTED.to_owned()),
        }
    }
    let absent = absent_groups(expected, |name| file.contains_key(name));
    let optional_gone = |name: &str| {
        let group = expected.tensors.get(name).and_then(|t| t.optional.as_deref());
        group.is_some_and(|group| absent.contains(group))
    };
    let in_model = |name: &str| expected.tensors.contains_key(name) && !optional_gone(name);
    let mut missing: Vec<String> =
        expected.tensors.keys().filter(|name| in_model(name) && !file.contains_key(*name)).cloned().collect();
    unexpected.extend(file.keys().filter(|name| !in_model(name)).cloned());
    if renaming.prefix == Prefix::Removed {
        // Whatever they are renamed to.
        unexpected.extend(stored.names().filter(|key| !starts(key, &expected.base_model_prefix)).map(str::to_owned));
    }
    let mut unexpected: Vec<String> = unexpected.into_iter().filter(|name| !expected.buffers.contains(name)).collect();

    let mut silent = Vec::new();
    for group in tied_groups(expected) {
        // One stored tensor stands for all that share its storage.
        if group.iter().any(|name| file.contains_key(*name)) {
            missing.retain(|name| !group.contains(&name.as_str()));
        }
        let kept: Vec<&str> =
            group.iter().filter_map(|name| file.get(*name).copied()).filter(|k| !stored.is_absent(k)).collect();
        let by = kept.first().map(|name| (*name).to_owned());
        let over = |name: &str| Silent { name: name.to_owned(), reason: SilentReason::TiedOver, by: by.clone() };
        silent.extend(kept.into_iter().skip(1).map(over));
    }
    missing.sort();
    pattern::ignore(&mut missing, &expected.ignore_missing);
    pattern::ignore(&mut unexpected, &expected.ignore_unexpected);
    if expected.buffers.iter().any(|name| name.ends_with("rotary_emb.inv_freq")) {
        pattern::ignore(&mut unexpected, &[r"rotary_emb\.inv_freq".to_owned()]);
    }
    if renaming.prefix == Prefix::Added {
        let prefix = format!("{}.", expected.base_model_prefix);
        unexpected =
            unexpected.into_iter().map(|name| name.strip_prefix(&prefix).map_or(name.clone(), str::to_owned)).collect();
    }
    for name in stored.absent().filter(|name| matches!(renaming.name(name), Renamed::Is(n) if in_model(&n))) {
        silent.push(Silent { name: name.to_owned(), reason: SilentReason::IndexedButAbsent, by: None });
    }
    silent.extend(hijacked(expected, stored));
    silent.sort_by(|a, b| (a.reason, &a.name).cmp(&(b.reason, &b.name)));

    let mismatched = mismatched(expected, stored, &renaming);
    LoadReport { missing, unexpected, mismatched, silent, raises, ..LoadReport::default() }
}

/// Tensors whose prefix lets the loader rename the others: they load nowhere, without a message.
fn hijacked(expected: &Expected, stored: &Stored) -> Vec<Silent> {
    let all: BTreeSet<String> = stored.names().map(str::to_owned).collect();
    let recognised = |file: &BTreeSet<String>, most: usize| {
        let renaming = Renaming::of(expected, file.iter().map(String::as_str));
        let is_known =
            |key: &&String| matches!(renaming.name(key), Renamed::Is(name) if expected.tensors.contains_key(&name));
        file.iter().filter(is_known).take(most).count()
    };
    let silent = |name: &str| Silent { name: name.to_owned(), reason: SilentReason::PrefixHijack, by: None };
    keys::hijackers(expected, &all, recognised).into_iter().map(silent).collect()
}

/// Tensors whose shape is not that of the class.
fn mismatched(expected: &Expected, stored: &Stored, renaming: &Renaming<'_>) -> Vec<Mismatch> {
    let mismatch = |(key, shape): (&str, &[u64])| {
        let Renamed::Is(name) = renaming.name(key) else { return None };
        let tensor = expected.tensors.get(&name)?;
        let differs = tensor.shape != shape;
        differs.then(|| Mismatch { name, stored: shape.to_vec(), expected: tensor.shape.clone() })
    };
    stored.shapes().filter_map(mismatch).collect()
}

/// The stored tensors under the class's names.
pub(super) fn in_model(expected: &Expected, stored: &Stored) -> Evidence {
    let renaming = Renaming::of(expected, stored.names());
    let shapes: BTreeMap<&str, &[u64]> = stored.shapes().collect();
    let names: BTreeSet<&str> = stored.names().chain(shapes.keys().copied()).collect();
    let named = |key: &str| match renaming.name(key) {
        Renamed::Is(name) => (name, shapes.get(key).map(|s| s.to_vec())),
        Renamed::Outside | Renamed::Corrupted => (key.to_owned(), shapes.get(key).map(|s| s.to_vec())),
    };
    names.into_iter().map(named).collect()
}

/// How names of the file and of the class differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Prefix {
    /// They do not.
    Same,
    /// The file holds a base model, the class a head too: names of the file gain the prefix.
    Added,
    /// The file holds a larger model: its names lose the prefix, and those without it are not looked at.
    Removed,
}

/// What becomes of a key of the file.
enum Renamed {
    /// It has this name in the model.
    Is(String),
    /// It is left out: it does not lie in the base model.
    Outside,
    /// The loader raises.
    Corrupted,
}

/// All renamings of one load (`_get_key_renaming_mapping`).
struct Renaming<'e> {
    expected: &'e Expected,
    /// The class's own patterns, and what the matched text becomes.
    mapping: Vec<(Pattern, String)>,
    prefix: Prefix,
}

impl<'e> Renaming<'e> {
    /// By whether any key of the file starts with the prefix, as it stands there; the loader does not ask for a dot.
    fn of<'n>(expected: &'e Expected, mut names: impl Iterator<Item = &'n str>) -> Self {
        let name = expected.base_model_prefix.as_str();
        let has = names.any(|key| key.starts_with(name));
        let prefix = match (has, expected.has_head) {
            _ if name.is_empty() => Prefix::Same,
            (false, true) => Prefix::Added,
            (true, false) => Prefix::Removed,
            _ => Prefix::Same,
        };
        let rows = expected.conversions.iter().filter_map(|row| {
            let (from, to) = (row.from.first()?, row.to.first()?);
            Some((Pattern::new(from)?, to.clone()))
        });
        Self { expected, mapping: rows.collect(), prefix }
    }

    fn name(&self, key: &str) -> Renamed {
        let mut name = renamed(key);
        for (pattern, to) in &self.mapping {
            if let Some(replaced) = pattern.replace_all(&name, to) {
                name = replaced;
                break;
            }
        }
        let prefix = self.expected.base_model_prefix.as_str();
        match self.prefix {
            Prefix::Same => Renamed::Is(name),
            Prefix::Added => {
                let of_head = self.expected.tensors.contains_key(&name) && !starts(&name, prefix);
                let full = format!("{prefix}.{name}");
                if of_head && !self.expected.tensors.contains_key(&full) {
                    return Renamed::Corrupted;
                }
                Renamed::Is(full)
            }
            Prefix::Removed => match name.strip_prefix(prefix).and_then(|rest| rest.strip_prefix('.')) {
                Some(inner) => Renamed::Is(inner.to_owned()),
                None => Renamed::Outside,
            },
        }
    }
}

fn starts(name: &str, prefix: &str) -> bool {
    name.strip_prefix(prefix).is_some_and(|rest| rest.starts_with('.'))
}

/// A key after the first of four renamings of its end (`_fix_state_dict_key_on_load`); all places of the text change.
fn renamed(key: &str) -> String {
    const RENAMES: [(&str, &str); 4] = [
        ("LayerNorm.beta", "LayerNorm.bias"),
        ("LayerNorm.gamma", "LayerNorm.weight"),
        ("weight_g", "parametrizations.weight.original0"),
        ("weight_v", "parametrizations.weight.original1"),
    ];
    let found = RENAMES.iter().find(|(from, _)| key.ends_with(from));
    found.map_or_else(|| key.to_owned(), |(from, to)| key.replace(from, to))
}
