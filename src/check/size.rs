//! Compares the size that an index states with that of the class: a check of shapes without weights.
//!
//! Without shards, only `metadata.total_size` depends on shapes. A config value that changes no name (the number of
//! key-value heads, the vocabulary) affects nothing else. Git LFS pointers state sizes too, less exactly.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::index::{numbered, single};
use super::load::LoadReport;
use super::load::{self, Stored};
use super::votes::{leaves, with};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::{Architecture, Evidence, Expected};

/// Tensors that may be built while values are tried.
const BUDGET: usize = 400_000;
/// Explanations that are named.
const SHOWN: usize = 6;
/// Values that most often differ, the most likely first: they change no name.
const OFTEN: [&str; 4] = ["/num_key_value_heads", "/vocab_size", "/intermediate_size", "/head_dim"];
/// Endings of buffers that are stored as 64-bit integers.
const INTEGERS: [&str; 3] = ["num_batches_tracked", "position_ids", "relative_position_index"];
/// Bytes of the narrowest and the widest float that weights are kept in without a quantisation scheme.
const FLOATS: (u64, u64) = (2, 4);

/// Compares the size in the index with that of the class, if no shard exists and every name matches.
#[must_use]
pub fn fault(
    checkpoint: &Checkpoint,
    architecture: Architecture<'_>,
    config: &Value,
    expected: &Expected,
    stored: &Stored,
    report: &LoadReport,
) -> Option<Fault> {
    let index = checkpoint.index.as_ref()?;
    // Some programs write 0 for a size that they do not compute.
    let stated = index.total_bytes().filter(|size| *size > 0)?;
    let clean = report.missing.is_empty() && report.unexpected.is_empty() && report.raises.is_none();
    if !clean || stored.shapes().next().is_some() {
        return None;
    }
    let width = width(config)?;
    let here = load::in_model(expected, stored);
    let weighed = Weighed::new(expected, &here)?;
    let sizes = weighed.sizes(width)?;
    let foreign = here.iter().any(|(name, _)| !expected.tensors.contains_key(name));
    // Buffers that some versions save and others do not have are of any size.
    let legitimate = sizes.contains(&stated)
        || weighed.mixed(stated, width)
        || (foreign && sizes.first().is_some_and(|least| stated > *least));
    if legitimate {
        return None;
    }
    let values = explain(architecture, config, expected, stored, stated, width);
    let least = weighed.elements()?.checked_mul(FLOATS.0)?;
    let most = weighed.sizes(FLOATS.1)?.into_iter().max()?;
    // Tensors of several types may take anything in between.
    if values.is_empty() && (least..=most).contains(&stated) {
        return None;
    }
    let mut fault = Fault::new(FaultKind::TotalSizeNotOfClass)
        .at(Place::file(&index.document).pointer("/metadata/total_size"))
        .with("stated", stated)
        .with("computed", *sizes.first()?)
        .with("class", expected.class.as_str());
    let said = |(pointer, value): &(String, Value)| {
        let key = pointer.trim_start_matches('/').replace('/', ".");
        let now = expected.config.pointer(pointer).cloned().unwrap_or_default();
        format!("{key} {value} instead of {now}")
    };
    let rank =
        |(pointer, _): &&(String, Value)| OFTEN.iter().position(|key| pointer.ends_with(key)).unwrap_or(OFTEN.len());
    let mut likely: Vec<&(String, Value)> = values.iter().collect();
    likely.sort_by_key(rank);
    let mut named = likely.into_iter().map(said);
    fault.places.extend(values.iter().map(|(pointer, _)| Place::file(files::CONFIG).pointer(pointer)));
    if let Some(first) = named.next() {
        fault = fault.with("value", first);
    }
    let others: Vec<String> = named.collect();
    if !others.is_empty() {
        fault = fault.with("others", others.join(", or "));
    }
    Some(fault)
}

