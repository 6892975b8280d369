//! The bytes of a planned tensor: evaluates its expression, from its leaves into a chain of writers.
//!
//! Each function streams into a writer and keeps at most a few rows in memory, and the factors of a product.

use std::io::{self, Write};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rand_distr::{Distribution, Normal, StandardNormal, Uniform};
use sha2::{Digest, Sha256};

use super::convert::{CastLosses, Converter};
use super::expr::{NewValues, TensorExpr};
use super::planned_tensor::PlannedTensor;
use super::product::Adder;
use super::tensor_ref::{ReadAt, TensorRef};
use super::values::Codec;
use super::word_map::{self, MappedAs};
use crate::checkpoint::Dtype;
use crate::checkpoint::reserve::reserved;

/// Factor on the covariance of sampled rows. Source: `_init_added_embeddings_weights_with_mean` in transformers 4.47 to 5.23.
const SAMPLE_VARIANCE: f64 = 1e-9;
/// Largest table, in bytes, that is kept in memory while rows are sampled from it.
const KEPT: u64 = 16 << 20;
/// Donor rows that a sampled row combines.
const SAMPLE_TERMS: u32 = 64;

/// What is known of the values of a tensor once they are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ValueFacts {
    /// Values of the donor that scaling and casting could not keep.
    pub losses: CastLosses,
    /// Values of sampled rows that differ from the mean of the others, as they are stored.
    pub distinct: u64,
}

/// Writes the bytes of a planned tensor; returns what is known of its values then.
///
/// `read` reads the parts of the donors' tensors that are used. The expression must have the type and the shape of the tensor.
///
/// # Errors
/// Errors of reading or writing; [`io::ErrorKind::InvalidInput`] for operands that do not fit.
pub fn write(read: &mut ReadAt<'_>, tensor: &PlannedTensor, out: &mut dyn Write) -> io::Result<ValueFacts> {
    let mut facts = ValueFacts::default();
    evaluate(read, tensor, &tensor.source, &mut facts, out)?;
    Ok(facts)
}

/// Writes the values of an expression of a tensor, and adds to the facts.
fn evaluate(
    read: &mut ReadAt<'_>,
    tensor: &PlannedTensor,
    source: &TensorExpr<TensorRef>,
    facts: &mut ValueFacts,
    out: &mut dyn Write,
) -> io::Result<()> {
    let mut of = |from: &TensorRef, at: u64, buffer: &mut [u8]| read(from, at, buffer);
    match source {
        TensorExpr::Stored(from) => copy(&mut |at, buffer| of(from, at, buffer), from.len, out),
        TensorExpr::GrowRows { of: from, rows } => {
            grow_rows(&mut |at, buffer| of(from, at, buffer), Table::of(from, *rows), out)
        }
        TensorExpr::SampleRows { of: from, rows } => {
            let stored = (tensor.source.scale(), tensor.dtype);
            let table = Table::of(from, *rows);
            facts.distinct = sample_rows(&mut |at, buffer| of(from, at, buffer), table, &tensor.name, stored, out)?;
            Ok(())
        }
        TensorExpr::NewRows { like, rows, sampled, .. } => {
            let table = Table::like(like, *rows);
            let mut of = |at: u64, buffer: &mut [u8]| of(like, at, buffer);
            if *sampled {
                let stored = (tensor.source.scale(), tensor.dtype);
                facts.distinct = sample_rows(&mut of, table, &tensor.name, stored, out)?;
                return Ok(());
            }
            grow_rows(&mut of, table, out)
        }
        TensorExpr::Pad { of: from, shape } => {
            pad(&mut |at, buffer| of(from, at, buffer), from.dtype.bits() / 8, &from.shape, shape, out)
        }
        TensorExpr::Map { of: from, values, before, after, to, map } => {
            let how = MappedAs { values: *values, before: *before, after: *after, to: *to };
            facts.losses.add(word_map::write(read, from, how, map, out)?);
            Ok(())
        }
        TensorExpr::Initialise { values, dtype, shape, .. } => new_values(&tensor.name, *dtype, shape, *values, out),
        TensorExpr::Cast { of, to } => convert(read, tensor, of, (None, *to), facts, out),
        TensorExpr::Scale { of, by, to } => convert(read, tensor, of, (Some(*by), *to), facts, out),
        TensorExpr::AddProduct { to, product } => {
            let (dtype, shape) = to.typed().map_err(|reason| io::Error::new(io::ErrorKind::InvalidInput, reason))?;
            let mut adder = Adder::new(read, product, dtype, &shape, out)?;
            evaluate(read, tensor, to, facts, &mut adder)?;
            facts.losses.add(adder.losses());
            Ok(())
        }
    }
}

