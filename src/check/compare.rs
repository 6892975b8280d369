//! What differs between two checkpoints: tensors under one naming, documents by value, tokens, and other files.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use serde_json::Value;

use crate::checkpoint::tokenizer::Comparison as Tokens;
use crate::checkpoint::{Checkpoint, DifferenceRank, Distance, EntryKind, Index, Shard, Tensor, files};
use crate::knowledge::Library;

mod converted;
mod maps;
mod renamings;
mod values;

pub use self::maps::{ChangedCell, ChangesByLayer, changes_by_layer, maps};

/// Maximum number of bytes of another file that is compared. Of a larger one, only another size is found.
const FILE_CAP: u64 = 64 << 20;

/// What differs between a first and a second checkpoint.
#[derive(Debug, Clone, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Differences {
    /// Whether something differs; of what `unknown` lists, nothing is known.
    pub differ: bool,
    /// The tensors.
    pub tensors: TensorDifferences,
    /// JSON documents that differ, without indexes.
    pub documents: Vec<DocumentChange>,
    /// How the tokens differ; missing when both tokenizers have the same ones, or one was not read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tokens: Option<TokenChange>,
    /// Other files at the top of the directories.
    pub files: FileChanges,
    /// What could not be compared, and why.
    pub unknown: Vec<String>,
}

/// How the tensors of two checkpoints differ.
#[derive(Debug, Clone, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TensorDifferences {
    /// Number of tensors in the first checkpoint.
    pub before: usize,
    /// Number of tensors in the second checkpoint.
    pub after: usize,
    /// Number of tensors with the same type, shape and, as far as they were compared, bytes in both.
    pub equal: usize,
    /// The bytes that were compared of tensors with the same type and shape.
    pub bytes: ComparedBytes,
    /// Prefixes of names that differ; the tensors are the same otherwise, unless they are listed below.
    pub renamed: Vec<PrefixChange>,
    /// Tensors that a loader makes the same tensors of: fused, split, tied or under names without one prefix for all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub converted: Option<Converted>,
    /// In the second checkpoint alone.
    pub added: Vec<OneSided>,
    /// In the first checkpoint alone.
    pub removed: Vec<OneSided>,
    /// With another shape.
    pub reshaped: Vec<Reshaped>,
    /// With another type.
    pub recast: Vec<Recast>,
    /// With other bytes, and the same type and shape.
    pub changed: Vec<Changed>,
}

/// The bytes that are compared of two tensors with the same type and shape.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum ComparedBytes {
    /// The first, middle and last 4096. A change of others, such as some rows of an embedding, is not found.
    #[default]
    Sampled,
    /// All.
    All,
    /// All, and how far the values are from each other where they differ.
    Measured,
    /// The same, and the rank of the differences of matrices.
    Ranked,
}

/// A prefix of names that the second checkpoint has in place of another one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PrefixChange {
    /// In the first checkpoint; empty when the second one adds a prefix.
    pub from: String,
    /// In the second checkpoint.
    pub to: String,
    /// Number of tensors.
    pub tensors: usize,
}

/// Tensors of both sides that a loader turns into the same tensors of a class.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Converted {
    /// Version of transformers.
    pub loader: String,
    /// Number of tensors of the first checkpoint.
    pub before: usize,
    /// Number of tensors of the second checkpoint.
    pub after: usize,
}

/// A tensor of one checkpoint alone.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct OneSided {
    /// Its name; that in the model where its file has it in another form.
    pub name: String,
    /// Its shape; null where a loader makes it and the shape depends on more than is known.
    pub shape: Option<Vec<u64>>,
    /// Its type; null where a loader makes it.
    pub dtype: Option<String>,
}

/// A tensor with another shape.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Reshaped {
    /// Its name in the first checkpoint.
    pub name: String,
    /// Its shape there.
    pub before: Vec<u64>,
    /// Its shape in the second one.
    pub after: Vec<u64>,
}

/// A tensor with another type.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Recast {
    /// Its name in the first checkpoint.
    pub name: String,
    /// Its type there.
    pub before: String,
    /// Its type in the second one.
    pub after: String,
    /// By how much its values differ; missing unless it was asked for, and for values that are no finite floats.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<Distance>,
}