/// Compares the sizes in Git LFS pointers with the parameters of the class: the weights are not downloaded, so nothing else
/// tells of their shapes. Called when config.json declares no quantisation.
///
/// Floats take 2 or 4 bytes a parameter. The bounds are wider: old saves of GPT-2 have masks, which are no parameters, and
/// LLaVA saves no vision tower.
#[must_use]
pub fn pointer_fault(checkpoint: &Checkpoint, config: &Value, expected: &Expected) -> Option<Fault> {
    let names = weight_pointers(checkpoint);
    let size = |name: &&str| checkpoint.entries.get(*name)?.lfs.as_ref().map(|pointer| pointer.size);
    let bytes = names.iter().try_fold(0_u64, |sum, name| sum.checked_add(size(name)?))?;
    let elements = |tied: bool| {
        let tensors = expected.tensors.values().filter(|tensor| tied || tensor.tied_to.is_none());
        let count = |shape: &[u64]| shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d));
        tensors.map(|t| count(&t.shape)).try_fold(0_u64, |sum, n| sum.checked_add(n?))
    };
    let (least, most) = (elements(false)?, elements(true)?);
    let has_tower = ["vision_config", "mm_vision_tower"].iter().any(|key| config.get(*key).is_some());
    let is_large = bytes > most.checked_mul(5)?;
    // An eighth of the parameters may be missing from what is stored at two bytes each.
    let is_small = !has_tower && bytes.checked_mul(4)? < least.checked_mul(7)?;
    // Of a few parameters, the header of a shard takes as much as they do.
    if names.is_empty() || least < 1 << 20 || !(is_large || is_small) {
        return None;
    }
    let fault = Fault::new(FaultKind::LfsSizesNotOfClass).with("bytes", bytes).with("parameters", least);
    let fault = fault.with("class", expected.class.as_str());
    Some(names.iter().fold(fault, |fault, name| fault.at(Place::file(*name))))
}

/// The Git LFS pointers that stand for all weights: a single file, or every shard of one numbered family.
fn weight_pointers(checkpoint: &Checkpoint) -> Vec<&str> {
    let is_pointer = |name: &&str| checkpoint.entries.get(*name).is_some_and(|entry| entry.lfs.is_some());
    if let Some(single) = single(checkpoint) {
        return Some(single).filter(is_pointer).into_iter().collect();
    }
    let of = |name: &str| numbered(name).map(|(prefix, _, count)| (prefix.to_owned(), count));
    let Some((prefix, count)) = checkpoint.entries.keys().find_map(|name| of(name)) else { return Vec::new() };
    let family = |name: &&str| of(name).is_some_and(|found| found == (prefix.clone(), count));
    let names: Vec<&str> = checkpoint.entries.keys().map(String::as_str).filter(family).collect();
    let is_whole = usize::try_from(count).is_ok_and(|count| count == names.len()) && names.iter().all(is_pointer);
    if is_whole { names } else { Vec::new() }
}

/// Bytes of a value of the type that config.json names; `None` for any but the usual floats, and for more than one.
fn width(config: &Value) -> Option<u64> {
    let mut types: BTreeSet<&str> = BTreeSet::new();
    let configs = std::iter::once(config).chain(config.as_object()?.values().filter(|v| v.is_object()));
    for config in configs {
        types.extend(["torch_dtype", "dtype"].iter().filter_map(|key| config.get(key)?.as_str()));
    }
    let widths: Option<BTreeSet<u64>> = types
        .into_iter()
        .map(|name| match name.strip_prefix("torch.").unwrap_or(name) {
            "bfloat16" | "float16" => Some(2),
            "float32" => Some(4),
            _ => None,
        })
        .collect();
    let widths = widths?;
    widths.first().copied().filter(|_| widths.len() == 1)
}

/// Elements of what is stored of a class.
struct Weighed<'e> {
    /// Floats, each storage once.
    floats: Vec<(&'e str, u64)>,
    /// Integers.
    integers: u64,
    /// Floats in names beyond the first of each storage: those that are stored, and those that are not.
    copies: (u64, u64),
}

