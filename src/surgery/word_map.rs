//! The values of a donor in the space of another embedding: a linear map, fitted on words that both language models have.
//!
//! docs/fitted-projector.md derives it. With `x` and `y` for the rows of a word in the two embeddings, less their means, the map is
//! the ridge regression `M = (Σ y xᵀ) (Σ x xᵀ + λ I)⁻¹`. All sums are binary64, in the order of the words, so that a value depends
//! neither on the number of threads nor on the processor.

use std::io::{self, Write};

use super::convert::CastLosses;
use super::donor::DonorFile;
use super::error::{ApplyError, io_at};
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
struct Rows<'m> {
    of: &'m TensorRef,
    width: usize,
    codec: Codec,
    bytes: Vec<u8>,
}

impl<'m> Rows<'m> {
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
        let (mut from, mut to) = (Rows::of(&map.from)?, Rows::of(&map.to)?);
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
pub struct Placed {
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
    how: Placed,
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
            let (mut rows, mut points) = (Rows::of(of)?, Vec::new());
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
    how: Placed,
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

/// Adds Σ a bᵀ over the rows of `left` and `right`, row by row; of a symmetric sum, the lower triangle. `width` is that of `right`.
fn add_products(out: &mut [f64], left: &[f64], right: &[f64], width: usize, is_symmetric: bool) {
    let rows = right.len().checked_div(width).unwrap_or_default();
    let left_width = left.len().checked_div(rows).unwrap_or_default();
    for (i, sums) in out.chunks_exact_mut(width.max(1)).enumerate() {
        let end = if is_symmetric { i.saturating_add(1) } else { width };
        let sums = sums.get_mut(..end).unwrap_or_default();
        let factors: Vec<f64> = left.iter().skip(i).step_by(left_width.max(1)).copied().collect();
        add_rows(sums, &factors, right, width);
    }
}

/// Adds the rows of a matrix of this width, each times its factor, one after the other. Rust does not fuse a multiplication with an
/// addition, so that every processor has the same sums.
#[multiversion::multiversion(targets("x86_64+avx2"))]
fn add_rows(sums: &mut [f64], factors: &[f64], rows: &[f64], width: usize) {
    let width = width.max(1);
    // Four at a time, so that sums are loaded and stored less often.
    let (four, rest) = factors.as_chunks::<4>();
    for (factors, rows) in four.iter().zip(rows.chunks_exact(width.saturating_mul(4))) {
        let (a, others) = rows.split_at(width);
        let (b, others) = others.split_at(width);
        let (c, d) = others.split_at(width);
        let [fa, fb, fc, fd] = *factors;
        for ((((sum, a), b), c), d) in sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *sum = (((*sum + fa * a) + fb * b) + fc * c) + fd * d;
        }
    }
    let done = four.len().saturating_mul(4).saturating_mul(width);
    for (factor, row) in rest.iter().zip(rows.get(done..).unwrap_or_default().chunks_exact(width)) {
        for (sum, value) in sums.iter_mut().zip(row) {
            *sum += factor * value;
        }
    }
}

/// The sum of products, in eight sums that are added at the end.
#[multiversion::multiversion(targets("x86_64+avx2"))]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let ((first, first_rest), (second, second_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    for (a, b) in first.iter().zip(second) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    let rest = first_rest.iter().zip(second_rest).map(|(a, b)| a * b).sum::<f64>();
    sums.iter().sum::<f64>() + rest
}

/// The factor `L` of a symmetric matrix `L Lᵀ`, whose lower triangle is given, in its place.
fn cholesky(matrix: &mut [f64], width: usize) -> io::Result<()> {
    let row = |i: usize| i.saturating_mul(width)..i.saturating_add(1).saturating_mul(width);
    for i in 0..width {
        let (done, rest) = matrix.split_at_mut(row(i).start.min(matrix.len()));
        let own = rest.get_mut(..width).unwrap_or_default();
        for (j, other) in done.chunks_exact(width.max(1)).enumerate() {
            let (before, from) = own.split_at_mut(j);
            let (Some(value), Some(pivot)) = (from.first_mut(), other.get(j)) else { continue };
            *value = (*value - dot(before, other.get(..j).unwrap_or_default())) / pivot;
        }
        let (before, from) = own.split_at_mut(i);
        let Some(value) = from.first_mut() else { continue };
        let rest = *value - dot(before, before);
        if !(rest.is_finite() && rest > 0.0) {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "the rows of the shared words determine no map"));
        }
        *value = rest.sqrt();
    }
    Ok(())
}

