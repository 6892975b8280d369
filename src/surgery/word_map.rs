//! The values of a donor in the space of another embedding: a linear map, fitted on words that both language models have.
//!
//! docs/fitted-projector.md derives it. With `x` and `y` for the rows of a word in the two embeddings, less their means, the map is
//! the ridge regression `M = (Σ y xᵀ) (Σ x xᵀ + λ I)⁻¹`. All sums are binary64, in the order of the words, so that a value depends
//! neither on the number of threads nor on the processor.

use std::io::{self, Write};

mod algebra;
mod choice;
#[cfg(test)]
mod tests;

pub use choice::{WordPrediction, choose};

use algebra::{add_products, add_rows, cholesky, solve};

use super::convert::CastLosses;
use super::expr::{Mapped, WordMap};
use super::tensor_ref::{ReadAt, TensorRef};
use super::values::{Census, Codec};
use crate::checkpoint::Dtype;
use crate::checkpoint::reserve::reserved;

/// Words that are read at a time, and vectors that are mapped at a time.
const BLOCK: usize = 64;

/// A map that is fitted.
#[derive(Debug)]
struct FittedMap {
    /// Mean of the rows of the words, in the two embeddings.
    from: Vec<f64>,
    to: Vec<f64>,
    /// Σ x xᵀ, of which the lower triangle is filled in, row by row.
    gram: Vec<f64>,
    /// The same with the penalty, as its Cholesky factor.
    factor: Vec<f64>,
    /// Σ y xᵀ, row by row.
    cross: Vec<f64>,
}

/// The rows of some words in one embedding.
struct EmbeddingRows<'m> {
    of: &'m TensorRef,
    width: usize,
    codec: Codec,
    bytes: Vec<u8>,
}

impl<'m> EmbeddingRows<'m> {
    fn of(of: &'m TensorRef) -> io::Result<Self> {
        let width = of.shape.get(1).copied().unwrap_or_default();
        let len = usize::try_from(width.saturating_mul(of.dtype.bits() / 8)).map_err(io::Error::other)?;
        let width = usize::try_from(width).map_err(io::Error::other)?;
        Ok(Self { of, width, codec: Codec::default(), bytes: reserved(len)? })
    }

    /// The row of this index.
    fn row(&mut self, read: &mut ReadAt<'_>, index: u64) -> io::Result<&[f64]> {
        let at = index.saturating_mul(self.bytes.len() as u64);
        read(self.of, at, &mut self.bytes)?;
        Ok(self.codec.decode(self.of.dtype, &self.bytes))
    }

    /// Adds the rows of these words, less `mean`, to `out`.
    fn extend(
        &mut self,
        read: &mut ReadAt<'_>,
        words: impl Iterator<Item = u64>,
        mean: &[f64],
        out: &mut Vec<f64>,
    ) -> io::Result<()> {
        for index in words {
            out.extend(self.row(read, index)?.iter().zip(mean).map(|(value, mean)| value - mean));
        }
        Ok(())
    }

    /// The mean of the rows of these words.
    fn mean(&mut self, read: &mut ReadAt<'_>, words: impl Iterator<Item = u64>) -> io::Result<Vec<f64>> {
        let (mut mean, mut count) = (reserved::<f64>(self.width)?, 0.0_f64);
        for index in words {
            for (sum, value) in mean.iter_mut().zip(self.row(read, index)?) {
                *sum += value;
            }
            count += 1.0;
        }
        for sum in &mut mean {
            *sum /= count.max(1.0);
        }
        Ok(mean)
    }
}

impl FittedMap {
    /// Reads the rows of the words, and fits.
    ///
    /// # Errors
    /// Errors of reading; [`io::ErrorKind::InvalidData`] when the rows do not determine a map, as where they are not finite.
    fn fit(read: &mut ReadAt<'_>, map: &WordMap<TensorRef>) -> io::Result<Self> {
        let mut summed = Self::sums(read, map)?;
        summed.penalise(map.ridge)?;
        Ok(summed)
    }