impl<'e> Weighed<'e> {
    fn new(expected: &'e Expected, here: &Evidence) -> Option<Self> {
        let mut weighed = Self { floats: Vec::new(), integers: 0, copies: (0, 0) };
        let aliases = || expected.tensors.iter().filter_map(|(name, t)| Some((name, t, t.tied_to.as_deref()?)));
        let shared: BTreeSet<&str> = aliases().filter(|(name, ..)| here.contains(name)).map(|(_, _, to)| to).collect();
        for (name, tensor) in &expected.tensors {
            let elements = tensor.shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d))?;
            let is_here = here.contains(name);
            if let Some(to) = &tensor.tied_to {
                let both = is_here && here.contains(to);
                let copies = if both { &mut weighed.copies.0 } else { &mut weighed.copies.1 };
                *copies = copies.checked_add(elements)?;
            } else if INTEGERS.iter().any(|end| name.ends_with(end)) {
                weighed.integers = weighed.integers.checked_add(if is_here { elements } else { 0 })?;
            } else if is_here || shared.contains(name.as_str()) {
                weighed.floats.push((name, elements));
            }
        }
        Some(weighed)
    }

    fn elements(&self) -> Option<u64> {
        self.floats.iter().try_fold(0_u64, |sum, (_, elements)| sum.checked_add(*elements))
    }

    /// What programs may state, the least first: shared storages once, as often as they are stored, as often as they
    /// are named.
    fn sizes(&self, width: u64) -> Option<Vec<u64>> {
        let mut sizes = BTreeSet::new();
        let floats = self.elements()?;
        for copies in [0, self.copies.0, self.copies.0.checked_add(self.copies.1)?] {
            let bytes = floats.checked_add(copies)?.checked_mul(width)?;
            for integer in [width, 8] {
                sizes.insert(bytes.checked_add(self.integers.checked_mul(integer)?)?);
            }
        }
        Some(sizes.into_iter().collect())
    }

    /// Whether the tensors of one kind, one module or one rank kept in the other float type make the difference, or two
    /// such kinds, or all: a save often keeps the norms in float32, and may have the rotary buffers there too.
    fn mixed(&self, stated: u64, width: u64) -> bool {
        let other = if width == FLOATS.0 { FLOATS.1 } else { FLOATS.0 };
        if self.sizes(other).is_some_and(|sizes| sizes.contains(&stated)) {
            return true;
        }
        let mut groups: BTreeMap<String, u64> = BTreeMap::new();
        for (name, elements) in &self.floats {
            let parts: Vec<&str> = name.split('.').collect();
            let unnumbered: Vec<&str> = parts.iter().map(|p| if p.parse::<u64>().is_ok() { "*" } else { p }).collect();
            let starts = (1..=parts.len()).filter_map(|n| Some(format!("{}.", parts.get(..n)?.join("."))));
            let kind = unnumbered.join(".");
            let word = unnumbered.iter().rev().nth(1).map(|module| format!("*.{module}.*"));
            for group in starts.chain([kind]).chain(word) {
                let sum = groups.entry(group).or_default();
                *sum = sum.saturating_add(*elements);
            }
        }
        let sizes = self.sizes(width).unwrap_or_default();
        // What the tensors of the other type would have to take, for each size that is possible without them.
        let gap = |size: &u64| if other > width { stated.checked_sub(*size) } else { size.checked_sub(stated) };
        let per = width.abs_diff(other);
        let gaps = sizes.iter().filter_map(gap).filter(|gap| gap.checked_rem(per) == Some(0));
        let gaps: Vec<u64> = gaps.filter_map(|gap| gap.checked_div(per)).collect();
        let kinds: BTreeSet<u64> =
            groups.iter().filter(|(group, _)| group.contains('*')).map(|(_, elements)| *elements).collect();
        let all: BTreeSet<u64> = groups.into_values().collect();
        gaps.iter().any(|gap| {
            let rest = |one: &u64| gap.checked_sub(*one).is_some_and(|rest| kinds.contains(&rest));
            all.contains(gap) || kinds.iter().any(rest)
        })
    }
}

