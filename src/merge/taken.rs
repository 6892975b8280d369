//! The tensors that the entries of a recipe take from donors.

use std::collections::BTreeSet;

use regex::Regex;

use super::adapter::MergedAdapter;
use super::error::MergeError;
use super::fit::Fit;
use super::named::{AnnouncedCast, MergedRoles, NamedTensors};
use super::parts::{Donor, DonorParts, PartOf};
use crate::checkpoint::{Dtype, Shard, Tensor};
use crate::knowledge::recipe::TensorSpec;
use crate::surgery::expr::WordMap;
use crate::surgery::tensor_ref::TensorRef;
use crate::surgery::values::can_compute;

/// A tensor spec with its parts evaluated once.
pub(super) struct TensorRule<'a> {
    pub(super) spec: &'a TensorSpec,
    pub(super) names: Regex,
    pub(super) rename: Option<String>,
    pub(super) slice: Option<[u64; 2]>,
    pub(super) fit: Fit,
    pub(super) scale: Option<f64>,
    pub(super) dtype: Option<Dtype>,
    pub(super) adapter: Option<MergedAdapter>,
    /// The tensor whose rows new ones are like.
    pub(super) like: Option<TensorRef>,
    /// The map into the space of another embedding, with the fit `map`.
    pub(super) mapping: Option<WordMapping>,
    /// The part that the tensors belong to.
    pub(super) part: Option<PartOf<'a>>,
    /// The parts of the model that has them in the place of its own, and the name of the part there.
    pub(super) into: Option<(DonorParts, &'a str)>,
}

impl TensorRule<'_> {
    /// What the tensors are, for the report.
    pub(super) fn pattern(&self) -> &str {
        self.part.filter(|_| self.spec.names.is_empty()).map_or(self.spec.names.as_str(), |part| part.name)
    }

    /// The factor on a donor tensor. The output of a part that is meant as a whole is scaled once, by its last layer.
    pub(super) fn scale_of(&self, tensor: &Tensor) -> Option<f64> {
        let whole = self.part.filter(|_| self.spec.names.is_empty());
        self.scale.filter(|_| whole.is_none_or(|part| part.is_output(&tensor.name)))
    }

    /// Fails for a factor on a part of which no output is known.
    pub(super) fn scales_something(&self, recipe: &str) -> Result<(), MergeError> {
        let Some(part) = self.part.filter(|_| self.scale.is_some() && self.spec.names.is_empty()) else {
            return Ok(());
        };
        if part.donor().checkpoint.tensors().any(|(_, tensor)| part.is_output(&tensor.name)) {
            return Ok(());
        }
        Err(MergeError::Donor(format!(
            "recipe {recipe}: the part {} of the {} donor cannot be scaled: rules/parts names no tensor of its last layer; name the tensors by `names`",
            part.name,
            part.donor().role
        )))
    }

    /// The tensors that the entry may change; `None` when it changes none, or names none.
    pub(super) fn changeable(&self) -> Option<NamedTensors> {
        let changes = self.fit != Fit::Copy || self.scale.is_some() || self.slice.is_some();
        NamedTensors::of_entry(&self.spec.from, self.part, &self.spec.names).filter(|_| changes)
    }

    /// The casts that the entry announces.
    pub(super) fn casts(&self) -> impl Iterator<Item = AnnouncedCast> {
        let own = self.dtype.map(|dtype| AnnouncedCast { donor: self.spec.from.clone(), to: dtype.name().to_owned() });
        own.into_iter().chain(self.adapter.iter().flat_map(|adapter| adapter.casts.clone()))
    }

    /// The donor and the adapter that is merged into it.
    pub(super) fn merged(&self) -> Option<MergedRoles> {
        Some(MergedRoles { base: self.spec.from.clone(), adapter: self.adapter.as_ref()?.role.clone() })
    }

    /// Fails unless the entry takes every tensor that its adapter changes.
    pub(super) fn takes_all(&self, taken: &[TakenTensor<'_>]) -> Result<(), MergeError> {
        let Some(adapter) = &self.adapter else { return Ok(()) };
        let own: BTreeSet<&str> = taken
            .iter()
            .filter(|taken| std::ptr::eq(taken.rule, self))
            .map(|taken| taken.tensor.name.as_str())
            .collect();
        match adapter.names().find(|name| !own.contains(name)) {
            None => Ok(()),
            Some(left) => Err(MergeError::Recipe(format!(
                "the {} donor changes {left}, which the entry with the adapter does not take",
                adapter.role
            ))),
        }
    }

    /// Whether a donor tensor is meant.
    pub(super) fn takes(&self, donor: &Donor, tensor: &Tensor) -> bool {
        self.spec.from == donor.role
            && self.names.is_match(&tensor.name)
            && self.part.is_none_or(|part| part.inside(&tensor.name).is_some())
    }

    /// The name of a donor tensor in the result; `None` when the place of its part has none for it.
    pub(super) fn name(&self, tensor: &Tensor) -> Option<String> {
        let renamed = |name: String| match &self.rename {
            Some(to) => self.names.replace(&name, to.as_str()).into_owned(),
            None => name,
        };
        match (self.part.and_then(|part| Some((part, part.inside(&tensor.name)?))), &self.into) {
            (Some((_, inside)), Some((model, place))) => model.name_in(place, &renamed(inside)),
            (Some((part, inside)), None) if self.spec.alone => part.name_alone(renamed(inside)),
            _ => Some(renamed(tensor.name.clone())),
        }
    }
}