/// Writes values multiplied by a constant, and cast.
fn convert(
    read: &mut ReadAt<'_>,
    tensor: &PlannedTensor,
    of: &TensorExpr<TensorRef>,
    (scale, to): (Option<f64>, Dtype),
    facts: &mut ValueFacts,
    out: &mut dyn Write,
) -> io::Result<()> {
    let (from, _) = of.typed().map_err(|reason| io::Error::new(io::ErrorKind::InvalidInput, reason))?;
    let mut converter = Converter::new(from, to, scale, out);
    evaluate(read, tensor, of, facts, &mut converter)?;
    facts.losses.add(converter.losses());
    Ok(())
}

/// Reads bytes of the only operand of an operation: `read(offset within the tensor, buffer)`.
pub type ReadOperand<'a> = dyn FnMut(u64, &mut [u8]) -> io::Result<()> + 'a;

/// Writes `count` zero bytes.
fn zeros(out: &mut dyn Write, mut count: u64) -> io::Result<()> {
    let block = [0_u8; 16 * 1024];
    while count > 0 {
        let n = usize::try_from(count).map_or(block.len(), |c| c.min(block.len()));
        out.write_all(block.get(..n).unwrap_or(&block))?;
        count = count.saturating_sub(n as u64);
    }
    Ok(())
}

/// Copies the `len` bytes of a donor's tensor.
fn copy(read: &mut ReadOperand<'_>, len: u64, out: &mut dyn Write) -> io::Result<()> {
    copy_range(read, 0, len, out)
}

/// Copies `len` bytes from `offset` of the donor tensor.
fn copy_range(read: &mut ReadOperand<'_>, mut offset: u64, mut len: u64, out: &mut dyn Write) -> io::Result<()> {
    let mut block = vec![0_u8; usize::try_from(len).map_or(256 * 1024, |n| n.min(256 * 1024))];
    while len > 0 {
        let n = usize::try_from(len).map_or(block.len(), |c| c.min(block.len()));
        let part = block.get_mut(..n).unwrap_or_default();
        read(offset, part)?;
        out.write_all(part)?;
        offset = offset.saturating_add(n as u64);
        len = len.saturating_sub(n as u64);
    }
    Ok(())
}

/// Writes a tensor of shape `to`: the donor's values, of shape `from`, in the leading corner, zeros elsewhere.
///
/// `elem` is the element width in bytes. `to` must have the rank of `from` and be at least as large in every dimension,
/// which the planner ensures.
///
/// # Errors
/// Errors of reading or writing; [`io::ErrorKind::InvalidInput`] for shapes that do not nest.
pub fn pad(read: &mut ReadOperand<'_>, elem: u64, from: &[u64], to: &[u64], out: &mut dyn Write) -> io::Result<()> {
    fn inner(
        read: &mut ReadOperand<'_>,
        at: &mut u64,
        elem: u64,
        from: &[u64],
        to: &[u64],
        out: &mut dyn Write,
    ) -> io::Result<()> {
        let stride = |dims: &[u64]| dims.iter().fold(elem, |n, d| n.saturating_mul(*d));
        match (from.split_first(), to.split_first()) {
            // The remaining dimensions are equal: one range of bytes.
            _ if from == to => {
                let len = stride(from);
                copy_range(read, *at, len, out)?;
                *at = at.saturating_add(len);
                Ok(())
            }
            (Some((f, from_rest)), Some((t, to_rest))) if f <= t && from_rest.len() == to_rest.len() => {
                if from_rest == to_rest {
                    let len = stride(from);
                    copy_range(read, *at, len, out)?;
                    *at = at.saturating_add(len);
                } else {
                    for _ in 0..*f {
                        inner(read, at, elem, from_rest, to_rest, out)?;
                    }
                }
                zeros(out, t.saturating_sub(*f).saturating_mul(stride(to_rest)))
            }
            _ => Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                "a tensor can only be padded to a larger shape of its rank",
            )),
        }
    }
    inner(read, &mut 0, elem, from, to, out)
}

/// A donor's matrix that gets more rows.
#[derive(Debug, Clone, Copy)]
pub struct Table {
    /// Type of its values.
    pub dtype: Dtype,
    /// Rows of the donor.
    pub rows: u64,
    /// Values in a row.
    pub width: u64,
    /// Whether the donor's rows are in the result.
    pub keeps: bool,
    /// Rows to append.
    pub more: u64,
}

