//! Tensors that are other ones in the files, and the same once a loader has opened them.

use std::collections::BTreeSet;

use super::{Converted, OneSided, Unpaired};
use crate::check::load::{self, Stored};
use crate::checkpoint::Checkpoint;
use crate::knowledge::{Evidence, Expected, Library, Loader};

/// The tensors that have no partner.
#[derive(Default)]
pub(super) struct Sides {
    pub(super) converted: Option<Converted>,
    pub(super) removed: Vec<OneSided>,
    pub(super) added: Vec<OneSided>,
}

/// Tells which of the tensors without a partner are the same in the model of the newest version that has the class of both
/// checkpoints. Without such a version, or where it explains none, all of them are of one side alone.
pub(super) fn sides(
    one: &Checkpoint,
    other: &Checkpoint,
    library: &Library,
    left: &Unpaired<'_>,
    right: &Unpaired<'_>,
) -> Sides {
    let alone = Sides { converted: None, removed: stored(left), added: stored(right) };
    if left.is_empty() && right.is_empty() {
        return alone;
    }
    let made = Loader::ALL.into_iter().rev().find_map(|loader| {
        let before = in_model(one, other, library, loader)?;
        Some((loader, before, in_model(other, one, library, loader)?))
    });
    let Some((loader, before, after)) = made else { return alone };
    let (removed, added) = (lacking(&before, &after), lacking(&after, &before));
    let count = |sides: [usize; 2]| sides.into_iter().fold(0_usize, usize::saturating_add);
    if count([removed.len(), added.len()]) >= count([left.len(), right.len()]) {
        return alone;
    }
    let converted = Converted {
        loader: loader.version().to_owned(),
        before: left.len().saturating_sub(removed.len()),
        after: right.len().saturating_sub(added.len()),
    };
    Sides { converted: Some(converted), removed, added }
}

fn stored(unpaired: &Unpaired<'_>) -> Vec<OneSided> {
    let one = |(name, (_, tensor)): (&&str, &super::Placed<'_>)| OneSided {
        name: (*name).to_owned(),
        shape: Some(tensor.shape.clone()),
        dtype: Some(tensor.dtype.to_string()),
    };
    unpaired.iter().map(one).collect()
}

/// The tensors of the model that this version makes of a checkpoint, with those that are tied to one of them. A checkpoint
/// without a config has that of the other one.
fn in_model(checkpoint: &Checkpoint, beside: &Checkpoint, library: &Library, loader: Loader) -> Option<Evidence> {
    let config = checkpoint.config().or_else(|| beside.config())?;
    let stored = Stored::of(checkpoint);
    let names: Vec<&str> = stored.names().collect();
    let architecture = library.find(config, names.iter().copied(), loader)?;
    let expected = load::build(architecture, config, &stored).ok()?;
    Some(with_tied(&expected, &load::in_model(&expected, &stored)))
}

fn with_tied(expected: &Expected, stored: &Evidence) -> Evidence {
    let tied = expected.tensors.iter().filter_map(|(name, tensor)| Some((name, tensor, tensor.tied_to.as_ref()?)));
    let both = tied.filter(|(name, _, to)| stored.contains(name) != stored.contains(to));
    let more = both.flat_map(|(name, tensor, to)| [name, to].map(|name| (name.clone(), Some(tensor.shape.clone()))));
    let own = stored.iter().map(|(name, shape)| (name.to_owned(), shape.map(<[u64]>::to_vec)));
    own.chain(more).collect()
}

/// The tensors of one model that the other one lacks, or has in another shape.
fn lacking(one: &Evidence, other: &Evidence) -> Vec<OneSided> {
    let names: BTreeSet<&str> = other.iter().map(|(name, _)| name).collect();
    let lacks = |(name, shape): &(&str, Option<&[u64]>)| {
        let differs = || shape.zip(other.shape(name)).is_some_and(|(own, there)| own != there);
        !names.contains(name) || differs()
    };
    let alone = one.iter().filter(lacks);
    alone
        .map(|(name, shape)| OneSided { name: name.to_owned(), shape: shape.map(<[u64]>::to_vec), dtype: None })
        .collect()
}
