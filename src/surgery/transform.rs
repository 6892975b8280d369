//! Tensors that are not byte copies: padding, added rows, reinitialised values.
//!
//! Each function streams into a writer and keeps at most a few rows in memory.

use std::io::{self, Write};

use half::{bf16, f16};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Normal};
use sha2::{Digest, Sha256};

use crate::checkpoint::Dtype;

/// Standard deviation of reinitialised weights: the usual `initializer_range` of transformers.
const INIT_STD: f64 = 0.02;

/// Whether values of `dtype` can be computed, not only copied.
#[must_use]
pub const fn can_compute(dtype: Dtype) -> bool {
    matches!(dtype, Dtype::F16 | Dtype::BF16 | Dtype::F32 | Dtype::F64)
}

/// Encodes one value.
fn encode(dtype: Dtype, value: f64, out: &mut Vec<u8>) {
    match dtype {
        Dtype::F16 => out.extend_from_slice(&f16::from_f64(value).to_le_bytes()),
        Dtype::BF16 => out.extend_from_slice(&bf16::from_f64(value).to_le_bytes()),
        #[expect(clippy::cast_possible_truncation, reason = "rounding to the tensor's own precision is the point")]
        Dtype::F32 => out.extend_from_slice(&(value as f32).to_le_bytes()),
        _ => out.extend_from_slice(&value.to_le_bytes()),
    }
}

/// Decodes whole elements; a partial element at the end is ignored.
fn decode(dtype: Dtype, bytes: &[u8]) -> Vec<f64> {
    fn each<const N: usize>(bytes: &[u8], f: impl Fn([u8; N]) -> f64) -> Vec<f64> {
        bytes.as_chunks::<N>().0.iter().map(|c| f(*c)).collect()
    }
    match dtype {
        Dtype::F16 => each::<2>(bytes, |b| f16::from_le_bytes(b).to_f64()),
        Dtype::BF16 => each::<2>(bytes, |b| bf16::from_le_bytes(b).to_f64()),
        Dtype::F32 => each::<4>(bytes, |b| f64::from(f32::from_le_bytes(b))),
        _ => each::<8>(bytes, f64::from_le_bytes),
    }
}

/// Reads bytes of the donor tensor: `read(offset within the tensor, buffer)`.
pub type ReadAt<'a> = dyn FnMut(u64, &mut [u8]) -> io::Result<()> + 'a;

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

/// Copies `len` bytes from `offset` of the donor tensor.
///
/// # Errors
/// Errors of reading or writing.
pub fn copy(read: &mut ReadAt<'_>, mut offset: u64, mut len: u64, out: &mut dyn Write) -> io::Result<()> {
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
pub fn pad(read: &mut ReadAt<'_>, elem: u64, from: &[u64], to: &[u64], out: &mut dyn Write) -> io::Result<()> {
    fn inner(
        read: &mut ReadAt<'_>,
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
                copy(read, *at, len, out)?;
                *at = at.saturating_add(len);
                Ok(())
            }
            (Some((f, from_rest)), Some((t, to_rest))) if f <= t && from_rest.len() == to_rest.len() => {
                if from_rest == to_rest {
                    let len = stride(from);
                    copy(read, *at, len, out)?;
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

/// Copies `rows` rows of `width` elements and appends `more` rows, each the mean of the copied ones.
///
/// transformers initialises added tokens with the same mean plus noise (`mean_resizing`). Without noise, two runs give
/// the same bytes.
///
/// # Errors
/// Errors of reading or writing.
pub fn grow_rows(
    read: &mut ReadAt<'_>,
    dtype: Dtype,
    rows: u64,
    width: u64,
    more: u64,
    out: &mut dyn Write,
) -> io::Result<()> {
    let row_len = usize::try_from(width.saturating_mul(dtype.bits() / 8)).map_err(io::Error::other)?;
    let mut row = vec![0_u8; row_len];
    let mut sums = vec![0_f64; usize::try_from(width).map_err(io::Error::other)?];
    let mut at = 0_u64;
    for _ in 0..rows {
        read(at, &mut row)?;
        out.write_all(&row)?;
        for (sum, v) in sums.iter_mut().zip(decode(dtype, &row)) {
            *sum += v;
        }
        at = at.saturating_add(row_len as u64);
    }
    #[expect(clippy::cast_precision_loss, reason = "row counts are far below 2^52")]
    let count = rows.max(1) as f64;
    let mut mean = Vec::with_capacity(row_len);
    for sum in sums {
        encode(dtype, sum / count, &mut mean);
    }
    for _ in 0..more {
        out.write_all(&mean)?;
    }
    Ok(())
}

/// Writes reinitialised values: normal with standard deviation 0.02 for matrices, zeros for vectors.
///
/// The generator is seeded with the tensor's name, so that merges are reproducible.
///
/// # Errors
/// Errors of writing.
pub fn reinit(name: &str, dtype: Dtype, shape: &[u64], out: &mut dyn Write) -> io::Result<()> {
    let count = shape.iter().fold(1_u64, |n, d| n.saturating_mul(*d));
    if shape.len() < 2 {
        return zeros(out, count.saturating_mul(dtype.bits() / 8));
    }
    let mut rng = ChaCha8Rng::from_seed(Sha256::digest(name.as_bytes()).into());
    let normal = Normal::new(0.0, INIT_STD).map_err(io::Error::other)?;
    let mut block = Vec::new();
    for i in 0..count {
        encode(dtype, normal.sample(&mut rng), &mut block);
        if block.len() >= 64 * 1024 || i.saturating_add(1) == count {
            out.write_all(&block)?;
            block.clear();
        }
    }
    Ok(())
}

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
        grow_rows(&mut reader(bytes), Dtype::F32, 2, 2, 2, &mut out).unwrap();
        assert_eq!(decode(Dtype::F32, &out), [1.0, 2.0, 3.0, 6.0, 2.0, 4.0, 2.0, 4.0]);
    }

    #[test]
    fn fresh_values_are_seeded_by_name_and_small() {
        let make = |name| {
            let mut out = Vec::new();
            reinit(name, Dtype::BF16, &[64, 64], &mut out).unwrap();
            out
        };
        assert_eq!(make("a"), make("a"));
        assert_ne!(make("a"), make("b"));
        let values = decode(Dtype::BF16, &make("a"));
        let spread = (values.iter().map(|v| v * v).sum::<f64>() / 4096.0).sqrt();
        assert!((spread - INIT_STD).abs() < 0.002, "{spread}");
        let mut bias = Vec::new();
        reinit("bias", Dtype::F16, &[3], &mut bias).unwrap();
        assert_eq!(bias, [0; 6]);
    }
}
