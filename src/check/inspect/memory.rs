//! The memory that a model takes: loaded, trained, and for its cache of keys and values.

use serde::Serialize;
use serde_json::Value;

use crate::checkpoint::Dtype;
use crate::knowledge::Expected;
use crate::knowledge::cache::CacheKeys;

/// Tokens and sequences of the cache that `inspect` tells the size of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CacheInput {
    /// Tokens; the longest input that the model was made for when missing.
    pub context: Option<u64>,
    /// Sequences.
    pub batch: u64,
}

/// The memory that a model takes, in bytes, without activations and what the runtime needs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Memory {
    /// Type of the loaded weights: that of the config, or else of most stored ones.
    pub dtype: String,
    /// The parameters in this type; tied ones count once.
    pub weights: u64,
    /// Weights, their gradients and the two moments of `AdamW`, all in this type.
    pub training: u64,
    /// The cache of keys and values; null for classes whose caches are not known.
    pub cache: Option<CacheMemory>,
}

/// The memory of a cache of keys and values.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct CacheMemory {
    /// Tokens of each sequence.
    pub context: u64,
    /// Sequences.
    pub batch: u64,
    /// Bytes, in the type of the weights.
    pub bytes: u64,
    /// Whether it may take less: the config has a window, and does not tell which layers keep to it.
    pub at_most: bool,
}

/// The memory of a class that was built, loaded in `stored` unless the config names another type.
pub(super) fn of(expected: &Expected, stored: Dtype, input: CacheInput) -> Option<Memory> {
    let dtype = declared(&expected.config).unwrap_or(stored);
    let width = dtype.bits().checked_div(8)?;
    let own = expected.tensors.values().filter(|tensor| tensor.tied_to.is_none());
    let parameters =
        own.fold(0_u64, |n, tensor| n.saturating_add(tensor.shape.iter().fold(1_u64, |n, dim| n.saturating_mul(*dim))));
    let weights = parameters.saturating_mul(width);
    let cache = CacheKeys::built_in().size(&expected.class, &expected.config).and_then(|size| {
        let (context, batch) = (input.context.or(size.context)?, input.batch);
        let bytes = size.elements(context).saturating_mul(batch).saturating_mul(width);
        Some(CacheMemory { context, batch, bytes, at_most: size.is_bound })
    });
    Some(Memory { dtype: dtype.to_string(), weights, training: weights.saturating_mul(4), cache })
}

/// The type that a config names for its weights.
fn declared(config: &Value) -> Option<Dtype> {
    let name = ["dtype", "torch_dtype"].iter().find_map(|key| config.get(key)?.as_str())?;
    Dtype::of_float_name(name.strip_prefix("torch.").unwrap_or(name))
}
