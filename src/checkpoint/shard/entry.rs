//! One entry of a header, as far as it could be read.

use super::{Dtype, Tensor};

/// An entry as far as it could be read; a field is `None` when it is absent or malformed.
pub(super) struct HeaderEntry {
    pub(super) name: String,
    pub(super) dtype: Option<Dtype>,
    pub(super) shape: Option<Vec<u64>>,
    /// Begin and end in the data region, in the order stated.
    pub(super) offsets: Option<(u64, u64)>,
}

impl HeaderEntry {
    /// The tensor, or the name alone when a field could not be read.
    pub(super) fn into_tensor(self) -> Result<Tensor, String> {
        match (self.dtype, self.shape, self.offsets) {
            (Some(dtype), Some(shape), Some((begin, end))) => Ok(Tensor { name: self.name, dtype, shape, begin, end }),
            _ => Err(self.name),
        }
    }
}