/// How the values of an entry are mapped into the space of another embedding.
#[derive(Debug, Clone)]
pub(super) struct WordMapping {
    /// The map, or why there is none.
    pub(super) map: Result<Box<WordMap<TensorRef>>, String>,
    /// Whether the rows of a matrix are points, and not its columns directions.
    pub(super) rows: bool,
    /// The factor before the map.
    pub(super) times: f64,
}

/// A donor tensor that the recipe selects, with its name in the result.
pub(super) struct TakenTensor<'a> {
    pub(super) name: String,
    pub(super) donor: &'a Donor,
    pub(super) shard: &'a Shard,
    pub(super) tensor: &'a Tensor,
    pub(super) rule: &'a TensorRule<'a>,
}

impl TakenTensor<'_> {
    /// The shape of the rows that are used.
    pub(super) fn shape(&self) -> Vec<u64> {
        let mut shape = self.tensor.shape.clone();
        if let (Some(rows), Some([_, count])) = (shape.first_mut(), self.rule.slice) {
            *rows = count;
        }
        shape
    }

    /// The element type in the result.
    pub(super) fn dtype(&self) -> Dtype {
        self.rule.dtype.filter(|_| can_compute(self.tensor.dtype)).unwrap_or(self.tensor.dtype)
    }
}

/// The modules of donors that start again.
#[derive(Debug, Default)]
pub(super) struct StartedModules {
    /// Role and name of the module in the donor.
    modules: BTreeSet<(String, String)>,
}

impl StartedModules {
    /// The modules of `taken` with a tensor whose shape in the result, `needed`, is another one, as far as their entries say
    /// `reinit`.
    pub(super) fn find<'t, 'a: 't>(taken: impl Iterator<Item = (&'t TakenTensor<'a>, &'t [u64])>) -> Self {
        let differs = taken.filter(|(taken, needed)| taken.rule.fit == Fit::Reinit && taken.shape() != **needed);
        Self { modules: differs.map(|(taken, _)| key(taken)).collect() }
    }

    /// Whether a tensor starts again.
    pub(super) fn has(&self, taken: &TakenTensor<'_>) -> bool {
        match taken.rule.fit {
            Fit::ReinitAlways => true,
            Fit::Reinit => self.modules.contains(&key(taken)),
            Fit::Copy | Fit::GrowRows | Fit::SampleRows | Fit::MeanLike | Fit::SampledLike | Fit::Pad | Fit::Map => {
                false
            }
        }
    }
}

/// Role and module of a tensor.
fn key(taken: &TakenTensor<'_>) -> (String, String) {
    (taken.donor.role.clone(), module(&taken.tensor.name).to_owned())
}

/// The module that has a tensor: its name without the last segment.
fn module(tensor: &str) -> &str {
    tensor.rsplit_once('.').map_or("", |(module, _)| module)
}