impl Table {
    /// The rows of a donor, which get up to `rows`.
    fn of(from: &TensorRef, rows: u64) -> Self {
        let have = from.shape.first().copied().unwrap_or_default();
        let width = from.shape.iter().skip(1).fold(1_u64, |n, d| n.saturating_mul(*d));
        Self { dtype: from.dtype, rows: have, width, keeps: true, more: rows.saturating_sub(have) }
    }

    /// `rows` rows like those of a donor, which are not in the result.
    fn like(from: &TensorRef, rows: u64) -> Self {
        Self { keeps: false, more: rows, ..Self::of(from, rows) }
    }

    /// Bytes of a row.
    fn row_len(self) -> io::Result<usize> {
        usize::try_from(self.width.saturating_mul(self.dtype.bits() / 8)).map_err(io::Error::other)
    }

    /// Copies the rows, if they are in the result, and returns their mean, zeros without rows; `keep` gets the bytes of a table of
    /// at most [`KEPT`] bytes, so that rows need not be read again one by one.
    fn copy_rows(
        self,
        read: &mut ReadOperand<'_>,
        codec: &mut Codec,
        out: &mut dyn Write,
        keep: Option<&mut Vec<u8>>,
    ) -> io::Result<Vec<f64>> {
        let mut row: Vec<u8> = reserved(self.row_len()?)?;
        let mut mean: Vec<f64> = reserved(usize::try_from(self.width).map_err(io::Error::other)?)?;
        let mut keep = keep.filter(|_| (row.len() as u64).saturating_mul(self.rows) <= KEPT);
        let mut at = 0_u64;
        for _ in 0..self.rows {
            read(at, &mut row)?;
            if self.keeps {
                out.write_all(&row)?;
            }
            if let Some(keep) = &mut keep {
                keep.extend_from_slice(&row);
            }
            for (sum, value) in mean.iter_mut().zip(codec.decode(self.dtype, &row)) {
                *sum += *value;
            }
            at = at.saturating_add(row.len() as u64);
        }
        #[expect(clippy::cast_precision_loss, reason = "row counts are far below 2^52")]
        let count = self.rows.max(1) as f64;
        for sum in &mut mean {
            *sum /= count;
        }
        Ok(mean)
    }
}

/// Copies the rows and appends rows that hold their mean.
///
/// # Errors
/// Errors of reading or writing.
pub fn grow_rows(read: &mut ReadOperand<'_>, table: Table, out: &mut dyn Write) -> io::Result<()> {
    let mut codec = Codec::default();
    let mean = table.copy_rows(read, &mut codec, out, None)?;
    let mut row = Vec::new();
    codec.encode_values(table.dtype, &mean, &mut row);
    for _ in 0..table.more {
        out.write_all(&row)?;
    }
    Ok(())
}

/// Copies the rows and appends rows with their mean and, times 1e-9, their covariance, as transformers initialises added
/// tokens (`mean_resizing`).
///
/// A new row is `mean + sqrt(1e-9 / k) * sum of g * (x - mean)` over `k` = 64 rows `x`, drawn with replacement, and standard
/// normal numbers `g`. Its mean and covariance are exactly those of transformers, without a matrix of `width` squared
/// values in memory. The generator is seeded with the name of the tensor.
///
/// Returns how many of the new values differ from the mean once they are multiplied and cast as `stored` says: noise of this size
/// is mostly lost in 16 bits.
///
/// # Errors
/// Errors of reading or writing.
pub fn sample_rows(
    read: &mut ReadOperand<'_>,
    table: Table,
    name: &str,
    (scale, dtype): (Option<f64>, Dtype),
    out: &mut dyn Write,
) -> io::Result<u64> {
    let mut codec = Codec::default();
    let mut kept = Vec::new();
    let mean = table.copy_rows(read, &mut codec, out, Some(&mut kept))?;
    let mut rng = seeded(name);
    let factor = (SAMPLE_VARIANCE / f64::from(SAMPLE_TERMS)).sqrt();
    let mut donor_row: Vec<u8> = reserved(table.row_len()?)?;
    let stored = |values: &[f64]| {
        let (mut codec, mut bytes) = (Codec::default(), Vec::new());
        codec.encode_values(table.dtype, values, &mut bytes);
        let scaled =
            codec.decode(table.dtype, &bytes).iter().map(|value| value * scale.unwrap_or(1.0)).collect::<Vec<_>>();
        bytes.clear();
        codec.encode_values(dtype, &scaled, &mut bytes);
        codec.decode(dtype, &bytes).clone()
    };
    let (mean_stored, mut distinct) = (stored(&mean), 0_u64);
    let mut row = Vec::new();
    for _ in 0..table.more {
        let mut values = mean.clone();
        for _ in 0..if table.rows == 0 { 0 } else { SAMPLE_TERMS } {
            let g: f64 = StandardNormal.sample(&mut rng);
            let weight = factor * g;
            let at = below(&mut rng, table.rows).saturating_mul(donor_row.len() as u64);
            let from = usize::try_from(at).ok().and_then(|at| kept.get(at..at.checked_add(donor_row.len())?));
            match from {
                Some(bytes) => donor_row.copy_from_slice(bytes),
                None => read(at, &mut donor_row)?,
            }
            for ((value, x), mean) in values.iter_mut().zip(codec.decode(table.dtype, &donor_row)).zip(&mean) {
                *value += weight * (*x - mean);
            }
        }
        row.clear();
        codec.encode_values(table.dtype, &values, &mut row);
        out.write_all(&row)?;
        #[expect(clippy::float_cmp, reason = "as they are stored")]
        let differ = stored(&values).iter().zip(&mean_stored).filter(|(value, mean)| value != mean).count();
        distinct = distinct.saturating_add(differ as u64);
    }
    Ok(distinct)
}