/// Solves `L Lᵀ z = v` for vectors in the order of [`FittedMap::map`], in their place.
fn solve(factor: &[f64], vectors: &mut [f64], width: usize, count: usize) {
    let count = count.max(1);
    let at = |i: usize, j: usize| factor.get(i.saturating_mul(width).saturating_add(j)).copied().unwrap_or_default();
    for i in 0..width {
        let (before, own) = vectors.split_at_mut(i.saturating_mul(count));
        let own = own.get_mut(..count).unwrap_or_default();
        let factors: Vec<f64> = (0..i).map(|j| -at(i, j)).collect();
        add_rows(own, &factors, before, count);
        for value in own {
            *value /= at(i, i);
        }
    }
    for i in (0..width).rev() {
        let (before, after) = vectors.split_at_mut(i.saturating_add(1).saturating_mul(count));
        let own = before.get_mut(i.saturating_mul(count)..).unwrap_or_default();
        let factors: Vec<f64> = (i.saturating_add(1)..width).map(|j| -at(j, i)).collect();
        add_rows(own, &factors, after, count);
        for value in own {
            *value /= at(i, i);
        }
    }
}

/// Penalties that are tried.
const RIDGES: [f64; 6] = [0.03, 0.1, 0.3, 1.0, 3.0, 10.0];

/// How well a map predicts words on which it was not fitted.
#[derive(Debug, Clone, Copy)]
pub struct Prediction {
    /// Mean cosine of a predicted row and the word's own, both less the mean.
    pub cosine: f64,
    /// The same for the row of another word.
    pub shuffled: f64,
    /// Root of the mean square of the predicted rows, in proportion to that of the words' own.
    pub size: f64,
}

/// The map with the penalty that predicts the words that were left out best. `word_fit` of recipes calls it.
///
/// # Errors
/// [`ApplyError`] when a file cannot be opened or read, or the rows determine no map.
pub fn choose(map: WordMap<TensorRef>, left_out: &[[u64; 2]]) -> Result<(WordMap<TensorRef>, Prediction), ApplyError> {
    map.widths().map_err(|reason| failed(&map)(io::Error::new(io::ErrorKind::InvalidInput, reason)))?;
    let files = [DonorFile::open(&map.from.path)?, DonorFile::open(&map.to.path)?];
    let mut read = |of: &TensorRef, at: u64, buffer: &mut [u8]| {
        let file = files.iter().zip([&map.from, &map.to]).find(|(_, whole)| whole.path == of.path);
        let (file, _) = file.ok_or(io::ErrorKind::NotFound)?;
        file.read_at(buffer, of.offset.saturating_add(at))
    };
    let mut tried = || -> io::Result<(f64, Prediction)> {
        let mut fitted = FittedMap::sums(&mut read, &map)?;
        let (mut x, mut y) = (Vec::new(), Vec::new());
        let side = |side: usize| left_out.iter().map(move |word| word.get(side).copied().unwrap_or_default());
        Rows::of(&map.from)?.extend(&mut read, side(0), &vec![0.0; fitted.from.len()], &mut x)?;
        Rows::of(&map.to)?.extend(&mut read, side(1), &vec![0.0; fitted.to.len()], &mut y)?;
        let mut best: Option<(f64, Prediction)> = None;
        for ridge in RIDGES {
            fitted.penalise(ridge)?;
            let prediction = predicted(&fitted.points(&x, 1.0), &y, &fitted.to);
            if best.as_ref().is_none_or(|(_, found)| prediction.cosine > found.cosine) {
                best = Some((ridge, prediction));
            }
        }
        best.ok_or_else(|| io::ErrorKind::InvalidData.into())
    };
    let (ridge, prediction) = tried().map_err(failed(&map))?;
    Ok((WordMap { ridge, ..map }, prediction))
}

/// An error while the rows of the first embedding are read.
fn failed(map: &WordMap<TensorRef>) -> impl FnOnce(io::Error) -> ApplyError {
    io_at(&map.from.path, "reading")
}

/// Compares predicted rows with the words' own.
fn predicted(guessed: &[f64], own: &[f64], mean: &[f64]) -> Prediction {
    let width = mean.len().max(1);
    let centred = |row: &[f64]| row.iter().zip(mean).map(|(value, mean)| value - mean).collect::<Vec<_>>();
    let rows = |of: &[f64]| of.chunks_exact(width).map(centred).collect::<Vec<_>>();
    let (guesses, truths) = (rows(guessed), rows(own));
    #[expect(clippy::cast_precision_loss, reason = "a vocabulary has far fewer than 2^52 words")]
    let count = truths.len().max(1) as f64;
    let cosines = |shift: usize| {
        let others = truths.iter().cycle().skip(shift);
        guesses.iter().zip(others).map(|(guess, truth)| cosine(guess, truth)).sum::<f64>() / count
    };
    let squares = |of: &[f64]| of.iter().map(|value| value * value).sum::<f64>();
    Prediction { cosine: cosines(0), shuffled: cosines(1), size: (squares(guessed) / squares(own)).sqrt() }
}

