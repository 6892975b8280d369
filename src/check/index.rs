//! The index against the shards, and the shards against each other.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use indexmap::IndexMap;
use serde_json::{Map, Value};
use unicode_normalization::UnicodeNormalization as _;

use super::model_type::is_model;
use crate::checkpoint::fault::Faults;
use crate::checkpoint::pickle::is_training_state;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Index, Place, Shard, Tensor, pointer};
use crate::knowledge::rule::Object;

/// The file that the loader opens in place of the shards of an index, if it exists.
pub(super) fn single(checkpoint: &Checkpoint) -> Option<&'static str> {
    let of_pickles =
        || checkpoint.index.as_ref().is_none_or(Index::is_of_pickles) && checkpoint.has_file(files::PICKLED_WEIGHTS);
    if checkpoint.has_file(files::WEIGHTS) {
        Some(files::WEIGHTS)
    } else {
        of_pickles().then_some(files::PICKLED_WEIGHTS)
    }
}

/// Whether a shard's entries can be taken at their word: the header was read to its end.
pub(super) fn readable(shard: &Shard) -> bool {
    const UNREADABLE: [FaultKind; 17] = [
        FaultKind::LfsPointer,
        FaultKind::NotSafetensors,
        FaultKind::EmptyFile,
        FaultKind::FileTooShort,
        FaultKind::HeaderLengthOutOfRange,
        FaultKind::HeaderTooLarge,
        FaultKind::HeaderNotUtf8,
        FaultKind::HeaderNotJson,
        FaultKind::HeaderTooDeep,
        FaultKind::UnreadableFile,
        FaultKind::NotARegularFile,
        FaultKind::NotATorchFile,
        FaultKind::PickleCutShort,
        FaultKind::PickleMalformed,
        FaultKind::PickleNested,
        FaultKind::PickleNotAStateDict,
        FaultKind::PickleTooLarge,
    ];
    !shard.unread && !shard.faults.iter().any(|f| UNREADABLE.contains(&f.kind))
}

/// Whether every shard exists and its header was read, so that a tensor that was not read is missing.
#[must_use]
pub fn all_read(checkpoint: &Checkpoint) -> bool {
    let mut named = checkpoint.index.iter().flat_map(|index| &index.files);
    opened_shards(checkpoint).all(readable) && named.all(|name| checkpoint.shards.contains_key(name))
}

/// Whether nothing suggests that a tensor was lost: every shard that the index or the shards' own names count is present
/// and was read, and every key of the index is in a shard.
pub(super) fn is_complete(checkpoint: &Checkpoint) -> bool {
    let map = checkpoint.index.as_ref().and_then(|index| checkpoint.document(&index.document)?.get("/weight_map"));
    let holds_all = |listed: &Map<String, Value>| {
        let held: HashSet<&str> = checkpoint.tensors().map(|(_, tensor)| tensor.name.as_str()).collect();
        listed.keys().all(|name| held.contains(name.as_str()))
    };
    let mut families: BTreeMap<(&str, u32), BTreeSet<u32>> = BTreeMap::new();
    for (prefix, number, count) in shard_names(checkpoint).into_iter().filter_map(numbered) {
        families.entry((prefix, count)).or_default().insert(number);
    }
    let whole = |count: u32, numbers: &BTreeSet<u32>| usize::try_from(count).is_ok_and(|count| numbers.len() >= count);
    all_read(checkpoint)
        && checkpoint.shards.values().all(|shard| shard.unreadable.is_empty())
        && map.and_then(Value::as_object).is_none_or(holds_all)
        && families.iter().all(|((_, count), numbers)| whole(*count, numbers))
}

/// Names of shards that the number and count in the names of others tell, and that are absent; at most eight.
pub(super) fn lost_shards(checkpoint: &Checkpoint) -> Vec<String> {
    let names = shard_names(checkpoint);
    let Some((prefix, _, count)) = names.first().and_then(|name| numbered(name)) else { return Vec::new() };
    let ending = if names.iter().all(|name| name.ends_with(".bin")) { "bin" } else { "safetensors" };
    let one_family = names.iter().all(|name| numbered(name).is_some_and(|(p, _, c)| p == prefix && c == count));
    let named = (1..=count).map(|number| format!("{prefix}-{number:05}-of-{count:05}.{ending}"));
    let lost = named.filter(|name| one_family && !names.contains(&name.as_str()) && !checkpoint.has_file(name));
    lost.take(8).collect()
}