/// The generator for the fresh values of a tensor, seeded with its name, so that merges are reproducible.
fn seeded(name: &str) -> ChaCha8Rng {
    ChaCha8Rng::from_seed(Sha256::digest(name.as_bytes()).into())
}

/// A number from 0 to below `limit`. The bias is below 2^-32 for limits below 2^32.
fn below(rng: &mut ChaCha8Rng, limit: u64) -> u64 {
    let product = u128::from(rng.next_u64()).wrapping_mul(u128::from(limit));
    u64::try_from(product >> 64).unwrap_or_default()
}

/// Writes the values of a tensor that starts again.
///
/// # Errors
/// Errors of writing; [`io::ErrorKind::Other`] for a distribution that does not exist.
pub fn new_values(name: &str, dtype: Dtype, shape: &[u64], values: NewValues, out: &mut dyn Write) -> io::Result<()> {
    let count = shape.iter().fold(1_u64, |n, d| n.saturating_mul(*d));
    match values {
        NewValues::Zeros => zeros(out, count.saturating_mul(dtype.bits() / 8)),
        NewValues::Ones => draw(dtype, count, || 1.0, out),
        NewValues::Normal(deviation) => {
            let mut rng = seeded(name);
            let normal = Normal::new(0.0, deviation).map_err(io::Error::other)?;
            draw(dtype, count, || normal.sample(&mut rng), out)
        }
        NewValues::Uniform(limit) => {
            let mut rng = seeded(name);
            let uniform = Uniform::new_inclusive(-limit, limit).map_err(io::Error::other)?;
            draw(dtype, count, || uniform.sample(&mut rng), out)
        }
    }
}

/// Writes `left` values, one after the other.
fn draw(dtype: Dtype, mut left: u64, mut next: impl FnMut() -> f64, out: &mut dyn Write) -> io::Result<()> {
    let mut codec = Codec::default();
    let (mut values, mut block) = (Vec::new(), Vec::new());
    while left > 0 {
        let n = usize::try_from(left).map_or(RANDOM_BLOCK, |n| n.min(RANDOM_BLOCK));
        values.clear();
        values.extend((0..n).map(|_| next()));
        block.clear();
        codec.encode_values(dtype, &values, &mut block);
        out.write_all(&block)?;
        left = left.saturating_sub(n as u64);
    }
    Ok(())
}

