//! Tensors whose names have parts in the middle that the class does not have: the attributes of wrapper modules.
//!
//! Libraries that wrap each layer put the name of their attribute into every name: `_fsdp_wrapped_module`,
//! `_checkpoint_wrapped_module` (torch), `_orig_module` (XLA FSDP), `base_layer` (PEFT). Which parts to take out is read off
//! the names and shapes of the class; nothing here knows any of them.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::json;

use super::{Stored, with_names};
use crate::checkpoint::{Fault, FaultKind};
use crate::knowledge::Expected;

/// Fewest tensors from which a wrapper is concluded.
const FEWEST: usize = 4;

/// Tensors that get names of the class when parts are taken out of their names.
pub(super) struct Wrapped {
    /// The parts: `_orig_module`.
    parts: BTreeSet<String>,
    /// New names by stored name.
    names: BTreeMap<String, String>,
}

impl Wrapped {
    /// Called for a load whose report lists missing and unexpected tensors.
    pub(super) fn find(expected: &Expected, stored: &Stored) -> Option<Self> {
        let known: BTreeSet<&str> = expected.tensors.keys().flat_map(|name| name.split('.')).collect();
        let here: BTreeSet<&str> = stored.names().collect();
        let mut found = Self { parts: BTreeSet::new(), names: BTreeMap::new() };
        let mut taken: BTreeSet<String> = BTreeSet::new();
        for name in stored.names().filter(|name| !expected.tensors.contains_key(*name)) {
            let (kept, removed): (Vec<&str>, Vec<&str>) =
                name.split('.').partition(|part| known.contains(part) || part.parse::<u64>().is_ok());
            let new = kept.join(".");
            let Some(tensor) = expected.tensors.get(&new).filter(|_| !here.contains(&*new)) else { continue };
            // A matrix of an adapter beside the weight has another shape.
            let fits = stored.shape(name).is_none_or(|shape| shape == tensor.shape);
            // The last part is that of the tensor: quantised weights have other ones.
            let is_inside = name.split('.').skip(1).any(|part| removed.contains(&part));
            let is_inside = is_inside && name.rsplit('.').next().is_some_and(|part| known.contains(part));
            if fits && is_inside && taken.insert(new.clone()) {
                found.parts.extend(removed.into_iter().map(str::to_owned));
                found.names.insert(name.to_owned(), new);
            }
        }
        (found.names.len() >= FEWEST).then_some(found)
    }

    /// Number of tensors.
    pub(super) fn len(&self) -> usize {
        self.names.len()
    }

    /// The stored tensors under their new names.
    pub(super) fn renamed(&self, stored: &Stored) -> Stored {
        let taken = self.names.keys().cloned().collect();
        let new = |(old, new): (&String, &String)| (new.clone(), stored.shape(old).map(<[u64]>::to_vec));
        stored.replacing(&taken, self.names.iter().map(new).collect())
    }

    /// The fault, with the prefixes that rename these tensors.
    pub(super) fn fault(&self) -> Fault {
        let parts: Vec<&String> = self.parts.iter().collect();
        let fault = Fault::new(FaultKind::NamesWrapped)
            .with("parts", json!(parts))
            .with("count", self.names.len())
            .with("prefixes", json!(self.prefixes()));
        with_names(fault, "names", self.names.keys().map(String::as_str))
    }

    /// Pairs of prefixes that end after the last part to take out, the longest first: a prefix may be the start of another.
    fn prefixes(&self) -> Vec<(String, String)> {
        let cut = |(old, new): (&String, &String)| {
            let ends = old.match_indices('.').map(|(at, _)| at);
            let ends: Vec<usize> = ends.chain([old.len()]).collect();
            let parts = old.split('.').zip(ends).filter(|(part, _)| self.parts.contains(*part));
            let end = parts.map(|(_, end)| end).last()?;
            let rest = old.get(end..)?;
            Some((old.get(..end)?.to_owned() + ".", new.strip_suffix(rest)?.to_owned() + "."))
        };
        let pairs: BTreeMap<String, String> = self.names.iter().filter_map(cut).collect();
        let mut pairs: Vec<(String, String)> = pairs.into_iter().collect();
        pairs.sort_by(|a, b| b.0.len().cmp(&a.0.len()).then_with(|| a.cmp(b)));
        pairs
    }
}
