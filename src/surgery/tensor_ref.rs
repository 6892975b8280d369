//! Tensors of donors, as the operands of [`super::expr::TensorExpr`].

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::checkpoint::{Dtype, Shard, Tensor, byte_len};

/// A tensor of a donor, or some of its rows, with the byte range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorRef {
    /// Donor role.
    pub donor: String,
    /// File that contains the bytes.
    pub path: PathBuf,
    /// Name in the donor.
    pub name: String,
    /// Element type in the donor.
    pub dtype: Dtype,
    /// Shape of the part that is used.
    pub shape: Vec<u64>,
    /// First byte of the part, from the start of the file.
    pub offset: u64,
    /// Number of bytes of the part.
    pub len: u64,
    /// The rows that are used, if not all.
    pub slice: Option<RowSlice>,
}

/// Consecutive rows of a tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct RowSlice {
    /// Index of the first row.
    pub first: u64,
    /// Number of rows of the whole tensor.
    pub of: u64,
}

impl TensorRef {
    /// A tensor of a shard in `root`, or some of its rows: the index of the first one and their number.
    ///
    /// # Errors
    /// The reason why the tensor lacks these rows.
    pub fn new(
        donor: &str,
        root: &Path,
        shard: &Shard,
        tensor: &Tensor,
        rows: Option<[u64; 2]>,
    ) -> Result<Self, String> {
        let mut from = Self {
            donor: donor.to_owned(),
            path: root.join(&shard.name),
            name: tensor.name.clone(),
            dtype: tensor.dtype,
            shape: tensor.shape.clone(),
            offset: shard.data_start.saturating_add(tensor.begin),
            len: tensor.len(),
            slice: None,
        };
        if let Some([first, count]) = rows {
            let of = tensor.shape.first().copied().unwrap_or_default();
            let missing = || format!("it has no {count} rows from row {first} on");
            let row = byte_len(tensor.dtype, tensor.shape.get(1..).unwrap_or_default()).ok_or_else(missing)?;
            let end = first.checked_add(count).filter(|end| *end <= of && count > 0).ok_or_else(missing)?;
            from.shape.iter_mut().take(1).for_each(|rows| *rows = count);
            from.offset = from.offset.saturating_add(row.saturating_mul(first));
            from.len = row.saturating_mul(end.saturating_sub(first));
            from.slice = (count != of).then_some(RowSlice { first, of });
        }
        Ok(from)
    }
}

/// Reads bytes of a donor's tensor: `read(tensor, offset within the tensor, buffer)`.
pub type ReadAt<'a> = dyn FnMut(&TensorRef, u64, &mut [u8]) -> io::Result<()> + 'a;
