//! What the loader finds in a checkpoint: keys, and the tensors behind them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::OnceLock;

use crate::checkpoint::{Checkpoint, PICKLE_NAME, Shard};
use crate::knowledge::Evidence;

/// The file a loader takes before it looks for an index.
const SINGLE: &str = "model.safetensors";

/// Whether a shard without an index is one of the model, and not of an adapter or another program, by its name.
fn is_of_model(name: &str) -> bool {
    name.starts_with("model") || name.starts_with("pytorch_model")
}

/// Maximum number of stored tensors for which causes are searched; the largest published models have some 210 000.
const SEARCHED: usize = 300_000;
/// Maximum number of bytes of their names; those of the largest published models have some 15 MB.
const SEARCHED_BYTES: usize = 24 << 20;

/// Keys and tensors as the loader sees them.
///
/// Keys come from the index alone, values from every shard the index names: a tensor in a shard and not in
/// the index is used, and still reported missing.
#[derive(Debug, Clone, Default)]
pub struct Stored {
    keys: BTreeSet<String>,
    shapes: BTreeMap<String, Vec<u64>>,
    absent: BTreeSet<String>,
    /// Whether a file that the loader opens was read without a fault: without a tensor in it, everything is missing.
    was_read: bool,
    /// What [`Stored::evidence`] made.
    evidence: OnceLock<Evidence>,
}

impl Stored {
    /// What a loader finds in this checkpoint.
    #[must_use]
    pub fn of(checkpoint: &Checkpoint) -> Self {
        let index = checkpoint.index.as_ref().filter(|index| !index.unread);
        Self::new(index.map(|index| &index.weight_map), checkpoint.shards.values())
    }

    /// From an index, tensor name to file name, and the shards that are there.
    ///
    /// A `model.safetensors` or `pytorch_model.bin` beside an index wins. Without either no loader opens anything; then the shards that
    /// an index would name are taken together.
    #[must_use]
    pub fn new<'s>(index: Option<&BTreeMap<String, String>>, shards: impl IntoIterator<Item = &'s Shard>) -> Self {
        let shards: BTreeMap<&str, &Shard> = shards.into_iter().map(|s| (s.name.as_str(), s)).collect();
        match (shards.get(SINGLE).or_else(|| shards.get(PICKLE_NAME)), index) {
            (Some(single), _) => Self::together([*single]),
            (None, None) => Self::together(shards.into_values().filter(|s| is_of_model(&s.name))),
            (None, Some(index)) => {
                let files: BTreeSet<&str> = index.values().map(String::as_str).collect();
                let opened: Vec<&Shard> = files.iter().filter_map(|file| shards.get(file).copied()).collect();
                // A shard that is not there or could not be read may hold anything.
                let all_read = opened.len() == files.len() && opened.iter().all(|shard| !shard.unread);
                let Self { shapes, was_read, .. } = Self::together(opened);
                let keys: BTreeSet<String> = index.keys().cloned().collect();
                let absent = keys.iter().filter(|key| all_read && !shapes.contains_key(*key)).cloned().collect();
                Self { keys, shapes, absent, was_read, ..Self::default() }
            }
        }
    }

    fn together<'s>(shards: impl IntoIterator<Item = &'s Shard>) -> Self {
        let (mut shapes, mut was_read) = (BTreeMap::new(), false);
        for shard in shards {
            was_read |= shard.is_sound();
            shapes.extend(shard.tensors.iter().map(|t| (t.name.clone(), t.shape.clone())));
        }
        Self { was_read, ..Self::from_shapes(shapes) }
    }

    /// Names and shapes of one file.
    #[must_use]
    pub fn from_shapes(shapes: BTreeMap<String, Vec<u64>>) -> Self {
        Self { keys: shapes.keys().cloned().collect(), shapes, ..Self::default() }
    }

    /// The same with some tensors taken out and others put in; of those the shape may be unknown.
    #[must_use]
    pub fn replacing(&self, taken: &BTreeSet<String>, added: BTreeMap<String, Option<Vec<u64>>>) -> Self {
        let mut replaced = Self { evidence: OnceLock::new(), ..self.clone() };
        replaced.keys.retain(|name| !taken.contains(name));
        replaced.absent.retain(|name| !taken.contains(name));
        replaced.shapes.retain(|name, _| !taken.contains(name));
        for (name, shape) in added {
            replaced.shapes.extend(shape.map(|shape| (name.clone(), shape)));
            replaced.keys.insert(name);
        }
        replaced
    }

    /// The same with these names starting with `to` instead of `from`.
    #[must_use]
    pub fn under(&self, names: &[String], from: &str, to: &str) -> Self {
        let names: BTreeSet<&String> = names.iter().collect();
        let renamed = |name: &String| match name.strip_prefix(from).filter(|_| names.contains(name)) {
            Some(rest) => format!("{to}{rest}"),
            None => name.clone(),
        };
        Self {
            keys: self.keys.iter().map(renamed).collect(),
            shapes: self.shapes.iter().map(|(name, shape)| (renamed(name), shape.clone())).collect(),
            absent: self.absent.iter().map(renamed).collect(),
            was_read: self.was_read,
            ..Self::default()
        }
    }

    /// What the loader reads as keys.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.keys.iter().map(String::as_str)
    }

    /// Whether nothing is known of what a loader finds: no tensor was read, and no file that is known to be empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty() && self.shapes.is_empty() && !self.was_read
    }

    /// Whether causes and similar classes are searched for these tensors: a search keeps further copies of their names.
    #[must_use]
    pub(in crate::check) fn is_searchable(&self) -> bool {
        let bytes = self.keys.iter().fold(0_usize, |sum, name| sum.saturating_add(name.len()));
        self.keys.len().max(self.shapes.len()) <= SEARCHED && bytes <= SEARCHED_BYTES
    }

    /// The stored tensors, for what an architecture reads off them.
    #[must_use]
    pub fn evidence(&self) -> Evidence {
        let shapes = self.shapes.iter().map(|(name, shape)| (name.clone(), Some(shape.clone())));
        let others = self.keys.iter().filter(|key| !self.shapes.contains_key(*key)).map(|key| (key.clone(), None));
        self.evidence.get_or_init(|| shapes.chain(others).collect()).clone()
    }

    /// Names in the files the loader opens; those of the index stand in for files that are not there.
    pub(super) fn file_names(&self) -> impl Iterator<Item = &str> {
        let unread = self.keys.iter().filter(|key| !self.shapes.contains_key(*key) && !self.absent.contains(*key));
        self.shapes.keys().chain(unread).map(String::as_str)
    }

    /// Shape of a tensor, when its file was read.
    pub(in crate::check) fn shape(&self, name: &str) -> Option<&[u64]> {
        self.shapes.get(name).map(Vec::as_slice)
    }

    /// Tensors in the files the loader opens, by name.
    pub(in crate::check) fn shapes(&self) -> impl Iterator<Item = (&str, &[u64])> {
        self.shapes.iter().map(|(name, shape)| (name.as_str(), shape.as_slice()))
    }

    /// Keys that are in no shard although every shard was read.
    pub(super) fn absent(&self) -> impl Iterator<Item = &str> {
        self.absent.iter().map(String::as_str)
    }

    pub(super) fn is_absent(&self, key: &str) -> bool {
        self.absent.contains(key)
    }
}