/// The shards that hold a tensor of each name, in the order of the names.
pub(super) fn by_tensor(checkpoint: &Checkpoint) -> IndexMap<&str, Vec<&str>> {
    let mut map: IndexMap<&str, Vec<&str>> = IndexMap::new();
    for (shard, tensor) in checkpoint.tensors() {
        let shards = map.entry(&tensor.name).or_default();
        // A name twice in one shard is the reader's fault to report.
        if shards.last() != Some(&shard.name.as_str()) {
            shards.push(&shard.name);
        }
    }
    map.sort_unstable_keys();
    map
}

/// Faults between index, shards and file names.
#[must_use]
pub fn faults(checkpoint: &Checkpoint) -> Vec<Fault> {
    match &checkpoint.index {
        Some(index) => {
            let found = IndexComparison::new(checkpoint, index).map_or_else(Vec::new, |comparison| comparison.faults());
            found.into_iter().chain(empty_map(checkpoint)).chain(no_tensors(checkpoint)).collect()
        }
        None => without_index(checkpoint).into_iter().chain(no_tensors(checkpoint)).collect(),
    }
}

/// The fault of shards that a loader opens, were read, and hold no tensor between them.
fn no_tensors(checkpoint: &Checkpoint) -> Option<Fault> {
    let shards: Vec<&Shard> = opened_shards(checkpoint).collect();
    let first = shards.first()?;
    let is_empty = shards.iter().all(|shard| shard.is_sound() && shard.tensors.is_empty());
    let fault = Fault::new(FaultKind::NoTensors).at(Place::file(&*first.name));
    is_empty.then(|| fault.with("shards", shards.len()))
}

/// The fault of an index that lists no tensor.
fn empty_map(checkpoint: &Checkpoint) -> Option<Fault> {
    let name = checkpoint.index.as_ref().map_or(files::INDEX, |index| index.document.as_str());
    let map = checkpoint.document(name)?.get("/weight_map")?.as_object()?;
    let place = Place::file(name).pointer("/weight_map");
    map.is_empty().then(|| Fault::new(FaultKind::WeightMapMalformed).at(place).with("found", "an empty object"))
}

/// An index that states more bytes than its shards have, when Git LFS pointers state their sizes.
fn pointers_below_total<'n>(checkpoint: &Checkpoint, shards: impl Iterator<Item = &'n str> + Clone) -> Option<Fault> {
    let index = checkpoint.index.as_ref()?;
    let stated = index.total_bytes()?;
    let entry = |name| checkpoint.entries.get(name);
    if !shards.clone().any(|name| entry(name).is_some_and(|e| e.lfs.is_some())) {
        return None;
    }
    let size = |name| entry(name).map(|e| e.lfs.as_ref().map_or(e.size, |pointer| pointer.size));
    let sum = shards.clone().try_fold(0_u64, |sum, name| Some(sum.saturating_add(size(name)?)))?;
    // transformers up to 4.x kept the size in float32 of weights that it saved in half of that. A header has some 100 to
    // 300 bytes for each tensor, and lies in the file besides the tensors.
    let twice = sum.saturating_mul(2);
    let headers =
        u64::try_from(index.weight_map.len()).unwrap_or(u64::MAX).saturating_mul(2 * 300).saturating_add(4096);
    let is_of_float32 = (stated..=stated.saturating_add(headers)).contains(&twice);
    let fault = Fault::new(FaultKind::LfsSizesBelowTotal)
        .at(Place::file(&index.document).pointer("/metadata/total_size"))
        .with("stated", stated)
        .with("sum", sum)
        .with("count", shards.count());
    (sum < stated && !is_of_float32).then_some(fault)
}

/// Whether a file is a shard of the base model by its name; those of adapters are not.
pub(super) fn shard_names(checkpoint: &Checkpoint) -> Vec<&str> {
    checkpoint
        .shards
        .keys()
        .map(String::as_str)
        .filter(|n| !n.starts_with("adapter_") && *n != files::TRAINING_ARGUMENTS)
        .collect()
}

