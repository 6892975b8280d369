//! Which stored tensors make up one quantised module.

use std::collections::{BTreeMap, BTreeSet};

use super::skipped::SkippedModules;
use crate::check::index;
use crate::check::load::Stored;
use crate::checkpoint::{Checkpoint, Dtype};
use crate::knowledge::quantization::{Scheme, Shapes, StoredPart};

/// The known facts of a stored tensor; both are unknown when only an index was read.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Held<'c> {
    pub(super) shape: Option<&'c [u64]>,
    pub(super) dtype: Option<Dtype>,
}

/// The tensors that a loader finds, by name.
pub(super) struct TensorLookup<'c>(BTreeMap<&'c str, Held<'c>>);

impl<'c> TensorLookup<'c> {
    pub(super) fn new(checkpoint: &'c Checkpoint, stored: &'c Stored) -> Self {
        let mut tensors: BTreeMap<&str, Held<'_>> = stored.names().map(|name| (name, Held::default())).collect();
        for tensor in index::opened_tensors(checkpoint) {
            if let Some(held) = tensors.get_mut(tensor.name.as_str()) {
                *held = Held { shape: Some(&tensor.shape), dtype: Some(tensor.dtype) };
            }
        }
        Self(tensors)
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &'c str> {
        self.0.keys().copied()
    }
}

/// A module whose values are stored by a scheme, with the tensors of the scheme that it has, in the order of the scheme.
#[derive(Debug)]
pub(super) struct StoredModule<'c> {
    /// Its name: that of the plain tensor without the scheme's ending.
    pub(super) name: &'c str,
    pub(super) held: Vec<Option<Held<'c>>>,
}

impl StoredModule<'_> {
    /// Endings of the stored tensors.
    pub(super) fn endings<'s>(&self, scheme: &'s Scheme) -> Vec<&'s str> {
        scheme.endings().zip(&self.held).filter_map(|(ending, held)| held.is_some().then_some(ending)).collect()
    }

    /// Shapes of the stored tensors, where they are known.
    pub(super) fn shapes(&self) -> Shapes {
        self.held.iter().map(|held| Some(held.as_ref()?.shape?.to_vec())).collect()
    }
}

/// The modules of a scheme among these tensors, by name.
///
/// A module is recognised by its first tensor, which holds the values. If that tensor keeps its plain name, another one
/// must be stored too, or its type must be an 8-bit float. `plain` returns whether a class has a tensor of that name, which is
/// then not a scale.
pub(super) fn group<'c>(
    scheme: &Scheme,
    tensors: &TensorLookup<'c>,
    plain: impl Fn(&str) -> bool,
) -> Vec<StoredModule<'c>> {
    let mut endings: Vec<(usize, &str)> = scheme.endings().enumerate().collect();
    // `_scale_inv` before `_scale`; the plain ending is that of any other tensor too.
    endings.sort_by_key(|(_, ending)| std::cmp::Reverse(ending.len()));
    endings.retain(|(_, ending)| *ending != scheme.plain);
    let mut names: BTreeSet<&str> = BTreeSet::new();
    for name in tensors.names() {
        if let Some(module) = endings.iter().find_map(|(_, ending)| name.strip_suffix(ending))
            && !plain(name)
        {
            names.insert(module);
        }
    }
    names.extend(eight_bit_floats(scheme, tensors, &endings));
    let held = |module: &str, ending: &str| tensors.0.get(format!("{module}{ending}").as_str()).copied();
    let module = |name| StoredModule { name, held: scheme.endings().map(|ending| held(name, ending)).collect() };
    names.into_iter().map(module).filter(|m| m.held.first().is_some_and(Option::is_some)).collect()
}

/// Modules whose values have the plain name and an 8-bit float of the scheme as their type: without a scale they are incomplete.
fn eight_bit_floats<'c>(
    scheme: &Scheme,
    tensors: &TensorLookup<'c>,
    others: &[(usize, &str)],
) -> impl Iterator<Item = &'c str> {
    let values = scheme.tensors.first().filter(|part| part.name == scheme.plain);
    let is_other = |name: &str| others.iter().any(|(_, ending)| name.ends_with(ending));
    let is_of_scheme = move |dtype: Dtype| {
        let stated = values.is_some_and(|part| part.dtypes.iter().any(|name| name == dtype.name()));
        stated && dtype.is_eight_bit_float()
    };
    let found = tensors.0.iter().filter(move |(name, held)| held.dtype.is_some_and(is_of_scheme) && !is_other(name));
    found.filter_map(|(name, _)| name.strip_suffix(scheme.plain.as_str()))
}

/// Modules that are stored plainly although others of their kind are quantised and the config does not leave them out.
pub(super) fn left_plain<'c>(
    scheme: &Scheme,
    tensors: &TensorLookup<'c>,
    kinds: &BTreeSet<String>,
    quantised: &BTreeSet<&str>,
    skipped: &SkippedModules<'_>,
) -> Vec<StoredModule<'c>> {
    let held = |name: &'c str| {
        scheme
            .endings()
            .map(|ending| if ending == scheme.plain { tensors.0.get(name).copied() } else { None })
            .collect()
    };
    tensors
        .names()
        .filter_map(|name| Some((name, name.strip_suffix(scheme.plain.as_str())?)))
        .filter(|(_, module)| !quantised.contains(module) && kinds.contains(&kind(module)))
        .filter(|(_, module)| !skipped.may_cover(module))
        .map(|(name, module)| StoredModule { name: module, held: held(name) })
        .collect()
}

/// A module's name with the numbers taken out: the same for one place in every layer.
pub(super) fn kind(name: &str) -> String {
    let segment = |s: &str| if s.bytes().all(|b| b.is_ascii_digit()) { "#".to_owned() } else { s.to_owned() };
    name.split('.').map(segment).collect::<Vec<_>>().join(".")
}

/// The scheme whose endings unexplained names have, and a module of it.
///
/// Only a module that has all that its scheme requires is taken for one.
#[must_use]
pub(super) fn signature<'k, 'n>(schemes: &'k [Scheme], names: &BTreeSet<&'n str>) -> Option<(&'k Scheme, &'n str)> {
    let has = |module: &str, part: &StoredPart| names.contains(&*format!("{module}{}", part.name));
    let whole = |scheme: &Scheme, module: &str| scheme.tensors.iter().all(|p| p.required.is_some() || has(module, p));
    let found = schemes.iter().filter_map(|scheme| {
        let sign = scheme.sign.as_deref()?;
        let module = names.iter().find_map(|name| name.strip_suffix(sign).filter(|module| whole(scheme, module)))?;
        Some((scheme, module))
    });
    // AWQ's names are GPTQ's without `g_idx`: the scheme that explains most is meant.
    found.max_by_key(|(scheme, module)| scheme.tensors.iter().filter(|part| has(module, part)).count())
}
