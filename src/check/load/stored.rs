//! What the loader finds in a checkpoint: keys, and the tensors behind them.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Arc;

use crate::checkpoint::{Checkpoint, Shard};
use crate::knowledge::Evidence;

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
    /// Every key, and every tensor in the files that the loader opens, which have shapes.
    tensors: Evidence,
    /// The tensors that are no keys.
    unlisted: BTreeSet<String>,
    absent: BTreeSet<String>,
    /// Whether a file that the loader opens was read without a fault: without a tensor in it, everything is missing.
    was_read: bool,
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
    pub fn new<'s>(index: Option<&BTreeMap<String, Arc<str>>>, shards: impl IntoIterator<Item = &'s Shard>) -> Self {
        let shards: BTreeMap<&str, &Shard> = shards.into_iter().map(|s| (s.name.as_str(), s)).collect();
        match (shards.get(files::WEIGHTS).or_else(|| shards.get(files::PICKLED_WEIGHTS)), index) {
            (Some(single), _) => Self::together(&[single]),
            (None, None) => {
                let of_model: Vec<&Shard> = shards.into_values().filter(|s| is_of_model(&s.name)).collect();
                Self::together(&of_model)
            }
            (None, Some(index)) => {
                let files: HashSet<&str> = index.values().map(|file| &**file).collect();
                let mut opened: Vec<&Shard> = files.iter().filter_map(|file| shards.get(file).copied()).collect();
                opened.sort_unstable_by_key(|shard| shard.name.as_str());
                // A shard that is not there or could not be read may hold anything.
                let all_read = opened.len() == files.len() && opened.iter().all(|shard| !shard.unread);
                let together = Self::together(&opened);
                let keys: BTreeSet<&str> = index.keys().map(String::as_str).collect();
                let held: BTreeSet<&str> = together.shapes().map(|(name, _)| name).collect();
                let owned = |names: &mut dyn Iterator<Item = &&str>| names.map(|name| (*name).to_owned()).collect();
                let unlisted: BTreeSet<String> = owned(&mut held.difference(&keys));
                let unread: BTreeSet<String> = owned(&mut keys.difference(&held));
                let tensors = if unread.is_empty() {
                    together.tensors
                } else {
                    let keys = unread.iter().map(|name| (name.clone(), None));
                    let held = together.shapes().map(|(name, shape)| (name.to_owned(), Some(shape.to_vec())));
                    held.chain(keys).collect()
                };
                let absent = if all_read { unread } else { BTreeSet::new() };
                Self { tensors, unlisted, absent, was_read: together.was_read }
            }
        }
    }

    /// What these shards hold; of tensors of one name that of the last shard.
    fn together(shards: &[&Shard]) -> Self {
        let tensors = shards.iter().flat_map(|shard| &shard.tensors);
        let tensors = tensors.map(|t| (t.name.clone(), Some(t.shape.clone()))).collect();
        Self { tensors, was_read: shards.iter().any(|shard| shard.tells_all_tensors()), ..Self::default() }
    }

    /// Names and shapes of one file.
    #[must_use]
    pub fn from_shapes(shapes: BTreeMap<String, Vec<u64>>) -> Self {
        Self { tensors: shapes.into_iter().map(|(name, shape)| (name, Some(shape))).collect(), ..Self::default() }
    }

    /// The same with some tensors taken out and others put in; of those the shape may be unknown.
    #[must_use]
    pub fn replacing(&self, taken: &BTreeSet<String>, added: BTreeMap<String, Option<Vec<u64>>>) -> Self {
        let is_kept = |name: &str| !taken.contains(name);
        let of = |set: &BTreeSet<String>| set.iter().filter(|name| is_kept(name)).cloned().collect();
        let (mut unlisted, absent): (BTreeSet<String>, _) = (of(&self.unlisted), of(&self.absent));
        unlisted.retain(|name| !added.contains_key(name));
        let kept = self.tensors.iter().filter(|(name, _)| is_kept(name));
        let kept = kept.map(|(name, shape)| (name.to_owned(), shape.map(<[u64]>::to_vec)));
        let added = added.into_iter().map(|(name, shape)| {
            let before = || self.shape(&name).filter(|_| is_kept(&name)).map(<[u64]>::to_vec);
            let shape = shape.or_else(before);
            (name, shape)
        });
        Self { tensors: kept.chain(added).collect(), unlisted, absent, was_read: self.was_read }
    }

    /// The same with these names starting with `to` instead of `from`.
    #[must_use]
    pub fn under(&self, names: &[String], from: &str, to: &str) -> Self {
        let names: BTreeSet<&str> = names.iter().map(String::as_str).collect();
        let renamed = |name: &str| match name.strip_prefix(from).filter(|_| names.contains(name)) {
            Some(rest) => format!("{to}{rest}"),
            None => name.to_owned(),
        };
        let keys: BTreeSet<String> = self.names().map(renamed).collect();
        let unlisted = self.unlisted.iter().map(|name| renamed(name)).filter(|name| !keys.contains(name)).collect();
        let unread = self.tensors.iter().filter(|(_, shape)| shape.is_none()).map(|(name, _)| (renamed(name), None));
        let held = self.shapes().map(|(name, shape)| (renamed(name), Some(shape.to_vec())));
        Self {
            tensors: unread.chain(held).collect(),
            unlisted,
            absent: self.absent.iter().map(|name| renamed(name)).collect(),
            was_read: self.was_read,
        }
    }

    /// What the loader reads as keys.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let all = self.tensors.iter().map(|(name, _)| name);
        all.filter(|name| self.unlisted.is_empty() || !self.unlisted.contains(*name))
    }

    /// Whether nothing is known of what a loader finds: no tensor was read, and no file that is known to be empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.tensors.iter().next().is_none() && !self.was_read
    }

    /// Whether causes and similar classes are searched for these tensors: a search keeps further copies of their names.
    #[must_use]
    pub(in crate::check) fn is_searchable(&self) -> bool {
        let bytes = self.names().fold(0_usize, |sum, name| sum.saturating_add(name.len()));
        self.tensors.iter().count() <= SEARCHED && bytes <= SEARCHED_BYTES
    }

    /// The stored tensors, for what an architecture reads off them.
    #[must_use]
    pub fn evidence(&self) -> Evidence {
        self.tensors.clone()
    }

    /// Tensors in the files the loader opens; those of the index stand in for files that are not there, without a shape.
    pub(super) fn in_files(&self) -> impl Iterator<Item = (&str, Option<&[u64]>)> {
        let held = self.shapes().map(|(name, shape)| (name, Some(shape)));
        held.chain(self.tensors.iter().filter(|(name, shape)| shape.is_none() && !self.absent.contains(*name)))
    }

    /// Shape of a tensor, when its file was read.
    pub(in crate::check) fn shape(&self, name: &str) -> Option<&[u64]> {
        self.tensors.shape(name)
    }

    /// Tensors in the files the loader opens, by name.
    pub(in crate::check) fn shapes(&self) -> impl Iterator<Item = (&str, &[u64])> {
        self.tensors.iter().filter_map(|(name, shape)| Some((name, shape?)))
    }

    /// Keys that are in no shard although every shard was read.
    pub(super) fn absent(&self) -> impl Iterator<Item = &str> {
        self.absent.iter().map(String::as_str)
    }

    pub(super) fn is_absent(&self, key: &str) -> bool {
        self.absent.contains(key)
    }
}