/// The first missing shard of the index when other shards exist: the loader raises at it.
#[must_use]
pub fn first_absent_shard(checkpoint: &Checkpoint) -> Option<&str> {
    let index = checkpoint.index.as_ref()?;
    let mut named = index.weight_map.values();
    let some = named.clone().any(|name| checkpoint.has_file(name)) && single(checkpoint).is_none();
    named.find(|name| some && !checkpoint.has_file(name)).map(|name| &**name)
}

/// An index and what it is compared with.
struct IndexComparison<'c> {
    checkpoint: &'c Checkpoint,
    index: &'c Index,
    /// Files that the index names: how many tensors it maps to each, and the first of them.
    referenced: BTreeMap<&'c str, (usize, &'c str)>,
    /// The shards that hold each tensor.
    holders: IndexMap<&'c str, Vec<&'c str>>,
    lookalikes: Lookalikes<'c>,
    /// Whether the header of every shard that the index names was read.
    all_read: bool,
}

impl<'c> IndexComparison<'c> {
    /// `None` for an index without entries, which implies nothing about missing ones.
    fn new(checkpoint: &'c Checkpoint, index: &'c Index) -> Option<Self> {
        let mut referenced: HashMap<&str, (usize, &str)> = HashMap::new();
        for (tensor, file) in &index.weight_map {
            let (count, _) = referenced.entry(file).or_insert((0, tensor));
            *count = count.saturating_add(1);
        }
        let referenced: BTreeMap<&str, (usize, &str)> = referenced.into_iter().collect();
        let all_read = referenced.keys().all(|n| checkpoint.shards.get(*n).is_some_and(readable));
        let (holders, lookalikes) = (by_tensor(checkpoint), Lookalikes::new(checkpoint));
        let comparison = Self { checkpoint, index, referenced, holders, lookalikes, all_read };
        (!index.weight_map.is_empty()).then_some(comparison)
    }

    fn faults(&self) -> Vec<Fault> {
        let mut faults = Faults::of_comparison();
        faults.extend(pointers_below_total(self.checkpoint, self.referenced.keys().copied()));
        faults.extend(self.absent_shards());
        faults.extend(self.entries_without_shard());
        self.misplaced_entries(&mut faults);
        self.tensors_without_entry(&mut faults);
        faults.extend(self.stray_shards());
        faults.extend(self.total_size());
        faults.into_vec()
    }

    /// Shards that the index names and that are missing.
    fn absent_shards(&self) -> Vec<Fault> {
        let Self { checkpoint, index, referenced, .. } = self;
        let exists = |name: &str| checkpoint.has_file(name) || checkpoint.shards.contains_key(name);
        let absent: Vec<_> =
            referenced.iter().filter(|(name, _)| !exists(name)).map(|(n, (c, t))| (*n, *c, *t)).collect();
        if absent.len() == referenced.len() {
            let fault = Fault::new(FaultKind::AllShardsAbsent)
                .at(Place::file(&index.document))
                .with("count", absent.len())
                .with("tensors", index.weight_map.len())
                .with("first", absent.first().map_or("", |(name, ..)| *name));
            return vec![fault];
        }
        let fault = |(name, tensors, first)| {
            let fault = match self.lookalikes.get(name) {
                Some(similar) => {
                    let by = if name.eq_ignore_ascii_case(similar) { "case" } else { "Unicode normalisation" };
                    Fault::new(FaultKind::ShardNameDiffersInCase).with("similar", similar).with("by", by)
                }
                None => Fault::new(FaultKind::ShardMissing),
            };
            let place = Place::file(&index.document).pointer(pointer_to(first));
            fault.at(place).with("shard", name).with("tensors", tensors)
        };
        absent.into_iter().map(fault).collect()
    }

