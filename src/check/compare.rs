//! What differs between two checkpoints: tensors under one naming, documents by value, tokens, and other files.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use serde_json::Value;

use crate::checkpoint::tokenizer::Comparison as Tokens;
use crate::checkpoint::{Checkpoint, Dtype, EntryKind, Index, Shard, Tensor, files};
use crate::knowledge::Library;

mod converted;
mod renamings;
mod values;

/// Maximum number of bytes of another file that is compared; of larger ones, only the sizes are.
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
    pub renamed: Vec<Renaming>,
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
    /// The first, middle and last 4096: tensors that were trained differ in them, and nearly always.
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
pub struct Renaming {
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
    pub by: Option<Magnitude>,
}

/// A tensor with other bytes.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Changed {
    /// Its name in the first checkpoint.
    pub name: String,
    /// By how much; missing unless it was asked for, and for values that are no finite floats.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<Magnitude>,
    /// Rank of the difference above rounding errors; missing unless it was asked for, and for all but matrices.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rank: Option<ChangedRank>,
}

/// The rank of a difference: 16 for a merged LoRA of that rank.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ChangedRank {
    /// The rank.
    pub rank: usize,
    /// Whether it may be larger.
    pub at_least: bool,
}

/// How far the values of a tensor are from those of another one. The norms are Euclidean ones of all values.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Magnitude {
    /// Norm of the first tensor.
    pub norm_before: f64,
    /// Norm of the second tensor.
    pub norm_after: f64,
    /// Norm of the difference.
    pub norm_of_difference: f64,
    /// The largest difference of two values.
    pub largest_difference: f64,
}

impl Magnitude {
    /// That of several tensors together.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            norm_before: self.norm_before.hypot(other.norm_before),
            norm_after: self.norm_after.hypot(other.norm_after),
            norm_of_difference: self.norm_of_difference.hypot(other.norm_of_difference),
            largest_difference: self.largest_difference.max(other.largest_difference),
        }
    }

    /// The norm of the difference, as a share of the first norm; `None` when that is zero.
    #[must_use]
    pub fn relative(self) -> Option<f64> {
        (self.norm_before > 0.0).then(|| self.norm_of_difference / self.norm_before)
    }

    /// The cosine of the angle between both; `None` when one norm is zero.
    #[must_use]
    pub fn cosine(self) -> Option<f64> {
        let (a, b, d) = (self.norm_before, self.norm_after, self.norm_of_difference);
        // That is (a² + b² − d²) / 2ab, without the difference of large squares.
        (a > 0.0 && b > 0.0).then(|| 1.0 - (d - (a - b).abs()) * (d + (a - b).abs()) / (2.0 * a * b))
    }
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

/// Files at the top of two directories that are neither documents nor weights, and documents of one alone.
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

/// Compares two checkpoints, for `diff`. With [`ComparedBytes::All`] it reads the tensors that have the same type and shape in
/// both.
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
    let partial = |shard: &&Shard| shard.unread || shard.further > 0 || !shard.unreadable.is_empty();
    let shards = checkpoint.shards.values().filter(partial);
    let mut unread: Vec<String> =
        shards.map(|shard| format!("{root}: not all tensors of {} could be read", shard.name)).collect();
    if checkpoint.is_partial() {
        unread.push(format!("{root}: the checkpoint is too large to be read whole"));
    }
    unread
}

fn placed(checkpoint: &Checkpoint) -> Unpaired<'_> {
    // Of a name in two files, the loader's is that of `Checkpoint::tensor`; the first one stands for it here.
    let mut found = Unpaired::new();
    for (shard, tensor) in checkpoint.tensors() {
        found.entry(&tensor.name).or_insert((shard, tensor));
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
    let by = |before, after| {
        let is_measured = matches!(bytes, ComparedBytes::Measured | ComparedBytes::Ranked);
        let measured = is_measured.then(|| one.distance(before, other, after)).flatten();
        measured.map(|found| Magnitude {
            norm_before: found.before,
            norm_after: found.after,
            norm_of_difference: found.difference,
            largest_difference: found.largest,
        })
    };
    for (before, after) in pairs {
        let name = || before.1.name.clone();
        if before.1.shape != after.1.shape {
            let (before, after) = (before.1.shape.clone(), after.1.shape.clone());
            found.reshaped.push(Reshaped { name: name(), before, after });
        } else if before.1.dtype != after.1.dtype {
            let by = by(before, after);
            let [before, after] = [before, after].map(|(_, tensor)| dtype(tensor.dtype));
            found.recast.push(Recast { name: name(), before, after, by });
        } else {
            match one.bytes_equal(before, other, after, bytes != ComparedBytes::Sampled) {
                Some(false) => {
                    let ranked = || one.difference_rank(before, other, after);
                    let rank = (bytes == ComparedBytes::Ranked).then(ranked).flatten();
                    let rank = rank.map(|found| ChangedRank { rank: found.rank, at_least: found.at_least });
                    found.changed.push(Changed { name: name(), by: by(before, after), rank });
                }
                Some(true) => found.equal = found.equal.saturating_add(1),
                None => unknown.push(format!("the bytes of {} could not be compared", before.1.name)),
            }
        }
    }
    found
}

fn dtype(dtype: Dtype) -> String {
    dtype.to_string()
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
        let is_file = |name: &&String| {
            checkpoint.entries.get(*name).is_some_and(|entry| entry.kind != EntryKind::Directory)
                && !checkpoint.shards.contains_key(*name)
                && !is_index(name)
        };
        checkpoint.entries.keys().filter(is_file).cloned().collect()
    };
    let (here, there) = (names(one), names(other));
    let mut changes = FileChanges {
        added: there.difference(&here).cloned().collect(),
        removed: here.difference(&there).cloned().collect(),
        changed: Vec::new(),
    };
    for name in here.intersection(&there).filter(|name| !one.documents.contains_key(*name)) {
        let size = |checkpoint: &Checkpoint| checkpoint.entries.get(name).map(|entry| entry.size);
        if size(one) != size(other) {
            changes.changed.push(name.clone());
            continue;
        }
        let read = |checkpoint: &Checkpoint| checkpoint.source.read_own(name, FILE_CAP);
        match (read(one), read(other)) {
            (Ok(before), Ok(after)) if before == after => {}
            (Ok(_), Ok(_)) => changes.changed.push(name.clone()),
            (Err(error), _) | (_, Err(error)) => unknown.push(format!("{name} was not compared: {error}")),
        }
    }
    changes
}