    /// The sums over the words; no value can be mapped until [`Self::penalise`] is called.
    ///
    /// # Errors
    /// Errors of reading.
    fn sums(read: &mut ReadAt<'_>, map: &WordMap<TensorRef>) -> io::Result<Self> {
        let (mut from, mut to) = (EmbeddingRows::of(&map.from)?, EmbeddingRows::of(&map.to)?);
        let of = |side: usize| move |word: &[u64; 2]| word.get(side).copied().unwrap_or_default();
        let means = [from.mean(read, map.words.iter().map(of(0)))?, to.mean(read, map.words.iter().map(of(1)))?];
        let [from_mean, to_mean] = means;
        let mut gram: Vec<f64> = reserved(area(from.width, from.width)?)?;
        let mut cross: Vec<f64> = reserved(area(to.width, from.width)?)?;
        let (mut x, mut y) = (Vec::new(), Vec::new());
        for words in map.words.chunks(BLOCK) {
            x.clear();
            y.clear();
            from.extend(read, words.iter().map(of(0)), &from_mean, &mut x)?;
            to.extend(read, words.iter().map(of(1)), &to_mean, &mut y)?;
            add_products(&mut gram, &x, &x, from.width, true);
            add_products(&mut cross, &y, &x, from.width, false);
        }
        Ok(Self { from: from_mean, to: to_mean, gram, factor: Vec::new(), cross })
    }

    /// Sets the weight of the penalty, in proportion to the mean variance of the first embedding.
    ///
    /// # Errors
    /// [`io::ErrorKind::InvalidData`] when the rows do not determine a map.
    fn penalise(&mut self, ridge: f64) -> io::Result<()> {
        let width = self.from.len();
        let diagonal = || (0..width).map(|i| self.gram.get(i.saturating_mul(width).saturating_add(i)).copied());
        #[expect(clippy::cast_precision_loss, reason = "a width is far below 2^52")]
        let mean = diagonal().flatten().sum::<f64>() / (width.max(1) as f64);
        self.factor.clear();
        self.factor.try_reserve_exact(self.gram.len()).map_err(|_| io::ErrorKind::OutOfMemory)?;
        self.factor.extend_from_slice(&self.gram);
        for i in 0..width {
            if let Some(value) = self.factor.get_mut(i.saturating_mul(width).saturating_add(i)) {
                *value += ridge * mean;
            }
        }
        cholesky(&mut self.factor, width)
    }

    /// Maps vectors, of which `vectors` has one value after the other, from all of them at a time: that of every first component,
    /// then that of every second one. The result is in the same order.
    fn map(&self, mut vectors: Vec<f64>, count: usize) -> Vec<f64> {
        solve(&self.factor, &mut vectors, self.from.len(), count);
        let mut out = vec![0.0; self.to.len().saturating_mul(count)];
        for (out, row) in out.chunks_exact_mut(count.max(1)).zip(self.cross.chunks_exact(self.from.len().max(1))) {
            add_rows(out, row, &vectors, count);
        }
        out
    }

    /// Maps points, which are rows of `points`, to rows of the result.
    fn points(&self, points: &[f64], times: f64) -> Vec<f64> {
        let width = self.from.len().max(1);
        let count = points.len().checked_div(width).unwrap_or_default();
        let turned = (0..width).flat_map(|i| {
            let mean = self.from.get(i).copied().unwrap_or_default();
            points.iter().skip(i).step_by(width).map(move |value| value * times - mean)
        });
        let mapped = self.map(turned.collect(), count);
        let mut out = Vec::with_capacity(mapped.len());
        for point in 0..count {
            out.extend(mapped.iter().skip(point).step_by(count).zip(&self.to).map(|(value, mean)| value + mean));
        }
        out
    }
}

