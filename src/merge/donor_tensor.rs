//! A tensor of a donor, as the manifest and the plan of a dry run record it.

use serde::{Deserialize, Serialize};

use crate::surgery::tensor_ref::{RowSlice, TensorRef};

/// A tensor of a donor.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct DonorTensor {
    /// Role of the donor.
    pub donor: String,
    /// Name in the donor.
    pub name: String,
    /// Element type in the donor; the values were cast if it differs from that of the result.
    pub dtype: String,
    /// Shape of the part that was used.
    pub shape: Vec<u64>,
    /// The rows that were used, if not all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub slice: Option<RowSlice>,
    /// Digest of this part; missing if it was copied, so that the digest is the one of the result, or not read, and with the
    /// algorithm `none`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub digest: Option<String>,
}

impl DonorTensor {
    /// The record of a source.
    pub(super) fn new(from: &TensorRef, digest: Option<String>) -> Self {
        Self {
            donor: from.donor.clone(),
            name: from.name.clone(),
            dtype: from.dtype.name().to_owned(),
            shape: from.shape.clone(),
            slice: from.slice,
            digest,
        }
    }
}
