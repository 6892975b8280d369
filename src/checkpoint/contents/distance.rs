//! How far the values of two tensors are from each other.

use serde::Serialize;

use super::{as_u64, decoded};
use crate::checkpoint::source::SourceFile;
use crate::checkpoint::{Dtype, Shard, Source, Tensor};

/// Values that are read at a time.
const VALUES: usize = 1 << 16;

/// How far the values of a tensor are from those of another one. The norms are Euclidean ones of all values.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Distance {
    /// Norm of the first tensor.
    pub norm_before: f64,
    /// Norm of the second tensor.
    pub norm_after: f64,
    /// Norm of the difference.
    pub norm_of_difference: f64,
    /// The largest difference of two values.
    pub largest_difference: f64,
}

impl Distance {
    /// That of several tensors together.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            norm_before: self.norm_before.hypot(other.norm_before),
            norm_after: self.norm_after.hypot(other.norm_after),
            norm_of_difference: self.norm_of_difference.hypot(other.norm_of_difference),
            largest_difference: self.largest_difference.max(other.largest_difference),
        }
    }

    /// The norm of the difference, as a share of the first norm; `None` when that is zero.
    #[must_use]
    pub fn relative(self) -> Option<f64> {
        (self.norm_before > 0.0).then(|| self.norm_of_difference / self.norm_before)
    }

    /// The cosine of the angle between both; `None` when one norm is zero.
    #[must_use]
    pub fn cosine(self) -> Option<f64> {
        let (a, b, d) = (self.norm_before, self.norm_after, self.norm_of_difference);
        // That is (a² + b² − d²) / 2ab, without the difference of large squares.
        (a > 0.0 && b > 0.0).then(|| 1.0 - (d - (a - b).abs()) * (d + (a - b).abs()) / (2.0 * a * b))
    }
}

/// The distance of two tensors of the same shape; the types may differ. `None` for types that are no floats of 16 bits or more,
/// for values that are not finite, and when the values cannot be read.
pub(in crate::checkpoint) fn distance(
    [source, beside]: [&Source; 2],
    one: (&Shard, &Tensor),
    other: (&Shard, &Tensor),
) -> Option<Distance> {
    let (mut before, mut after) = (ValueReader::of(source, one)?, ValueReader::of(beside, other)?);
    let [mut one, mut other, mut difference] = [0.0_f64; 3];
    let mut largest_difference = 0.0_f64;
    loop {
        let (here, there) = (before.next()?, after.next()?);
        if here.len() != there.len() {
            return None;
        }
        if here.is_empty() {
            break;
        }
        for (a, b) in here.iter().zip(&there) {
            one += a * a;
            other += b * b;
            difference += (b - a) * (b - a);
            largest_difference = largest_difference.max((b - a).abs());
        }
    }
    let [norm_before, norm_after, norm_of_difference] = [one, other, difference].map(f64::sqrt);
    let is_finite = [norm_before, norm_after, norm_of_difference].iter().all(|norm| norm.is_finite());
    is_finite.then_some(Distance { norm_before, norm_after, norm_of_difference, largest_difference })
}

/// The values of a tensor, block by block.
pub(super) struct ValueReader {
    file: SourceFile,
    dtype: Dtype,
    width: u64,
    at: u64,
    left: u64,
}

impl ValueReader {
    pub(super) fn of(source: &Source, (shard, tensor): (&Shard, &Tensor)) -> Option<Self> {
        let width = tensor.dtype.float_name().map(|_| tensor.dtype.bits() / 8)?;
        let file = source.open_regular(&shard.name, u64::MAX).ok()?;
        let is_whole = file.len() == shard.file_len && !shard.unread && shard.is_contiguous(&tensor.name);
        let at = shard.data_start.checked_add(tensor.begin).filter(|_| is_whole)?;
        Some(Self { file, dtype: tensor.dtype, width, at, left: tensor.len().checked_div(width)? })
    }

    /// The next values; empty at the end, `None` when they cannot be read.
    pub(super) fn next(&mut self) -> Option<Vec<f64>> {
        let count = self.left.min(as_u64(VALUES));
        let mut bytes = vec![0; usize::try_from(count.checked_mul(self.width)?).ok()?];
        self.file.read_exact_at(&mut bytes, self.at).ok()?;
        self.at = self.at.checked_add(as_u64(bytes.len()))?;
        self.left = self.left.checked_sub(count)?;
        decoded(self.dtype, &bytes)
    }
}