    /// Files that an index of safetensors names, and that are no safetensors file by their name.
    fn entries_without_shard(&self) -> Vec<Fault> {
        let Self { checkpoint, index, referenced, .. } = self;
        let is_other = |name: &str| !checkpoint.shards.contains_key(name) && checkpoint.has_file(name);
        let others = referenced.iter().filter(|(name, _)| !index.is_of_pickles() && is_other(name));
        let fault = |(name, (tensors, first)): (&&str, &(usize, &str))| {
            let fault = Fault::new(FaultKind::IndexEntryNotAShard);
            let fault = fault.at(Place::file(&index.document).pointer(pointer_to(first)).in_tensor(*first));
            let pickle = [".bin", ".pt", ".pth"].iter().any(|ending| name.ends_with(ending));
            fault.with("named", *name).with("tensors", *tensors).with("pickle", pickle)
        };
        others.map(fault).collect()
    }

    /// Entries whose tensor is in another shard than the one mapped, or in none.
    fn misplaced_entries(&self, faults: &mut Faults) {
        let shards = &self.checkpoint.shards;
        let unreadable: BTreeSet<&str> = shards.values().flat_map(|s| &s.unreadable).map(String::as_str).collect();
        let readable: HashMap<&str, &Shard> =
            shards.values().filter(|s| readable(s)).map(|s| (s.name.as_str(), s)).collect();
        for (tensor, said) in &self.index.weight_map {
            let Some(shard) = readable.get(&**said) else { continue };
            let held = self.holders.get(tensor.as_str());
            let unreadable = held.is_none() && unreadable.contains(tensor.as_str());
            if held.is_some_and(|h| h.contains(&shard.name.as_str())) || unreadable {
                continue;
            }
            let place = Place::file(&self.index.document).pointer(pointer_to(tensor)).in_tensor(tensor);
            if let Some(other) = held.and_then(|h| h.first()) {
                let fault = Fault::new(FaultKind::IndexNamesOtherShard).at(place);
                faults.push(fault.with("said", &**said).with("held", *other));
            } else if self.all_read {
                // Otherwise the tensor may be in a shard whose header could not be read.
                faults.push(Fault::new(FaultKind::IndexKeyNowhere).at(place).with("said", &**said));
            }
        }
    }

    /// Tensors of the named shards that the index does not map, or that two of these shards hold.
    fn tensors_without_entry(&self, faults: &mut Faults) {
        // Entries that name no file are the reader's fault to report.
        let places = self.index.faults.iter().flat_map(|f| &f.places);
        let unusable: BTreeSet<&str> = places.filter_map(|place| place.tensor.as_deref()).collect();
        let referenced: HashSet<&str> = self.referenced.keys().copied().collect();
        let mut twice: Vec<Fault> = Vec::new();
        for (tensor, shards) in self.holders.iter().filter(|(tensor, _)| !unusable.contains(*tensor)) {
            let mut mapped = shards.iter().filter(|shard| referenced.contains(**shard));
            let Some(first) = mapped.next() else { continue };
            let place = || Place::file(*first).in_tensor(*tensor);
            match (self.index.weight_map.get(*tensor), mapped.next()) {
                (None, _) => {
                    let fault = Fault::new(FaultKind::ShardTensorNotInIndex).at(place());
                    faults.push(fault.with("index", self.index.document.as_str()));
                }
                (Some(kept), Some(second)) => {
                    let taken = *mapped.next_back().unwrap_or(second);
                    let fault = Fault::new(FaultKind::TensorInTwoShards).at(place());
                    let fault = fault.with("other", *second).with("mapped", &**kept).with("taken", taken);
                    // Transformers takes the last one, whichever the index names.
                    let differs = if &**kept == taken {
                        Some(false)
                    } else if twice.len() < COMPARED {
                        self.differs(tensor, kept, taken)
                    } else {
                        None
                    };
                    let fault = fault.with("differs", differs);
                    let is_left = differs.is_none() && twice.len() >= COMPARED;
                    let why = || format!("of the tensors in two shards, {COMPARED} were compared");
                    twice.push(if is_left { fault.with("not_judged", why()) } else { fault });
                }
                (Some(_), None) => {}
            }
        }
        // Only the first of many are findings.
        twice.sort_by_key(|fault| fault.detail.get("differs") != Some(&Value::Bool(true)));
        for fault in twice {
            faults.push(fault);
        }
    }