/// A tensor with other bytes.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Changed {
    /// Its name in the first checkpoint.
    pub name: String,
    /// By how much; missing unless it was asked for, and for values that are no finite floats.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<Distance>,
    /// Rank of the difference above rounding errors; missing unless it was asked for, and for all but matrices.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rank: Option<DifferenceRank>,
}

/// A JSON document that differs.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct DocumentChange {
    /// Its name.
    pub file: String,
    /// The values that differ, in the order of the first document.
    pub values: Vec<ValueChange>,
    /// Number of further ones.
    #[serde(skip_serializing_if = "crate::checkpoint::untold")]
    pub further: usize,
}

/// A value that differs.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ValueChange {
    /// Where it is: a JSON pointer.
    pub pointer: String,
    /// In the first document; missing when it has no such value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub before: Option<Value>,
    /// In the second document; missing when it has no such value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub after: Option<Value>,
}

/// How the tokens of two tokenizers differ.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TokenChange {
    /// Number of tokens with another id, or in one tokenizer alone.
    pub tokens: usize,
    /// The first of them, by its id.
    pub first: String,
    /// Its id in the first tokenizer.
    pub before: Option<u64>,
    /// Its id in the second one.
    pub after: Option<u64>,
}

/// Files and folders at the top of two directories, without weights, indexes, and documents of both.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct FileChanges {
    /// In the second directory alone.
    pub added: Vec<String>,
    /// In the first directory alone.
    pub removed: Vec<String>,
    /// With other bytes.
    pub changed: Vec<String>,
}

/// A tensor and its file.
type Placed<'c> = (&'c Shard, &'c Tensor);

/// The tensors of one side that have no partner yet, by name.
type Unpaired<'c> = BTreeMap<&'c str, Placed<'c>>;

/// Compares two checkpoints, for `diff`; `bytes` says what is read of the tensors that have the same shape in both.
#[must_use]
pub fn compare(one: &Checkpoint, other: &Checkpoint, library: &Library, bytes: ComparedBytes) -> Differences {
    let mut unknown: Vec<String> = [one, other].into_iter().flat_map(unread).collect();
    let tensors = tensors(one, other, library, bytes, &mut unknown);
    let documents: Vec<DocumentChange> = documents(one, other, &mut unknown);
    let tokens = tokens(one, other);
    let files = file_changes(one, other, &mut unknown);
    let is_same = |tensors: &TensorDifferences| {
        let TensorDifferences { renamed, converted, added, removed, reshaped, recast, changed, .. } = tensors;
        let names = renamed.is_empty() && converted.is_none() && added.is_empty() && removed.is_empty();
        names && reshaped.is_empty() && recast.is_empty() && changed.is_empty()
    };
    let documents_differ = !documents.is_empty() || tokens.is_some();
    let differ = !is_same(&tensors) || documents_differ || files != FileChanges::default();
    Differences { differ, tensors, documents, tokens, files, unknown }
}

/// Files of tensors that were not read whole.
fn unread(checkpoint: &Checkpoint) -> Vec<String> {
    let root = checkpoint.source.path().display().to_string();
    let shards = checkpoint.shards.values().filter(|shard| shard.lacks_tensors());
    let mut unread: Vec<String> =
        shards.map(|shard| format!("{root}: not all tensors of {} could be read", shard.name)).collect();
    if checkpoint.is_partial() {
        unread.push(format!("{root}: the checkpoint is too large to be read whole"));
    }
    unread
}

/// Each tensor in the file that [`Checkpoint::tensor`] finds it in.
fn placed(checkpoint: &Checkpoint) -> Unpaired<'_> {
    let mapped = |name: &str| checkpoint.index.as_ref().and_then(|index| index.weight_map.get(name));
    let mut found = Unpaired::new();
    for (shard, tensor) in checkpoint.tensors() {
        let place = found.entry(tensor.name.as_str()).or_insert((shard, tensor));
        if mapped(&tensor.name).is_some_and(|file| **file == *shard.name) {
            *place = (shard, tensor);
        }
    }
    found
}

