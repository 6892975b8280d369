//! Other names for tensors.

use std::collections::BTreeSet;

use crate::check::fix::{Edit, renamed};
use crate::check::index::all_read;
use crate::checkpoint::Checkpoint;

/// Renames tensors by their prefixes, when the shards that have them can be written again and no two tensors end up under
/// one name.
pub(in crate::check::fix) fn rename(checkpoint: &Checkpoint, prefixes: Vec<(String, String)>) -> Option<Edit> {
    // A shard that is not here would keep its names, and the index would not.
    if !all_read(checkpoint) {
        return None;
    }
    let index = checkpoint.index.as_ref().filter(|index| !index.weight_map.is_empty());
    let indexed = index.map(|index| &index.files);
    let mut after = BTreeSet::new();
    let (mut before, mut moved) = (BTreeSet::new(), BTreeSet::new());
    for (shard, tensor) in checkpoint.tensors() {
        let new = renamed(&prefixes, &tensor.name);
        if new.is_some() {
            moved.insert(&*shard.name);
        }
        before.insert(&*tensor.name);
        after.insert(new.unwrap_or_else(|| tensor.name.clone()));
    }
    // Names in a file that no loader opens beside the others are somebody else's.
    let fits = |name: &str| {
        let is_ours = indexed.as_ref().is_none_or(|indexed| indexed.contains(name));
        is_ours && checkpoint.shards.get(name).is_some_and(super::is_rewritable)
    };
    (!moved.is_empty() && after.len() == before.len() && moved.into_iter().all(fits))
        .then_some(Edit::Rename { prefixes })
}