    /// Whether a tensor has other values in one shard than in another; `None` when that is not known.
    fn differs(&self, tensor: &str, one: &str, other: &str) -> Option<bool> {
        let held = |shard: &str| {
            let shard = self.checkpoint.shards.get(shard).filter(|shard| readable(shard))?;
            Some((shard, shard.tensors.iter().find(|held| held.name == tensor)?))
        };
        Some(!self.checkpoint.same_bytes(held(one)?, held(other)?)?)
    }

    /// Safetensors files that the index does not name.
    fn stray_shards(&self) -> Vec<Fault> {
        // Under a name that differs in case only a shard is missing already.
        let missed: BTreeSet<&str> = self.referenced.keys().filter_map(|name| self.lookalikes.get(name)).collect();
        let fault = |name: &str| {
            let is_mapped = |tensor: &&Tensor| self.index.weight_map.contains_key(&tensor.name);
            let held = self.checkpoint.shards.get(name).into_iter().flat_map(|shard| &shard.tensors);
            let twice = held.filter(is_mapped).count();
            let kind = match name {
                files::WEIGHTS | files::PICKLED_WEIGHTS => FaultKind::SingleFileBesideIndex,
                _ if twice > 0 || numbered(name).is_some() => FaultKind::StrayShard,
                _ => return None,
            };
            let fault = Fault::new(kind).at(Place::file(name)).with("index", self.index.document.as_str());
            Some(fault.with("twice", twice))
        };
        let strays = shard_names(self.checkpoint).into_iter();
        strays.filter(|name| !self.referenced.contains_key(name) && !missed.contains(name)).filter_map(fault).collect()
    }

    /// A `total_size` that is not the size of the shards; unknown while an entry of one could not be read.
    fn total_size(&self) -> Option<Fault> {
        let mut shards = self.referenced.keys().filter_map(|name| self.checkpoint.shards.get(*name));
        if !self.all_read || !shards.clone().all(|shard| shard.unreadable.is_empty()) {
            return None;
        }
        let stated = self.index.total_bytes()?;
        let size = |sum: u64, shard: &Shard| shard.tensors.iter().fold(sum, |sum, t| sum.saturating_add(t.len()));
        let actual = shards.by_ref().fold(0, size);
        let fault = Fault::new(FaultKind::TotalSizeWrong)
            .at(Place::file(&self.index.document).pointer("/metadata/total_size"))
            .with("stated", stated)
            .with("actual", actual);
        (stated != actual).then_some(fault)
    }
}

/// Number and count of `model-00001-of-00002.safetensors`.
pub(super) fn numbered(name: &str) -> Option<(&str, u32, u32)> {
    let pickle = || name.strip_suffix(".bin").filter(|stem| stem.starts_with("pytorch_model"));
    let stem = name.strip_suffix(".safetensors").or_else(pickle)?;
    let (rest, count) = stem.rsplit_once("-of-")?;
    let (prefix, number) = rest.rsplit_once('-')?;
    Some((prefix, number.parse().ok()?, count.parse().ok()?))
}

/// Faults of a checkpoint that has no index.
fn without_index(checkpoint: &Checkpoint) -> Vec<Fault> {
    let names = shard_names(checkpoint);
    if names.contains(&files::WEIGHTS) || names.contains(&files::PICKLED_WEIGHTS) {
        return Vec::new();
    }
    let numbers: Vec<(&str, u32, u32)> = names.iter().filter_map(|n| numbered(n)).collect();
    if let Some((prefix, _, count)) = numbers.first().copied() {
        let present: BTreeSet<u32> = numbers.iter().map(|n| n.1).collect();
        let ending = if names.iter().all(|name| name.ends_with(".bin")) { "bin" } else { "safetensors" };
        return missing_index((prefix, ending), count, numbers.len(), &present);
    }
    if names.is_empty() && checkpoint.has_file(files::CONFIG) {
        return weights_elsewhere(checkpoint).into_iter().collect();
    }
    unread_weights(checkpoint, &names).into_iter().collect()
}

/// Whether transformers opens a shard of this name: the single file, else the shards that the index names, else, once it
/// has an index, a numbered one.
///
/// Source: `_get_resolved_checkpoint_files` of transformers 4.57.6. Other names belong to other programs:
/// `consolidated.safetensors` to mistral-inference, `open_clip_model.safetensors` to `open_clip`.
pub(super) fn is_opened(checkpoint: &Checkpoint, name: &str) -> bool {
    match &checkpoint.index {
        _ if single(checkpoint).is_some() => single(checkpoint) == Some(name),
        Some(index) => index.files.contains(name),
        None => numbered(name).is_some(),
    }
}

