//! How a tensor gets the shape that the result needs: the values of `fit` in a recipe.

use std::collections::BTreeSet;

use super::tensors::TakenTensor;

/// A value of `fit`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fit {
    /// The donor's bytes; a seam when the shape differs.
    Copy,
    /// Rows with the mean of the others.
    GrowRows,
    /// Random rows with mean and covariance of the others.
    SampleRows,
    /// Zeros up to the shape.
    Pad,
    /// New values for each module of which a tensor has another shape.
    Reinit,
    /// New values, also where the shape is equal.
    ReinitAlways,
}

impl Fit {
    /// All values.
    pub(super) const ALL: [Self; 6] =
        [Self::Copy, Self::Pad, Self::GrowRows, Self::SampleRows, Self::Reinit, Self::ReinitAlways];

    /// The name in a recipe.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Copy => "copy",
            Self::GrowRows => "grow-rows",
            Self::SampleRows => "sample-rows",
            Self::Pad => "pad",
            Self::Reinit => "reinit",
            Self::ReinitAlways => "reinit-always",
        }
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
            Fit::Copy | Fit::GrowRows | Fit::SampleRows | Fit::Pad => false,
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