/// Random values computed at a time.
const RANDOM_BLOCK: usize = 8 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    fn reader(bytes: Vec<u8>) -> impl FnMut(u64, &mut [u8]) -> io::Result<()> {
        move |at, buf| {
            let at = usize::try_from(at).unwrap();
            buf.copy_from_slice(&bytes[at..][..buf.len()]);
            Ok(())
        }
    }

    #[test]
    fn padding_keeps_the_corner_and_fills_with_zeros() {
        let mut out = Vec::new();
        pad(&mut reader(vec![1, 2, 3, 4, 5, 6]), 1, &[2, 3], &[3, 4], &mut out).unwrap();
        assert_eq!(out, [1, 2, 3, 0, 4, 5, 6, 0, 0, 0, 0, 0]);
        out.clear();
        pad(&mut reader(vec![1, 2, 3, 4]), 2, &[2], &[3], &mut out).unwrap();
        assert_eq!(out, [1, 2, 3, 4, 0, 0]);
        out.clear();
        assert!(pad(&mut reader(vec![1, 2]), 1, &[2], &[1], &mut out).is_err());
    }

    #[test]
    fn grown_rows_are_the_mean() {
        let values = [1.0_f32, 2.0, 3.0, 6.0];
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let mut out = Vec::new();
        let table = Table { dtype: Dtype::F32, rows: 2, width: 2, keeps: true, more: 2 };
        let mut read = reader(bytes);
        grow_rows(&mut read, table, &mut out).unwrap();
        assert_eq!(*Codec::default().decode(Dtype::F32, &out), [1.0, 2.0, 3.0, 6.0, 2.0, 4.0, 2.0, 4.0]);
        out.clear();
        grow_rows(&mut read, Table { keeps: false, ..table }, &mut out).unwrap();
        assert_eq!(*Codec::default().decode(Dtype::F32, &out), [2.0, 4.0, 2.0, 4.0]);
    }

    #[test]
    fn sampled_rows_have_the_mean_and_the_covariance_of_the_others() {
        // Two columns of opposite sign, so that their covariance is negative.
        let rows: Vec<[f64; 2]> = (0..100).map(|i| f64::from(i) - 49.5).map(|x| [3.0 + x, 5.0 - 2.0 * x]).collect();
        let bytes: Vec<u8> = rows.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let table = Table { dtype: Dtype::F64, rows: 100, width: 2, keeps: true, more: 4000 };
        let make = |name| {
            let mut out = Vec::new();
            let distinct = sample_rows(&mut reader(bytes.clone()), table, name, (None, Dtype::F64), &mut out).unwrap();
            assert_eq!(distinct, 8000);
            out
        };
        // In 16 bits the noise is rounded away.
        let narrow = sample_rows(&mut reader(bytes.clone()), table, "a", (Some(2.0), Dtype::BF16), &mut Vec::new());
        assert_eq!(narrow.unwrap(), 0);
        let out = make("a");
        assert_eq!(out, make("a"));
        assert_ne!(out, make("b"));
        assert_eq!(out[..bytes.len()], bytes);
        let values = Codec::default().decode(Dtype::F64, &out[bytes.len()..]).clone();
        let fresh: Vec<&[f64]> = values.chunks(2).collect();
        assert_ne!(fresh[0], fresh[1]);
        let mean = |i: usize| fresh.iter().map(|row| row[i]).sum::<f64>() / 4000.0;
        let product = |i: usize, j: usize| {
            fresh.iter().map(|row| (row[i] - mean(i)) * (row[j] - mean(j))).sum::<f64>() / 4000.0 / SAMPLE_VARIANCE
        };
        assert!((mean(0) - 3.0).abs() < 1e-4 && (mean(1) - 5.0).abs() < 1e-4, "{} {}", mean(0), mean(1));
        // The variance of 0..100 is 833.25; 4000 samples estimate it to a few per cent.
        for (i, j, want) in [(0, 0, 833.25), (0, 1, -1666.5), (1, 1, 3333.0)] {
            assert!((product(i, j) / want - 1.0).abs() < 0.1, "{i} {j}: {}", product(i, j));
        }
    }

    #[test]
    fn rows_appended_to_none_are_zero() {
        let table = Table { dtype: Dtype::F16, rows: 0, width: 3, keeps: true, more: 2 };
        for sample in [false, true] {
            let mut out = Vec::new();
            let mut read = reader(Vec::new());
            if sample {
                let distinct = sample_rows(&mut read, table, "a", (None, Dtype::F16), &mut out).unwrap();
                assert_eq!(distinct, 0);
            } else {
                grow_rows(&mut read, table, &mut out).unwrap();
            }
            assert_eq!(out, [0; 12]);
        }
    }

    #[test]
    fn new_values_are_seeded_by_name_and_have_the_size_that_is_asked_for() {
        let make = |name, values| {
            let mut out = Vec::new();
            new_values(name, Dtype::BF16, &[64, 64], values, &mut out).unwrap();
            out
        };
        for (values, want) in [(NewValues::Normal(0.02), 0.02), (NewValues::Uniform(0.3), 0.3 / 3_f64.sqrt())] {
            assert_eq!(make("a", values), make("a", values));
            assert_ne!(make("a", values), make("b", values));
            let drawn = Codec::default().decode(Dtype::BF16, &make("a", values)).clone();
            let spread = (drawn.iter().map(|v| v * v).sum::<f64>() / 4096.0).sqrt();
            assert!((spread / want - 1.0).abs() < 0.05, "{values:?}: {spread}");
        }
        for (values, want) in [(NewValues::Zeros, [0, 0, 0, 0]), (NewValues::Ones, [0, 0x3c, 0, 0x3c])] {
            let mut out = Vec::new();
            new_values("norm", Dtype::F16, &[2], values, &mut out).unwrap();
            assert_eq!(out, want);
        }
    }
}
