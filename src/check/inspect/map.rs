//! A checkpoint as a map: its modules, and how many bytes of each have which properties.

use std::collections::HashMap;

use super::tree::{self, InspectedModule};
use crate::check::verdict::PredictedLoad;
use crate::checkpoint::{Checkpoint, Shard, Tensor};

/// Files that are told apart on a map.
const FILES: usize = 48;

/// The modules of a checkpoint with the properties that pages show as colours.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ModuleMap {
    /// The properties.
    pub properties: Vec<MapProperty>,
    /// The tree of modules as `inspect` has it; [`InspectedModule::shares`] are filled.
    pub modules: Vec<InspectedModule>,
}

/// A property of tensors, with its values.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MapProperty {
    /// What it tells.
    pub kind: PropertyKind,
    /// Its values. Those that no tensor has are among them.
    pub values: Vec<String>,
}

/// What a property of tensors tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PropertyKind {
    /// The element type.
    Dtype,
    /// The file.
    File,
    /// What the first loader of the run does with it, as [`LoadReport`](crate::check::load::LoadReport) says.
    Load,
    /// How it differs from the tensor of another checkpoint.
    Change,
    /// Where a merge took it from.
    Origin,
}

/// A property, and which of its values a tensor has.
pub(crate) struct Painted<'p> {
    pub(crate) property: MapProperty,
    pub(crate) value: ValueOf<'p>,
}

impl<'p> Painted<'p> {
    /// A property by the names of tensors: places in `values`, of which the first one is that of all other names.
    pub(crate) fn by_name(kind: PropertyKind, values: Vec<String>, of: HashMap<&'p str, usize>) -> Self {
        let value = move |_: &Shard, tensor: &Tensor| of.get(tensor.name.as_str()).copied().unwrap_or_default();
        Self { property: MapProperty { kind, values }, value: Box::new(value) }
    }
}

/// The place of a tensor's value in the values of a property.
pub(crate) type ValueOf<'p> = Box<dyn Fn(&Shard, &Tensor) -> usize + 'p>;

impl ModuleMap {
    /// The map of a checkpoint by element type, by file, and by what happens at the load. Called for the page of an inspection,
    /// with the verdicts of a check.
    #[must_use]
    pub fn of(checkpoint: &Checkpoint, loads: &[PredictedLoad]) -> Self {
        let painted = [Some(by_dtype(checkpoint)), Some(by_file(checkpoint)), by_load(loads)];
        Self::new(checkpoint, &painted.into_iter().flatten().collect::<Vec<_>>())
    }

    /// The map of a checkpoint by what names say of their tensors, and by element type; the first of `values` is said of
    /// tensors without a name in `origins`. Called for the page of a merge.
    pub(crate) fn by_origin<'o>(
        checkpoint: &Checkpoint,
        mut values: Vec<String>,
        origins: impl IntoIterator<Item = (&'o str, String)>,
    ) -> Self {
        let mut of: HashMap<&str, usize> = HashMap::new();
        for (name, value) in origins {
            let at = values.iter().position(|known| *known == value).unwrap_or_else(|| {
                values.push(value);
                values.len().saturating_sub(1)
            });
            of.insert(name, at);
        }
        Self::new(checkpoint, &[Painted::by_name(PropertyKind::Origin, values, of), by_dtype(checkpoint)])
    }

    /// The map of a checkpoint by these properties. Of tensors with one name, the last one tells the values.
    pub(crate) fn new(checkpoint: &Checkpoint, painted: &[Painted<'_>]) -> Self {
        let mut starts = Vec::new();
        let mut length: usize = 0;
        for one in painted {
            starts.push(length);
            length = length.saturating_add(one.property.values.len());
        }
        let places = |shard: &Shard, tensor: &Tensor| -> Vec<usize> {
            painted.iter().zip(&starts).map(|(one, start)| start.saturating_add((one.value)(shard, tensor))).collect()
        };
        let of: HashMap<&str, Vec<usize>> =
            checkpoint.tensors().map(|(shard, tensor)| (tensor.name.as_str(), places(shard, tensor))).collect();
        let add = |tensor: &Tensor, shares: &mut Vec<u64>| {
            shares.resize(length, 0);
            for place in of.get(tensor.name.as_str()).into_iter().flatten() {
                if let Some(share) = shares.get_mut(*place) {
                    *share = share.saturating_add(tensor.len());
                }
            }
        };
        let modules = tree::of(checkpoint, &add);
        Self { properties: painted.iter().map(|one| one.property.clone()).collect(), modules }
    }
}

/// Element types, those with the most bytes first.
pub(crate) fn by_dtype(checkpoint: &Checkpoint) -> Painted<'_> {
    let mut bytes: Vec<(&'static str, u64)> = Vec::new();
    for (_, tensor) in checkpoint.tensors() {
        let name = tensor.dtype.name();
        match bytes.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sum)) => *sum = sum.saturating_add(tensor.len()),
            None => bytes.push((name, tensor.len())),
        }
    }
    bytes.sort_by_key(|(name, sum)| (std::cmp::Reverse(*sum), *name));
    let names: Vec<&'static str> = bytes.into_iter().map(|(name, _)| name).collect();
    let values = names.iter().map(|&name| name.to_owned()).collect();
    let value = move |_: &Shard, tensor: &Tensor| {
        names.iter().position(|name| *name == tensor.dtype.name()).unwrap_or_default()
    };
    Painted { property: MapProperty { kind: PropertyKind::Dtype, values }, value: Box::new(value) }
}

/// Files, of which those behind [`FILES`] are one value: every module has a number for each.
fn by_file(checkpoint: &Checkpoint) -> Painted<'_> {
    let names = checkpoint.shards.keys();
    let mut values: Vec<String> = names.clone().take(FILES).cloned().collect();
    let further = names.len().saturating_sub(values.len());
    if further > 0 {
        values.push(format!("{further} more files"));
    }
    let last = values.len().saturating_sub(1);
    let places: HashMap<&str, usize> = names.take(FILES).enumerate().map(|(at, name)| (name.as_str(), at)).collect();
    let value = move |shard: &Shard, _: &Tensor| places.get(shard.name.as_str()).copied().unwrap_or(last);
    Painted { property: MapProperty { kind: PropertyKind::File, values }, value: Box::new(value) }
}

/// By the lists of the first load report; none without one. A list that is cut, or that has the names of the class where the
/// files have others, tells nothing of the tensors that it does not name.
fn by_load(loads: &[PredictedLoad]) -> Option<Painted<'_>> {
    let report = loads.iter().find_map(|load| load.tensors.as_ref())?;
    let unexpected = report.unexpected.iter().map(|name| (name.as_str(), 1));
    let mismatched = report.mismatched.iter().map(|one| (one.name.as_str(), 2));
    let silent = report.silent.iter().map(|one| (one.name.as_str(), 3));
    let named = unexpected.chain(mismatched).chain(silent).collect();
    let other = format!("in no list of {}", report.loader);
    let values = std::iter::once(other).chain(["unexpected", "mismatched", "silent"].map(str::to_owned)).collect();
    Some(Painted::by_name(PropertyKind::Load, values, named))
}