/// The shards that transformers or PEFT opens. All of them when nothing tells which: no index, and none of a name that they open;
/// then another library may open any.
pub(super) fn opened_shards(checkpoint: &Checkpoint) -> impl Iterator<Item = &Shard> {
    let is_told = tells_opened(checkpoint);
    checkpoint.shards.values().filter(move |shard| !is_told || opens(checkpoint, &shard.name))
}

/// Whether the names tell which shards are opened.
fn tells_opened(checkpoint: &Checkpoint) -> bool {
    checkpoint.index.is_some() || checkpoint.shards.keys().any(|name| opens(checkpoint, name))
}

/// Whether transformers or PEFT opens a file of this name.
fn opens(checkpoint: &Checkpoint, name: &str) -> bool {
    is_opened(checkpoint, name) || Object::reading(name) == Some(Object::Adapter)
}

/// Tensors in two shards whose bytes are compared.
const COMPARED: usize = 1_000;

/// The tensors of [`opened_shards`], by shard name and then in header order.
pub(super) fn opened_tensors(checkpoint: &Checkpoint) -> impl Iterator<Item = &Tensor> {
    opened_shards(checkpoint).flat_map(|shard| &shard.tensors)
}

/// The tensor of this name in [`opened_shards`]: that of the shard that the index maps it to, otherwise the first.
pub(super) fn opened_tensor<'c>(checkpoint: &'c Checkpoint, name: &str) -> Option<(&'c Shard, &'c Tensor)> {
    let (shard, tensor) = checkpoint.tensor(name)?;
    if opens(checkpoint, &shard.name) || !tells_opened(checkpoint) {
        return Some((shard, tensor));
    }
    let in_shard = |shard: &'c Shard| Some((shard, shard.tensors.iter().find(|tensor| tensor.name == name)?));
    opened_shards(checkpoint).find_map(in_shard)
}

/// For a model whose shards all have names that no loader reads: no weights, with these names.
fn unread_weights(checkpoint: &Checkpoint, names: &[&str]) -> Option<Fault> {
    let is_read = |name: &&str| matches!(*name, files::PICKLED_WEIGHTS | files::PICKLE_INDEX);
    let has_pickle = checkpoint.entries.keys().any(|name| is_read(&name.as_str()));
    if !is_model(checkpoint) || has_pickle || names.is_empty() {
        return None;
    }
    let fault = Fault::new(FaultKind::NoWeights).with("model", true).with("unread", names.to_vec());
    Some(names.iter().fold(fault, |fault, name| fault.at(Place::file(*name))))
}

/// For numbered shards without an index: the index, and the numbers that are missing.
fn missing_index(family: (&str, &str), count: u32, shards: usize, present: &BTreeSet<u32>) -> Vec<Fault> {
    let (prefix, ending) = family;
    let index = Fault::new(FaultKind::IndexMissing)
        .with("shards", shards)
        .with("index", format!("{prefix}.{ending}.index.json"));
    // Numbering from 00000 loads too; only then is number `count` not expected. `count` is a name's word: bounded.
    let first = u32::from(!present.contains(&0));
    let last = if first == 0 { count.saturating_sub(1) } else { count };
    let missing = (first..=last.min(10_000)).filter(|n| !present.contains(n)).map(|n| {
        let name = format!("{prefix}-{n:05}-of-{count:05}.{ending}");
        let fault = Fault::new(FaultKind::ShardMissing).at(Place::file(&name));
        fault.with("shard", name.as_str()).with("tensors", Value::Null)
    });
    std::iter::once(index).chain(missing).collect()
}

/// Endings of weights that programs other than transformers load, or transformers for another framework; and the folders
/// in which they lie.
const FOREIGN: [&str; 15] = [
    ".onnx",
    ".gguf",
    ".ggml",
    ".tflite",
    ".mlmodel",
    ".mlpackage",
    ".rkllm",
    ".rknn",
    ".engine",
    ".nemo",
    ".h5",
    ".msgpack",
    "openvino_model.xml",
    "onnx",
    "openvino",
];

