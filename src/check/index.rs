//! The index against the shards, and the shards against each other.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;
use unicode_normalization::UnicodeNormalization as _;

use crate::checkpoint::{Checkpoint, Fault, Place, Shard};

/// The file that, when it is there, a loader takes without looking at an index.
const SINGLE: &str = "model.safetensors";

/// Whether a shard's entries can be taken at their word: the header was read to its end.
pub(super) fn readable(shard: &Shard) -> bool {
    const UNREADABLE: [&str; 10] = [
        "lfs-pointer",
        "not-safetensors",
        "empty-file",
        "file-too-short",
        "header-length-out-of-range",
        "header-too-large",
        "header-not-utf8",
        "header-not-json",
        "header-too-deep",
        "unreadable-file",
    ];
    !shard.faults.iter().any(|f| UNREADABLE.contains(&f.kind) || f.kind == "not-a-regular-file")
}

/// Whether every shard is there and its header could be read, so that a tensor that is not seen is not there.
#[must_use]
pub fn all_read(checkpoint: &Checkpoint) -> bool {
    let named = checkpoint.index.iter().flat_map(|index| index.weight_map.values());
    checkpoint.shards.values().all(readable) && named.into_iter().all(|name| checkpoint.shards.contains_key(name))
}

/// Whether nothing suggests that a tensor was lost: every shard that the index or the shards' own names count is present
/// and was read, and every key of the index is in a shard.
pub(super) fn is_complete(checkpoint: &Checkpoint) -> bool {
    let map = checkpoint.index.as_ref().and_then(|index| checkpoint.document(&index.document)?.get("/weight_map"));
    let listed = map.and_then(Value::as_object).into_iter().flat_map(|map| map.keys());
    let held: BTreeSet<&str> = checkpoint.tensors().map(|(_, tensor)| tensor.name.as_str()).collect();
    let mut families: BTreeMap<(&str, u32), BTreeSet<u32>> = BTreeMap::new();
    for (prefix, number, count) in shard_names(checkpoint).into_iter().filter_map(numbered) {
        families.entry((prefix, count)).or_default().insert(number);
    }
    let whole = |count: u32, numbers: &BTreeSet<u32>| usize::try_from(count).is_ok_and(|count| numbers.len() >= count);
    all_read(checkpoint)
        && checkpoint.shards.values().all(|shard| shard.unreadable.is_empty())
        && listed.into_iter().all(|name| held.contains(name.as_str()))
        && families.iter().all(|((_, count), numbers)| whole(*count, numbers))
}

/// Which shard holds a tensor of that name; the first when there are several.
pub(super) fn by_tensor(checkpoint: &Checkpoint) -> BTreeMap<&str, Vec<&str>> {
    let mut map: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (shard, tensor) in checkpoint.tensors() {
        let shards = map.entry(&tensor.name).or_default();
        // A name twice in one shard is the reader's fault to report.
        if shards.last() != Some(&shard.name.as_str()) {
            shards.push(&shard.name);
        }
    }
    map
}

/// Faults between index, shards and file names.
#[must_use]
pub fn compare(checkpoint: &Checkpoint) -> Vec<Fault> {
    let mut faults = Vec::new();
    match &checkpoint.index {
        Some(_) => with_index(checkpoint, &mut faults),
        None => without_index(checkpoint, &mut faults),
    }
    faults
}

/// An index that states more bytes of tensors than its shards have, when git-lfs pointers say how large these are.
fn pointers_below_total<'n>(checkpoint: &Checkpoint, shards: impl Iterator<Item = &'n str> + Clone) -> Option<Fault> {
    let index = checkpoint.index.as_ref()?;
    let stated = index.total_bytes()?;
    let entry = |name| checkpoint.entries.get(name);
    if !shards.clone().any(|name| entry(name).is_some_and(|e| e.lfs.is_some())) {
        return None;
    }
    let size = |name| entry(name).map(|e| e.lfs.as_ref().map_or(e.size, |pointer| pointer.size));
    let sum = shards.clone().try_fold(0_u64, |sum, name| Some(sum.saturating_add(size(name)?)))?;
    let fault = Fault::new("lfs-sizes-below-total")
        .at(Place::file(&index.document).pointer("/metadata/total_size"))
        .with("stated", stated)
        .with("sum", sum)
        .with("count", shards.count());
    (sum < stated).then_some(fault)
}

