//! How a tensor gets the shape that the result needs: the values of `fit` in a recipe.

/// A value of `fit`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fit {
    /// The donor's bytes; a seam when the shape differs.
    Copy,
    /// Rows with the mean of the others.
    GrowRows,
    /// Random rows with mean and covariance of the others.
    SampleRows,
    /// Rows with the mean of those of the tensor that `like` names, in place of the donor's.
    MeanLike,
    /// As that, random rows with their covariance.
    SampledLike,
    /// Zeros up to the shape.
    Pad,
    /// The values in the space of another language model's embedding, which `words` names.
    Map,
    /// New values for each module of which a tensor has another shape.
    Reinit,
    /// New values, also where the shape is equal.
    ReinitAlways,
}

impl Fit {
    /// All values.
    pub(super) const ALL: [Self; 9] = [
        Self::Copy,
        Self::Pad,
        Self::Map,
        Self::GrowRows,
        Self::SampleRows,
        Self::MeanLike,
        Self::SampledLike,
        Self::Reinit,
        Self::ReinitAlways,
    ];

    /// The name in a recipe.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Copy => "copy",
            Self::GrowRows => "grow-rows",
            Self::SampleRows => "sample-rows",
            Self::MeanLike => "mean-like",
            Self::SampledLike => "sampled-like",
            Self::Pad => "pad",
            Self::Map => "map",
            Self::Reinit => "reinit",
            Self::ReinitAlways => "reinit-always",
        }
    }
}