/// Values of the config with which the class has the same names and the stated size; at most one for each key.
fn explain(
    architecture: Architecture<'_>,
    config: &Value,
    expected: &Expected,
    stored: &Stored,
    stated: u64,
    width: u64,
) -> Vec<(String, Value)> {
    let mut spent = 0_usize;
    let mut sizes = |pointer: &str, value: u64| -> Option<Vec<u64>> {
        if spent > BUDGET {
            return None;
        }
        spent = spent.saturating_add(expected.tensors.len());
        let config = with(config, &expected.config, pointer, value.into());
        let built = load::build(architecture, &config, stored).ok()?;
        let same = built.tensors.len() == expected.tensors.len()
            && built.tensors.keys().all(|name| expected.tensors.contains_key(name));
        Weighed::new(&built, &load::in_model(&built, stored)).filter(|_| same)?.sizes(width)
    };
    let Some(now) = Weighed::new(expected, &load::in_model(expected, stored)).and_then(|w| w.sizes(width)) else {
        return Vec::new();
    };
    let mut found = Vec::new();
    for pointer in leaves(&expected.config) {
        if found.len() >= SHOWN {
            break;
        }
        let key = pointer.rsplit('/').next().unwrap_or_default();
        let Some(value) = expected.config.pointer(&pointer).and_then(Value::as_u64).filter(|v| *v > 0) else {
            continue;
        };
        if !architecture.speaks_of(key) {
            continue;
        }
        let Some(doubled) = value.checked_mul(2) else { continue };
        let probe = sizes(&pointer, doubled);
        // Sizes that do not follow this value, or that cannot double, imply nothing.
        if probe.as_ref() == Some(&now) {
            continue;
        }
        let candidates = candidates(value, stated, &now, probe.as_deref().unwrap_or_default());
        let fits = candidates.into_iter().find(|v| sizes(&pointer, *v).is_some_and(|sizes| sizes.contains(&stated)));
        if let Some(value) = fits {
            found.push((pointer, value.into()));
        }
    }
    found
}

/// Values worth trying instead of `value`: its doubles and halves, and those that would bridge the gap to the stated size
/// if sizes are linear in the value. `now` are the sizes with the value, `twice` those with twice as much.
fn candidates(value: u64, stated: u64, now: &[u64], twice: &[u64]) -> BTreeSet<u64> {
    let mut candidates: BTreeSet<u64> = (1..=5_u32)
        .flat_map(|n| [value.checked_shl(n), value.checked_shr(n).filter(|v| v.checked_shl(n) == Some(value))])
        .flatten()
        .filter(|v| *v > 0)
        .collect();
    for (at, twice) in now.iter().zip(twice) {
        let step = i128::from(*twice).saturating_sub(i128::from(*at));
        let missing = i128::from(stated).saturating_sub(i128::from(*at)).saturating_mul(i128::from(value));
        let whole = missing.checked_rem(step) == Some(0);
        let moved = missing.checked_div(step).filter(|_| whole).map(|n| n.saturating_add(i128::from(value)));
        candidates.extend(moved.and_then(|v| u64::try_from(v).ok()).filter(|v| *v > 0));
    }
    candidates
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::knowledge::{Library, Loader};

    /// A llama of 1000 rows and one layer: its embedding has 8000 elements, the rest 856.
    fn llama(tied: bool) -> Expected {
        let config = json!({
            "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 8, "intermediate_size": 24,
            "num_hidden_layers": 1, "num_attention_heads": 2, "vocab_size": 1000, "tie_word_embeddings": tied,
        });
        Library::embedded().find(&config, [], Loader::V4_47_0).expect("llama").expect(&config).expect("built")
    }

    fn names(expected: &Expected) -> Evidence {
        expected.tensors.keys().map(|name| (name.clone(), None)).collect()
    }

    #[test]
    fn a_shared_storage_may_be_counted_once_or_as_often_as_it_is_named() {
        let (rest, rows) = (4 * 8 * 8 + 3 * 8 * 24 + 3 * 8, 8000);
        let tied = llama(true);
        let sizes = Weighed::new(&tied, &names(&tied)).and_then(|w| w.sizes(2)).expect("sizes");
        assert_eq!(sizes, [2 * (rest + rows), 2 * (rest + 2 * rows)]);
        let apart = llama(false);
        let sizes = Weighed::new(&apart, &names(&apart)).and_then(|w| w.sizes(2)).expect("sizes");
        assert_eq!(sizes, [2 * (rest + 2 * rows)]);
    }

    #[test]
    fn one_or_two_kinds_in_the_other_type_are_legitimate_and_some_other_difference_is_not() {
        let llama = llama(false);
        let weighed = Weighed::new(&llama, &names(&llama)).expect("sizes");
        let plain = *weighed.sizes(2).expect("sizes").first().expect("a size");
        // An embedding, a norm, the attention of a layer; two kinds: a norm and the query, a norm and the head.
        for more in [8000, 8, 4 * 8 * 8, 8 + 8 * 8, 8 + 8000] {
            assert!(weighed.mixed(plain + 2 * more, 2), "{more}");
        }
        assert!(weighed.mixed(2 * plain, 2), "all in float32");
        assert!(!weighed.mixed(plain + 2 * 4000, 2) && !weighed.mixed(plain - 2 * 8, 2));
    }
}