fn cosine(a: &[f64], b: &[f64]) -> f64 {
    let cosine = dot(a, b) / (dot(a, a) * dot(b, b)).sqrt();
    if cosine.is_finite() { cosine } else { 0.0 }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "tests")]

    use std::collections::BTreeMap;

    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const FROM: usize = 7;
    const TO: usize = 11;
    const WORDS: usize = 200;

    /// Tensors in memory, by name.
    #[derive(Default)]
    struct Files(BTreeMap<String, Vec<u8>>);

    impl Files {
        fn add(&mut self, name: &str, shape: &[usize], values: &[f64]) -> TensorRef {
            let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            let len = bytes.len() as u64;
            self.0.insert(name.to_owned(), bytes);
            TensorRef {
                donor: "a".to_owned(),
                path: name.into(),
                name: name.to_owned(),
                dtype: Dtype::F64,
                shape: shape.iter().map(|n| *n as u64).collect(),
                offset: 0,
                len,
                slice: None,
            }
        }

        fn read(&self) -> impl FnMut(&TensorRef, u64, &mut [u8]) -> io::Result<()> {
            |of, at, buffer| {
                let at = usize::try_from(at).unwrap();
                buffer.copy_from_slice(&self.0[&of.name][at..][..buffer.len()]);
                Ok(())
            }
        }
    }

    fn normal(rng: &mut ChaCha8Rng, count: usize) -> Vec<f64> {
        (0..count).map(|_| StandardNormal.sample(rng)).collect()
    }

    /// `matrix`, of `columns` columns, times each row of `rows`.
    fn times(matrix: &[f64], columns: usize, rows: &[f64]) -> Vec<f64> {
        let product = |row: &[f64]| {
            matrix.chunks(columns).map(|line| line.iter().zip(row).map(|(a, b)| a * b).sum()).collect::<Vec<f64>>()
        };
        rows.chunks(columns).flat_map(product).collect()
    }

    /// Embeddings of which the second one is a map of the first, with noise, and the map with its shift.
    fn embeddings(files: &mut Files, noise: f64) -> (WordMap<TensorRef>, Vec<f64>, Vec<f64>) {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let (map, shift) = (normal(&mut rng, TO * FROM), normal(&mut rng, TO));
        let x: Vec<f64> = normal(&mut rng, WORDS * FROM).iter().map(|value| value + 0.5).collect();
        let mut y = times(&map, FROM, &x);
        for row in y.chunks_mut(TO) {
            row.iter_mut().zip(&shift).for_each(|(value, shift)| *value += shift + noise * normal(&mut rng, 1)[0]);
        }
        let (from, to) = (files.add("from", &[WORDS, FROM], &x), files.add("to", &[WORDS, TO], &y));
        let words = (0..WORDS as u64).map(|i| [i, i]).collect();
        (WordMap { from, to, words, ridge: 1e-9 }, map, shift)
    }

    fn written(files: &Files, of: &TensorRef, values: Mapped, before: f64, map: &WordMap<TensorRef>) -> Vec<f64> {
        let mut out = Vec::new();
        let how = Placed { values, before, after: 0.5, to: Dtype::F64 };
        assert_eq!(write(&mut files.read(), of, how, map, &mut out).unwrap(), CastLosses::default());
        std::mem::take(Codec::default().decode(Dtype::F64, &out))
    }

    fn close(found: &[f64], wanted: &[f64], within: f64) {
        assert_eq!(found.len(), wanted.len());
        for (found, wanted) in found.iter().zip(wanted) {
            assert!((found - wanted).abs() <= within, "{found} is not {wanted}");
        }
    }

    /// What a projector with the mapped weight and bias puts out is the mapped output of the old one.
    #[test]
    fn a_known_map_is_found_and_a_projector_follows_it() {
        let mut files = Files::default();
        let (map, matrix, shift) = embeddings(&mut files, 0.0);
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        // More columns than are mapped at a time.
        let columns = BLOCK + 3;
        let (weight, bias) = (normal(&mut rng, FROM * columns), normal(&mut rng, FROM));
        let of_weight = files.add("weight", &[FROM, columns], &weight);
        let of_bias = files.add("bias", &[FROM], &bias);
        let turned: Vec<f64> =
            (0..columns).flat_map(|c| (0..FROM).map(move |r| (r, c))).map(|(r, c)| weight[r * columns + c]).collect();
        let mapped = times(&matrix, FROM, &turned);
        let wanted: Vec<f64> =
            (0..TO).flat_map(|r| (0..columns).map(move |c| (r, c))).map(|(r, c)| 3.0 * mapped[c * TO + r]).collect();
        close(&written(&files, &of_weight, Mapped::Columns, 6.0, &map), &wanted, 1e-6);
        let half = |wanted: Vec<f64>| wanted.iter().map(|value| value * 0.5).collect::<Vec<_>>();
        let scaled: Vec<f64> = bias.iter().map(|value| value * 3.0).collect();
        let wanted: Vec<f64> = times(&matrix, FROM, &scaled).iter().zip(&shift).map(|(a, b)| a + b).collect();
        close(&written(&files, &of_bias, Mapped::Point, 3.0, &map), &half(wanted), 1e-6);
        let rows = normal(&mut rng, (BLOCK + 5) * FROM);
        let of_rows = files.add("rows", &[BLOCK + 5, FROM], &rows);
        let mut wanted = times(&matrix, FROM, &rows);
        for row in wanted.chunks_mut(TO) {
            row.iter_mut().zip(&shift).for_each(|(value, shift)| *value += shift);
        }
        close(&written(&files, &of_rows, Mapped::Rows, 1.0, &map), &half(wanted), 1e-6);
    }

    #[test]
    fn words_that_were_left_out_are_predicted_unless_the_embeddings_have_nothing_in_common() {
        let predict = |noise: f64, mix: bool| {
            let mut files = Files::default();
            let (mut map, ..) = embeddings(&mut files, noise);
            map.ridge = 0.01;
            if mix {
                map.words.iter_mut().for_each(|[_, to]| *to = (*to * 67 + 5) % WORDS as u64);
            }
            let left_out = map.words.split_off(160);
            let mut read = files.read();
            let fitted = FittedMap::fit(&mut read, &map).unwrap();
            let (mut x, mut y) = (Vec::new(), Vec::new());
            Rows::of(&map.from)
                .unwrap()
                .extend(&mut read, left_out.iter().map(|w| w[0]), &[0.0; FROM], &mut x)
                .unwrap();
            Rows::of(&map.to).unwrap().extend(&mut read, left_out.iter().map(|w| w[1]), &[0.0; TO], &mut y).unwrap();
            predicted(&fitted.points(&x, 1.0), &y, &fitted.to)
        };
        let near = predict(0.01, false);
        assert!(near.cosine > 0.99 && near.shuffled.abs() < 0.3, "{near:?}");
        assert!((near.size - 1.0).abs() < 0.05, "{near:?}");
        let far = predict(0.01, true);
        assert!(far.cosine.abs() < 0.3, "{far:?}");
    }

    #[test]
    fn rows_that_determine_no_map_are_an_error() {
        let mut files = Files::default();
        let (mut map, ..) = embeddings(&mut files, 0.0);
        for value in [0.0, f64::NAN, f64::INFINITY] {
            map.from = files.add("from", &[WORDS, FROM], &[value; WORDS * FROM]);
            let error = FittedMap::fit(&mut files.read(), &map).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::InvalidData, "{value}");
        }
    }

    #[test]
    fn maps_that_cannot_be_made_are_refused() {
        let mut files = Files::default();
        let (map, ..) = embeddings(&mut files, 0.0);
        assert_eq!(map.widths(), Ok([FROM as u64, TO as u64]));
        let refused = |change: fn(&mut WordMap<TensorRef>)| {
            let mut map = map.clone();
            change(&mut map);
            map.widths().unwrap_err()
        };
        let no_rows = "the embeddings do not have the rows of the words";
        assert_eq!(refused(|map| map.words.truncate(1)), no_rows);
        assert_eq!(refused(|map| map.words[3][1] = WORDS as u64), no_rows);
        assert_eq!(refused(|map| map.from.shape = vec![WORDS as u64]), "an embedding is no matrix");
        assert_eq!(refused(|map| map.ridge = 0.0), "0 is no penalty");
        assert_eq!(refused(|map| map.ridge = f64::NAN), "NaN is no penalty");
        assert_eq!(refused(|map| map.to.dtype = Dtype::I8), "values of type I8 can only be copied");
        assert_eq!(refused(|map| map.words = vec![[0, 0]; 16385]), "a map of 16385 words; at most 16384 are read");
        let mut many = map.clone();
        many.words = vec![[0, 0]; 16384];
        assert_eq!(many.widths(), Ok([FROM as u64, TO as u64]));
        // The matrices have at most 2^26 values.
        let wide = |width: u64| {
            let mut map = map.clone();
            map.from.shape[1] = 4096;
            map.to.shape[1] = width;
            map.widths()
        };
        assert_eq!(wide(8192), Ok([4096, 8192]));
        assert_eq!(wide(8193), Err("a map from 4096 to 8193 dimensions is too large".to_owned()));
    }
}