/// How the values of a tensor are mapped.
#[derive(Debug, Clone, Copy)]
pub struct MappedAs {
    /// Which of them are a point or a direction.
    pub values: Mapped,
    /// Factor before the map.
    pub before: f64,
    /// Factor after it.
    pub after: f64,
    /// The type to which they are rounded.
    pub to: Dtype,
}

/// Writes the values of a donor's tensor in the space of the second embedding; returns those that the type cannot hold.
///
/// # Errors
/// Errors of reading or writing, and as [`FittedMap::fit`].
pub fn write(
    read: &mut ReadAt<'_>,
    of: &TensorRef,
    how: MappedAs,
    map: &WordMap<TensorRef>,
    out: &mut dyn Write,
) -> io::Result<CastLosses> {
    let fitted = FittedMap::fit(read, map)?;
    let mut rounded = Rounded { how, out, codec: Codec::default(), bytes: Vec::new(), losses: CastLosses::default() };
    let size = |n: u64| usize::try_from(n).map_err(io::Error::other);
    match how.values {
        Mapped::Columns => {
            let all = whole(read, of)?;
            let columns = size(of.shape.get(1).copied().unwrap_or_default())?;
            let mut mapped: Vec<f64> = reserved(area(fitted.to.len(), columns)?)?;
            for first in (0..columns).step_by(BLOCK) {
                let count = columns.saturating_sub(first).min(BLOCK);
                let part = all.chunks_exact(columns.max(1)).flat_map(|row| row.iter().skip(first).take(count));
                let part = fitted.map(part.map(|value| value * how.before).collect(), count);
                for (row, values) in mapped.chunks_exact_mut(columns.max(1)).zip(part.chunks_exact(count.max(1))) {
                    row.iter_mut().skip(first).zip(values).for_each(|(to, value)| *to = *value);
                }
            }
            mapped.chunks_mut(columns.max(1)).try_for_each(|row| rounded.write(row))?;
        }
        Mapped::Point => {
            let point = whole(read, of)?;
            rounded.write(&mut fitted.points(&point, how.before))?;
        }
        Mapped::Rows => {
            let (mut rows, mut points) = (EmbeddingRows::of(of)?, Vec::new());
            let count = of.shape.first().copied().unwrap_or_default();
            let none = vec![0.0; fitted.from.len()];
            for first in (0..count).step_by(BLOCK) {
                points.clear();
                let end = first.saturating_add(BLOCK as u64).min(count);
                rows.extend(read, first..end, &none, &mut points)?;
                rounded.write(&mut fitted.points(&points, how.before))?;
            }
        }
    }
    Ok(rounded.losses)
}

/// A writer of mapped values, which rounds them once.
struct Rounded<'o> {
    how: MappedAs,
    out: &'o mut dyn Write,
    codec: Codec,
    bytes: Vec<u8>,
    losses: CastLosses,
}

impl Rounded<'_> {
    fn write(&mut self, values: &mut [f64]) -> io::Result<()> {
        for value in &mut *values {
            *value *= self.how.after;
        }
        self.bytes.clear();
        self.codec.encode_values(self.how.to, values, &mut self.bytes);
        let stored = Census::of_bytes(self.how.to, &self.bytes);
        self.losses.add(CastLosses { overflow: stored.infinite, underflow: 0, nan: stored.nan });
        self.out.write_all(&self.bytes)
    }
}

/// All values of a tensor.
fn whole(read: &mut ReadAt<'_>, of: &TensorRef) -> io::Result<Vec<f64>> {
    let mut bytes: Vec<u8> = reserved(usize::try_from(of.len).map_err(io::Error::other)?)?;
    read(of, 0, &mut bytes)?;
    Ok(std::mem::take(Codec::default().decode(of.dtype, &bytes)))
}

fn area(rows: usize, columns: usize) -> io::Result<usize> {
    rows.checked_mul(columns).ok_or_else(|| io::ErrorKind::OutOfMemory.into())
}