/// For a config without shards: pickled weights, those of another program, or none at all.
fn weights_elsewhere(checkpoint: &Checkpoint) -> Option<Fault> {
    let is_pickle = |n: &str| {
        (n.ends_with(".bin") && n.starts_with("pytorch_model"))
            || ((n.ends_with(".pth") || n.ends_with(".pt")) && !is_training_state(n))
    };
    let pickles = checkpoint.entries.keys().filter(|n| is_pickle(n) && !is_pointer(checkpoint, n));
    let pickle = pickles.min_by_key(|n| !n.starts_with("pytorch_model"));
    let is_reported = |f: &Fault| {
        let names = || f.places.iter().filter_map(|p| p.file.as_deref());
        f.kind == FaultKind::LfsPointer && names().any(|n| n.ends_with(".bin"))
    };
    let has_pointer = checkpoint.faults.iter().any(is_reported);
    match pickle {
        // transformers reads no other name; beside weights that were not downloaded, `colbert_linear.pt` stands for none.
        Some(name) if name.starts_with("pytorch_model") || !has_pointer && !is_model(checkpoint) => {
            let fault = Fault::new(FaultKind::PickleWeights).at(Place::file(name));
            Some(fault.with("tensors", 0).with("read", false))
        }
        _ if has_pointer => None,
        Some(name) => unread_weights(checkpoint, &[name]),
        None => {
            let is_foreign = |name: &&String| FOREIGN.iter().any(|ending| name.ends_with(ending));
            let foreign: Vec<&str> = checkpoint.entries.keys().filter(is_foreign).map(String::as_str).collect();
            let misspelt: Vec<&str> =
                checkpoint.entries.keys().map(String::as_str).filter(|n| is_misspelt(n)).collect();
            if !misspelt.is_empty() && foreign.is_empty() {
                return unread_weights(checkpoint, &misspelt);
            }
            let fault = Fault::new(FaultKind::NoWeights).with("model", is_model(checkpoint) && foreign.is_empty());
            Some(if foreign.is_empty() { fault } else { fault.with("foreign", foreign) })
        }
    }
}

/// Whether a name is almost that of a weight file: `pytorch_model_bin`, `Model.safetensors`, `model (1).safetensors`.
fn is_misspelt(name: &str) -> bool {
    let letters = name.chars().filter(char::is_ascii_alphabetic).map(|c| c.to_ascii_lowercase());
    let letters: String = letters.collect();
    matches!(letters.as_str(), "pytorchmodelbin" | "modelsafetensors" | "pytorchmodel")
}

/// Whether a git-lfs pointer stands in place of the file; it has a finding of its own.
fn is_pointer(checkpoint: &Checkpoint, name: &str) -> bool {
    checkpoint.entries.get(name).is_some_and(|entry| entry.lfs.is_some())
}

/// The shard whose name differs from this one only in case or Unicode form, which some file systems ignore.
pub(super) fn similar<'c>(checkpoint: &'c Checkpoint, name: &str) -> Option<&'c str> {
    checkpoint.shards.keys().map(String::as_str).find(|s| *s != name && folded(s) == folded(name))
}

/// Shards by what is left of their names where case and composition of characters are ignored.
struct Lookalikes<'c>(BTreeMap<String, Vec<&'c str>>);

impl<'c> Lookalikes<'c> {
    fn new(checkpoint: &'c Checkpoint) -> Self {
        let mut names: BTreeMap<String, Vec<&str>> = BTreeMap::new();
        for name in checkpoint.shards.keys() {
            names.entry(folded(name)).or_default().push(name);
        }
        Self(names)
    }

    /// The shard whose name differs from this one only in case or Unicode form, which some file systems ignore.
    fn get(&self, name: &str) -> Option<&'c str> {
        self.0.get(&folded(name))?.iter().copied().find(|other| *other != name)
    }
}

/// A name as file systems that ignore case and composition of characters compare it.
fn folded(name: &str) -> String {
    name.nfc().flat_map(char::to_lowercase).collect()
}

fn pointer_to(tensor: &str) -> String {
    pointer::join("/weight_map", tensor)
}