fn tensors(
    one: &Checkpoint,
    other: &Checkpoint,
    library: &Library,
    bytes: ComparedBytes,
    unknown: &mut Vec<String>,
) -> TensorDifferences {
    let (mut left, mut right) = (placed(one), placed(other));
    let (before, after) = (left.len(), right.len());
    let shared: Vec<&str> = left.keys().copied().filter(|name| right.contains_key(name)).collect();
    let mut pairs: Vec<(Placed<'_>, Placed<'_>)> = Vec::new();
    for name in shared {
        pairs.extend(left.remove(name).zip(right.remove(name)));
    }
    let renamed = renamings::pair(&mut left, &mut right, &mut pairs);
    let mut found = TensorDifferences { before, after, bytes, renamed, ..TensorDifferences::default() };
    let sides = converted::sides(one, other, library, &left, &right);
    (found.converted, found.removed, found.added) = (sides.converted, sides.removed, sides.added);
    let is_measured = matches!(bytes, ComparedBytes::Measured | ComparedBytes::Ranked);
    let by = |before, after| is_measured.then(|| one.distance(before, other, after)).flatten();
    let is_ranked = bytes == ComparedBytes::Ranked;
    let rank = |before, after| is_ranked.then(|| one.difference_rank(before, other, after)).flatten();
    for (before, after) in pairs {
        let name = || before.1.name.clone();
        if before.1.shape != after.1.shape {
            let (before, after) = (before.1.shape.clone(), after.1.shape.clone());
            found.reshaped.push(Reshaped { name: name(), before, after });
        } else if before.1.dtype != after.1.dtype {
            let by = by(before, after);
            let [before, after] = [before, after].map(|(_, tensor)| tensor.dtype.to_string());
            found.recast.push(Recast { name: name(), before, after, by });
        } else {
            match one.bytes_equal(before, other, after, bytes != ComparedBytes::Sampled) {
                Some(false) => {
                    found.changed.push(Changed { name: name(), by: by(before, after), rank: rank(before, after) });
                }
                Some(true) => found.equal = found.equal.saturating_add(1),
                None => unknown.push(format!("the bytes of {} could not be compared", before.1.name)),
            }
        }
    }
    found
}

/// Documents of both that differ. The values of an index follow from the tensors.
fn documents(one: &Checkpoint, other: &Checkpoint, unknown: &mut Vec<String>) -> Vec<DocumentChange> {
    let mut changes = Vec::new();
    for (name, document) in &one.documents {
        let Some(there) = other.documents.get(name) else { continue };
        if is_index(name) || document.text.is_some() && document.text == there.text {
            continue;
        }
        match (&document.value, &there.value) {
            (Some(before), Some(after)) => changes.extend(values::changes(name, before, after)),
            _ => unknown.push(format!("{name} could not be read in both")),
        }
    }
    changes
}

fn is_index(name: &str) -> bool {
    Index::is_index(name) || name == files::PICKLE_INDEX
}

fn tokens(one: &Checkpoint, other: &Checkpoint) -> Option<TokenChange> {
    match one.tokenizer.compare(&other.tokenizer) {
        Tokens::Different { token, own, others, count } => {
            Some(TokenChange { tokens: count, first: token, before: own, after: others })
        }
        Tokens::Unknown | Tokens::Equal => None,
    }
}

fn file_changes(one: &Checkpoint, other: &Checkpoint, unknown: &mut Vec<String>) -> FileChanges {
    let names = |checkpoint: &Checkpoint| -> BTreeSet<String> {
        let is_other =
            |name: &&String| !checkpoint.shards.contains_key(*name) && !is_index(name) && !name.starts_with('.');
        checkpoint.entries.keys().filter(is_other).cloned().collect()
    };
    let (here, there) = (names(one), names(other));
    let mut changes = FileChanges {
        added: there.difference(&here).cloned().collect(),
        removed: here.difference(&there).cloned().collect(),
        changed: Vec::new(),
    };
    for name in here.intersection(&there).filter(|name| !one.documents.contains_key(*name)) {
        let [Some(before), Some(after)] = [one, other].map(|checkpoint| checkpoint.entries.get(name)) else { continue };
        if before.kind == EntryKind::Directory && after.kind == EntryKind::Directory {
            unknown.push(format!("the folder {name} was not compared"));
        } else if (before.kind, before.size) != (after.kind, after.size) {
            changes.changed.push(name.clone());
        } else {
            match one.file_equal(name, other, FILE_CAP) {
                Ok(true) => {}
                Ok(false) => changes.changed.push(name.clone()),
                Err(error) => unknown.push(format!("{name} was not compared: {error}")),
            }
        }
    }
    changes
}