/// Weights, as far as file names tell: base-model shards, not adapters.
pub(super) fn shard_names(checkpoint: &Checkpoint) -> Vec<&str> {
    checkpoint
        .shards
        .keys()
        .map(String::as_str)
        .filter(|n| !n.starts_with("adapter_") && *n != "training_args.safetensors")
        .collect()
}

/// The first shard that the index names and that is not there, when others are: the loader stops at it.
#[must_use]
pub fn first_absent_shard(checkpoint: &Checkpoint) -> Option<&str> {
    let index = checkpoint.index.as_ref()?;
    let mut named = index.weight_map.values();
    let is_there = |name: &&String| checkpoint.has_file(name);
    let some = named.clone().any(|name| is_there(&name)) && !checkpoint.has_file(SINGLE);
    named.find(|name| some && !is_there(name)).map(String::as_str)
}

fn with_index(checkpoint: &Checkpoint, faults: &mut Vec<Fault>) {
    let Some(index) = &checkpoint.index else { return };
    // An index that could not be understood says nothing of what is not in it.
    if index.weight_map.is_empty() {
        return;
    }
    let mut referenced: Referenced<'_> = BTreeMap::new();
    for (tensor, file) in &index.weight_map {
        let (count, _) = referenced.entry(file).or_insert((0, tensor));
        *count = count.saturating_add(1);
    }
    faults.extend(pointers_below_total(checkpoint, referenced.keys().copied()));
    let is_there = |name: &str| checkpoint.has_file(name) || checkpoint.shards.contains_key(name);
    let absent: Vec<_> =
        referenced.iter().filter(|(name, _)| !is_there(name)).map(|(n, (c, t))| (*n, *c, *t)).collect();
    let lookalikes = Lookalikes::of(checkpoint);
    let all_absent = absent.len() == referenced.len();
    if all_absent {
        let first = absent.first().map_or("", |(name, ..)| *name);
        faults.push(
            Fault::new("all-shards-absent")
                .at(Place::file(&index.document))
                .with("count", absent.len())
                .with("tensors", index.weight_map.len())
                .with("first", first),
        );
    } else {
        for (name, tensors, first) in absent {
            let pointer = Some(pointer_to(first));
            let fault = match lookalikes.get(name) {
                Some(s) => {
                    let by = if name.eq_ignore_ascii_case(s) { "case" } else { "Unicode normalisation" };
                    Fault::new("shard-name-differs-in-case").with("similar", s).with("by", by)
                }
                None => Fault::new("shard-missing"),
            };
            let place = Place { file: Some(index.document.clone()), pointer, ..Place::default() };
            faults.push(fault.at(place).with("shard", name).with("tensors", tensors));
        }
    }
    let is_pickle = |name: &&&str| index.is_of_pickles() && checkpoint.has_file(name) && !is_pointer(checkpoint, name);
    if let Some(name) = referenced.keys().find(is_pickle) {
        faults.push(Fault::new("pickle-weights").at(Place::file(*name)));
    }
    let holders = by_tensor(checkpoint);
    // A name may lie in a shard that cannot be read: then nothing is known of it.
    let all_read = referenced.keys().all(|n| checkpoint.shards.get(*n).is_some_and(readable));
    let unreadable: BTreeSet<&str> =
        checkpoint.shards.values().flat_map(|s| &s.unreadable).map(String::as_str).collect();
    for (tensor, said) in &index.weight_map {
        let Some(shard) = checkpoint.shards.get(said).filter(|s| readable(s)) else { continue };
        let held = holders.get(tensor.as_str());
        let unreadable = held.is_none() && unreadable.contains(tensor.as_str());
        if held.is_some_and(|h| h.contains(&shard.name.as_str())) || unreadable {
            continue;
        }
        let place = Place::file(&index.document).pointer(pointer_to(tensor)).in_tensor(tensor);
        if let Some(other) = held.and_then(|h| h.first()) {
            faults
                .push(Fault::new("index-names-other-shard").at(place).with("said", said.as_str()).with("held", *other));
        } else if all_read {
            faults.push(Fault::new("index-key-nowhere").at(place).with("said", said.as_str()));
        }
    }
    // Entries that name no file are the reader's fault to report.
    let unusable: BTreeSet<&str> =
        index.faults.iter().flat_map(|f| &f.places).filter_map(|place| place.tensor.as_deref()).collect();
    for (tensor, shards) in &holders {
        let mapped: Vec<&&str> = shards.iter().filter(|s| referenced.contains_key(**s)).collect();
        if unusable.contains(tensor) {
            continue;
        }
        if !index.weight_map.contains_key(*tensor) {
            if let Some(shard) = mapped.first() {
                let place = Place::file(**shard).in_tensor(*tensor);
                faults.push(Fault::new("shard-tensor-not-in-index").at(place).with("index", index.document.as_str()));
            }
        } else if let (Some(first), Some(second)) = (mapped.first(), mapped.get(1)) {
            let place = Place::file(**first).in_tensor(*tensor);
            let kept = index.weight_map.get(*tensor).map_or("", String::as_str);
            faults.push(Fault::new("tensor-in-two-shards").at(place).with("other", **second).with("kept", kept));
        }
    }
    strays(checkpoint, &referenced, &holders, faults);
    // The size of an entry that could not be read is not known.
    if all_read && referenced.keys().all(|n| checkpoint.shards.get(*n).is_some_and(|s| s.unreadable.is_empty())) {
        total_size(checkpoint, &referenced, faults);
    }
}

