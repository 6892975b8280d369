//! One header entry whose fields may be malformed.

use super::{Dtype, Tensor};

/// A header entry; a field is `None` when it is missing or malformed.
pub(super) struct HeaderEntry {
    pub(super) name: String,
    pub(super) dtype: Option<Dtype>,
    pub(super) shape: Option<Vec<u64>>,
    /// Begin and end in the data region, in the given order.
    pub(super) offsets: Option<(u64, u64)>,
}

impl HeaderEntry {
    /// The tensor, or its name when a field is missing or malformed.
    pub(super) fn into_tensor(self) -> Result<Tensor, String> {
        match (self.dtype, self.shape, self.offsets) {
            (Some(dtype), Some(shape), Some((begin, end))) => Ok(Tensor { name: self.name, dtype, shape, begin, end }),
            _ => Err(self.name),
        }
    }
}
