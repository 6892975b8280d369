//! Adds a product of two matrices to values while they are written.
//!
//! The arithmetic is that of PEFT when it merges a LoRA on a processor. Source: peft 0.21.2, `tuners/lora/layer.py`:
//! `get_delta_weight` multiplies the factors as float32 and then by the scale; `Linear.merge` adds the result to a weight in place,
//! so that torch computes the sum in float32 and rounds it to the type of the weight; `Embedding.merge` rounds it to that type before.

use std::io::{self, Write};

use super::convert::CastLosses;
use super::expr::{Factor, Product};
use super::tensor_ref::{ReadAt, TensorRef};
use super::values::{Census, Codec};
use crate::checkpoint::Dtype;

/// Bytes of a factor that are read at a time: a multiple of every element width.
const BLOCK: usize = 256 * 1024;

/// Columns whose sums are computed at a time: they stay in the first cache.
const COLUMNS: usize = 1024;

/// A writer of a matrix of F16, BF16 or F32 that passes it on with a product added to it.
///
/// Every write must end on an element. A sum over the inner dimension is computed in binary64, in the order of the factors, and
/// rounded to binary32, so that it depends neither on the size of writes nor on the processor.
pub(super) struct Adder<'a> {
    dtype: Dtype,
    /// Rows of the first factor, and of the second one.
    left: Vec<f32>,
    right: Vec<f32>,
    inner: usize,
    columns: usize,
    scale: f32,
    rounded: bool,
    /// The row of the product that the next value belongs to, and the columns of it that are left.
    row: usize,
    sums: Vec<f32>,
    used: usize,
    out: &'a mut dyn Write,
    losses: CastLosses,
    codec: Codec,
    encoded: Vec<u8>,
}

impl<'a> Adder<'a> {
    /// An adder to a matrix of this type and shape, which reads both factors.
    ///
    /// # Errors
    /// Errors of reading; [`io::ErrorKind::InvalidInput`] for a product of another shape.
    pub(super) fn new(
        read: &mut ReadAt<'_>,
        product: &Product<TensorRef>,
        dtype: Dtype,
        shape: &[u64],
        out: &'a mut dyn Write,
    ) -> io::Result<Self> {
        let wrong = || io::Error::new(io::ErrorKind::InvalidInput, "the factors do not have the shape of the matrix");
        let ([rows, inner], [other, columns]) =
            (product.left.shape().ok_or_else(wrong)?, product.right.shape().ok_or_else(wrong)?);
        if inner != other || *shape != [rows, columns] {
            return Err(wrong());
        }
        let size = |n: u64| usize::try_from(n).map_err(io::Error::other);
        #[expect(clippy::cast_possible_truncation, reason = "torch multiplies float32 by a float32")]
        let scale = product.scale as f32;
        Ok(Self {
            dtype,
            left: matrix(read, &product.left)?,
            right: matrix(read, &product.right)?,
            inner: size(inner)?,
            columns: size(columns)?,
            scale,
            rounded: product.rounded,
            row: 0,
            sums: Vec::new(),
            used: 0,
            out,
            losses: CastLosses::default(),
            codec: Codec::default(),
            encoded: Vec::new(),
        })
    }

    /// The sums that became infinite, and the NaNs that were added.
    pub(super) const fn losses(&self) -> CastLosses {
        self.losses
    }

    /// Computes the next row of the product.
    fn next_row(&mut self) {
        self.sums.clear();
        let start = self.row.saturating_mul(self.inner);
        let left = self.left.get(start..start.saturating_add(self.inner)).unwrap_or_default();
        let mut sums = [0_f64; COLUMNS];
        for first in (0..self.columns).step_by(COLUMNS) {
            let count = self.columns.saturating_sub(first).min(COLUMNS);
            let sums = sums.get_mut(..count).unwrap_or_default();
            sums.fill(0.0);
            for (factor, right) in left.iter().zip(self.right.chunks_exact(self.columns.max(1))) {
                let right = right.get(first..first.saturating_add(count)).unwrap_or_default();
                for (sum, value) in sums.iter_mut().zip(right) {
                    *sum += f64::from(*factor) * f64::from(*value);
                }
            }
            #[expect(clippy::cast_possible_truncation, reason = "rounding to binary32 is the purpose")]
            self.sums.extend(sums.iter().map(|sum| *sum as f32 * self.scale));
        }
        if self.rounded {
            self.codec.round(self.dtype, &mut self.sums);
        }
        self.row = self.row.saturating_add(1);
        self.used = 0;
    }

    /// Adds to whole elements of one row, and passes them on.
    fn add(&mut self, bytes: &[u8], count: usize) -> io::Result<()> {
        let values = self.codec.singles(self.dtype, bytes);
        for (value, sum) in values.iter_mut().zip(self.sums.iter().skip(self.used)) {
            *value += *sum;
        }
        self.encoded.clear();
        self.codec.encode_singles(self.dtype, &mut self.encoded);
        let before = Census::of_bytes(self.dtype, bytes);
        let after = Census::of_bytes(self.dtype, &self.encoded);
        self.losses.add(CastLosses {
            overflow: after.infinite.saturating_sub(before.infinite),
            underflow: 0,
            nan: after.nan,
        });
        self.used = self.used.saturating_add(count);
        self.out.write_all(&self.encoded)
    }
}

impl Write for Adder<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let width = usize::try_from(self.dtype.bits() / 8).unwrap_or(1).max(1);
        if !bytes.len().is_multiple_of(width) {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "a block does not end on an element"));
        }
        if self.used == self.sums.len() {
            self.next_row();
        }
        let left = self.sums.len().saturating_sub(self.used).saturating_mul(width);
        let part = bytes.get(..bytes.len().min(left)).unwrap_or_default();
        self.add(part, part.len().checked_div(width).unwrap_or_default())?;
        Ok(part.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// The rows of a factor, as binary32 numbers.
fn matrix(read: &mut ReadAt<'_>, factor: &Factor<TensorRef>) -> io::Result<Vec<f32>> {
    let of = factor.of();
    let (mut codec, mut values, mut block) = (Codec::default(), Vec::new(), Vec::new());
    let mut at = 0_u64;
    while at < of.len {
        let len = usize::try_from(of.len.saturating_sub(at)).map_or(BLOCK, |left| left.min(BLOCK));
        block.resize(len, 0);
        read(of, at, &mut block)?;
        if of.dtype == Dtype::F64 {
            #[expect(clippy::cast_possible_truncation, reason = "PEFT has the factors as float32")]
            values.extend(codec.decode(of.dtype, &block).iter().map(|value| *value as f32));
        } else {
            values.extend_from_slice(codec.singles(of.dtype, &block));
        }
        at = at.saturating_add(len as u64);
    }
    let columns = of.shape.last().and_then(|columns| usize::try_from(*columns).ok()).unwrap_or_default();
    Ok(match factor {
        Factor::Stored(_) => values,
        Factor::Transposed(_) => {
            (0..columns).flat_map(|column| values.iter().skip(column).step_by(columns).copied()).collect()
        }
    })
}