/// Safetensors files that the index does not mention.
fn strays(
    checkpoint: &Checkpoint,
    referenced: &Referenced<'_>,
    holders: &BTreeMap<&str, Vec<&str>>,
    faults: &mut Vec<Fault>,
) {
    let Some(index) = &checkpoint.index else { return };
    let mut shared: BTreeMap<&str, u64> = BTreeMap::new();
    for (tensor, shards) in holders {
        if index.weight_map.contains_key(*tensor) {
            for shard in shards {
                let n = shared.entry(shard).or_default();
                *n = n.saturating_add(1);
            }
        }
    }
    let lookalikes = Lookalikes::of(checkpoint);
    let missed: BTreeSet<&str> = referenced.keys().filter_map(|name| lookalikes.get(name)).collect();
    for name in shard_names(checkpoint) {
        // Under a name that differs in case only it is missing already.
        if referenced.contains_key(name) || missed.contains(name) {
            continue;
        }
        let twice = shared.get(name).copied().unwrap_or_default();
        if name == SINGLE {
            faults.push(
                Fault::new("single-file-beside-index")
                    .at(Place::file(name))
                    .with("index", index.document.as_str())
                    .with("twice", twice),
            );
        } else if twice > 0 || numbered(name).is_some() {
            faults.push(
                Fault::new("stray-shard")
                    .at(Place::file(name))
                    .with("index", index.document.as_str())
                    .with("twice", twice),
            );
        }
    }
}

fn total_size(checkpoint: &Checkpoint, referenced: &Referenced<'_>, faults: &mut Vec<Fault>) {
    let Some(index) = &checkpoint.index else { return };
    let Some(stated) = index.total_size.as_ref().and_then(whole) else { return };
    let actual = referenced
        .keys()
        .filter_map(|n| checkpoint.shards.get(*n))
        .flat_map(|s| &s.tensors)
        .fold(0_u64, |n, t| n.saturating_add(t.len()));
    if stated != actual {
        faults.push(
            Fault::new("total-size-wrong")
                .at(Place::file(&index.document).pointer("/metadata/total_size"))
                .with("stated", stated)
                .with("actual", actual),
        );
    }
}

/// A byte count; transformers wrote it as a float for years.
fn whole(value: &Value) -> Option<u64> {
    if let Some(n) = value.as_u64() {
        return Some(n);
    }
    let n = value.as_f64()?;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "whole, not negative and within 2^53")]
    (n.fract() == 0.0 && (0.0..9e15).contains(&n)).then_some(n as u64)
}

