//! A tensor to be written.

use super::expr::{TensorExpr, TensorTransform};
use super::tensor_ref::TensorRef;
use crate::checkpoint::{Dtype, byte_len};

/// A tensor of a planned shard: type and shape are those of its expression.
#[derive(Debug, Clone)]
pub struct PlannedTensor {
    /// State-dict name.
    pub name: String,
    /// Element type.
    pub dtype: Dtype,
    /// Shape in the result.
    pub shape: Vec<u64>,
    /// How its values are made.
    pub source: TensorExpr<TensorRef>,
}

impl PlannedTensor {
    /// The tensor that an expression makes.
    ///
    /// # Errors
    /// Why it cannot be made.
    pub fn new(name: String, source: TensorExpr<TensorRef>) -> Result<Self, String> {
        let (dtype, shape) = source.typed()?;
        Ok(Self { name, dtype, shape, source })
    }

    /// A whole donor tensor, unchanged.
    #[must_use]
    pub fn copy(name: String, from: TensorRef) -> Self {
        Self { name, dtype: from.dtype, shape: from.shape.clone(), source: TensorExpr::Stored(from) }
    }

    /// The bytes of a donor's file that are those of the tensor; `None` when it is computed.
    #[must_use]
    pub const fn copied(&self) -> Option<&TensorRef> {
        self.source.copied()
    }

    /// How its bytes are made, in one word.
    #[must_use]
    pub fn transform(&self) -> TensorTransform {
        self.source.transform()
    }

    /// Number of values in sampled rows; `None` for a tensor without such rows.
    #[must_use]
    pub(crate) fn sampled_values(&self) -> Option<u64> {
        let (rows, all) = (self.source.sampled_rows()?, self.shape.first().copied()?);
        let values = byte_len(Dtype::U8, &self.shape)?;
        values.checked_div(all)?.checked_mul(rows)
    }

    /// Number of bytes in the result.
    ///
    /// Shapes of a plan come from checked headers and architectures with limits; an overflow is counted as the largest
    /// size, which no disk can hold.
    #[must_use]
    pub(crate) fn len(&self) -> u64 {
        byte_len(self.dtype, &self.shape).unwrap_or(u64::MAX)
    }
}

#[cfg(test)]
impl PlannedTensor {
    /// The tensor with zeros in place of its values.
    pub(crate) fn started(self) -> Self {
        let (values, dtype, shape) = (super::expr::NewValues::Zeros, self.dtype, self.shape.clone());
        let instead_of = self.source.main().clone();
        Self { source: TensorExpr::Initialise { values, dtype, shape, instead_of }, ..self }
    }
}