/// Number and count of `model-00001-of-00002.safetensors`.
pub(super) fn numbered(name: &str) -> Option<(&str, u32, u32)> {
    let stem = name.strip_suffix(".safetensors")?;
    let (rest, count) = stem.rsplit_once("-of-")?;
    let (prefix, number) = rest.rsplit_once('-')?;
    Some((prefix, number.parse().ok()?, count.parse().ok()?))
}

fn without_index(checkpoint: &Checkpoint, faults: &mut Vec<Fault>) {
    let names = shard_names(checkpoint);
    if names.contains(&SINGLE) {
        return;
    }
    let numbers: Vec<(&str, u32, u32)> = names.iter().filter_map(|n| numbered(n)).collect();
    if let Some((prefix, _, count)) = numbers.first().copied() {
        faults.push(
            Fault::new("index-missing")
                .with("shards", numbers.len())
                .with("index", format!("{prefix}.safetensors.index.json")),
        );
        let present: BTreeSet<u32> = numbers.iter().map(|n| n.1).collect();
        // Numbering from 00000 loads too; only then is number `count` not expected. `count` is a name's word: bounded.
        let first = u32::from(!present.contains(&0));
        let last = if first == 0 { count.saturating_sub(1) } else { count };
        for n in (first..=last.min(10_000)).filter(|n| !present.contains(n)) {
            let name = format!("{prefix}-{n:05}-of-{count:05}.safetensors");
            faults.push(
                Fault::new("shard-missing")
                    .at(Place::file(&name))
                    .with("shard", name.as_str())
                    .with("tensors", Value::Null),
            );
        }
        return;
    }
    if names.is_empty() && checkpoint.has_file("config.json") {
        let pickle = checkpoint.entries.keys().find(|n| {
            let named =
                (n.ends_with(".bin") && n.starts_with("pytorch_model")) || n.ends_with(".pth") || n.ends_with(".pt");
            named && !is_pointer(checkpoint, n)
        });
        let is_told = |f: &Fault| {
            f.kind == "lfs-pointer" && f.places.iter().any(|p| p.file.as_deref().is_some_and(|n| n.ends_with(".bin")))
        };
        if pickle.is_none() && checkpoint.faults.iter().any(is_told) {
            return;
        }
        faults.push(match pickle {
            Some(name) => Fault::new("pickle-weights").at(Place::file(name)),
            None => Fault::new("no-weights"),
        });
    }
}

/// Whether a git-lfs pointer stands in place of the file; it has a finding of its own.
fn is_pointer(checkpoint: &Checkpoint, name: &str) -> bool {
    checkpoint.entries.get(name).is_some_and(|entry| entry.lfs.is_some())
}

/// The shard whose name differs from this one only in what some file systems ignore.
pub(super) fn similar<'c>(checkpoint: &'c Checkpoint, name: &str) -> Option<&'c str> {
    checkpoint.shards.keys().map(String::as_str).find(|s| *s != name && folded(s) == folded(name))
}

/// Files that the index names: how many tensors it says are there, and the first of them.
type Referenced<'i> = BTreeMap<&'i str, (usize, &'i str)>;

/// Shards by what is left of their names where case and composition of characters are ignored.
struct Lookalikes<'c>(BTreeMap<String, Vec<&'c str>>);

impl<'c> Lookalikes<'c> {
    fn of(checkpoint: &'c Checkpoint) -> Self {
        let mut names: BTreeMap<String, Vec<&str>> = BTreeMap::new();
        for name in checkpoint.shards.keys() {
            names.entry(folded(name)).or_default().push(name);
        }
        Self(names)
    }

    /// The shard whose name differs from this one only in what some file systems ignore.
    fn get(&self, name: &str) -> Option<&'c str> {
        self.0.get(&folded(name))?.iter().copied().find(|other| *other != name)
    }
}

/// A name as file systems that ignore case and composition of characters compare it.
fn folded(name: &str) -> String {
    name.nfc().flat_map(char::to_lowercase).collect()
}

fn pointer_to(tensor: &str) -> String {
    format!("/weight_map/{}", tensor.replace('~', "~0").replace('/', "~1"))
}
