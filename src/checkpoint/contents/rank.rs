//! The rank of the difference of two matrices, above what rounding adds to it.
//!
//! The rows of the difference are read twice. The first time, sums of them with random signs span the space of its largest
//! singular values: the range finder of Halko, Martinsson and Tropp, "Finding structure with randomness", SIAM Review 53(2),
//! 2011. The second time, the rows are projected onto that space, and the singular values of the projections are counted that
//! are larger than those of rounding errors.

use serde::Serialize;

use super::distance::ValueReader;
use crate::checkpoint::{Dtype, Shard, Source, Tensor};

/// Sums of rows, and so the largest rank that is told: more than the ranks of adapters.
const SUMS: usize = 96;

/// Elements of the sums of all rows: 32 MiB.
const ELEMENTS: usize = 8 << 20;

/// How much larger than the largest singular value of rounding errors a counted one is.
const MARGIN: f64 = 1.25;

/// The rank of a difference: 16 for a merged LoRA of that rank.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct DifferenceRank {
    /// The rank.
    pub rank: usize,
    /// Whether it may be larger.
    pub at_least: bool,
}

/// The rank of the difference of two matrices of the same shape; of more dimensions, all but the first are one. `None` where
/// [`super::distance()`] is, for vectors, and for rows that are too long.
pub(in crate::checkpoint) fn rank(
    sources: [&Source; 2],
    one: (&Shard, &Tensor),
    other: (&Shard, &Tensor),
) -> Option<DifferenceRank> {
    let [rows, rest @ ..] = one.1.shape.as_slice() else { return None };
    let rows = usize::try_from(*rows).ok()?;
    let columns = rest.iter().try_fold(1_usize, |n, dim| n.checked_mul(usize::try_from(*dim).ok()?))?;
    let sums = SUMS.min(rows).min(columns);
    if rest.is_empty() || sums == 0 || sums.checked_mul(columns)? > ELEMENTS {
        return None;
    }
    let mut spanned = vec![vec![0.0_f64; columns]; sums];
    let mut noise = 0.0;
    each_row(sources, one, other, columns, |number, difference, after| {
        noise += after.iter().map(|value| rounding(*value, other.1.dtype)).sum::<f64>();
        for (sum, sign) in spanned.iter_mut().zip(signs(number)) {
            sum.iter_mut().zip(difference).for_each(|(sum, value)| *sum += sign * value);
        }
    })?;
    orthonormal(&mut spanned);
    let mut squares = vec![vec![0.0_f64; spanned.len()]; spanned.len()];
    each_row(sources, one, other, columns, |_, difference, _| {
        let projected: Vec<f64> = spanned.iter().map(|axis| dot(axis, difference)).collect();
        for (line, one) in squares.iter_mut().zip(&projected) {
            line.iter_mut().zip(&projected).for_each(|(sum, other)| *sum += one * other);
        }
    })?;
    let [m, n] = [u32::try_from(rows).ok()?, u32::try_from(columns).ok()?].map(f64::from);
    let floor = MARGIN * (noise / (m * n)).sqrt() * (m.sqrt() + n.sqrt());
    let rank = eigenvalues(squares).into_iter().filter(|square| square.max(0.0).sqrt() > floor).count();
    Some(DifferenceRank { rank, at_least: rank == sums && sums < rows.min(columns) })
}

/// Calls `visit` with the number, the difference and the second values of each row.
fn each_row(
    [source, beside]: [&Source; 2],
    one: (&Shard, &Tensor),
    other: (&Shard, &Tensor),
    columns: usize,
    mut visit: impl FnMut(u64, &[f64], &[f64]),
) -> Option<()> {
    let (mut before, mut after) = (ValueReader::of(source, one)?, ValueReader::of(beside, other)?);
    let mut number = 0;
    let (mut ahead, mut there) = (Vec::new(), Vec::new());
    loop {
        let (more, others) = (before.next()?, after.next()?);
        if more.len() != others.len() {
            return None;
        }
        let is_last = more.is_empty();
        ahead.extend(more.iter().zip(&others).map(|(a, b)| b - a));
        there.extend(others);
        let whole = ahead.len().checked_div(columns)?.checked_mul(columns)?;
        for (difference, after) in ahead.chunks_exact(columns).zip(there.chunks_exact(columns)) {
            visit(number, difference, after);
            number = number.checked_add(1)?;
        }
        ahead.drain(..whole);
        there.drain(..whole);
        if is_last {
            return ahead.is_empty().then_some(());
        }
    }
}

/// The variance of the error that rounding to a type makes: a twelfth of the square of the distance to the next value.
fn rounding(value: f64, dtype: Dtype) -> f64 {
    let (bits, least) = match dtype {
        Dtype::BF16 => (7, -126),
        Dtype::F16 => (10, -14),
        Dtype::F32 => (23, -126),
        _ => (52, -1022),
    };
    // The eleven bits of a double's exponent.
    let exponent = i32::try_from(value.to_bits() >> 52 & 0x7FF).unwrap_or_default().saturating_sub(1023).max(least);
    let step = f64::from(exponent.saturating_sub(bits)).exp2();
    step * step / 12.0
}

/// Random signs of one row, the same in every run.
fn signs(row: u64) -> impl Iterator<Item = f64> {
    // SplitMix64, for 64 signs at a time.
    let bits = |block: u64| {
        let mut z = row.wrapping_mul(2).wrapping_add(block).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    };
    [bits(0), bits(1)].into_iter().flat_map(|bits| (0..64).map(move |n| if bits >> n & 1 == 0 { 1.0 } else { -1.0 }))
}

/// Makes vectors orthogonal to those before them and of length 1, twice for accuracy, and drops those of length 0.
fn orthonormal(vectors: &mut Vec<Vec<f64>>) {
    for _ in 0..2 {
        let mut done: Vec<Vec<f64>> = Vec::with_capacity(vectors.len());
        for mut vector in std::mem::take(vectors) {
            let before = dot(&vector, &vector).sqrt();
            for axis in &done {
                let share = dot(axis, &vector);
                vector.iter_mut().zip(axis).for_each(|(value, axis)| *value -= share * axis);
            }
            let length = dot(&vector, &vector).sqrt();
            if length > before * 1e-12 && length > 0.0 {
                for value in &mut vector {
                    *value /= length;
                }
                done.push(vector);
            }
        }
        *vectors = done;
    }
}

fn dot(one: &[f64], other: &[f64]) -> f64 {
    // Independent sums, which the processor adds at once.
    let mut sums = [0.0_f64; 8];
    let (ones, others) = (one.as_chunks::<8>(), other.as_chunks::<8>());
    for (a, b) in ones.0.iter().zip(others.0) {
        sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
    }
    let rest: f64 = ones.1.iter().zip(others.1).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

/// The eigenvalues of a symmetric matrix, by Jacobi's rotations.
fn eigenvalues(mut matrix: Vec<Vec<f64>>) -> Vec<f64> {
    let size = matrix.len();
    let at = |matrix: &[Vec<f64>], row: usize, column: usize| {
        matrix.get(row).and_then(|line| line.get(column)).copied().unwrap_or_default()
    };
    for _ in 0..60 {
        let outside: f64 =
            (0..size).flat_map(|p| (0..p).map(move |q| (p, q))).map(|(p, q)| at(&matrix, p, q).powi(2)).sum();
        let inside: f64 = (0..size).map(|p| at(&matrix, p, p).powi(2)).sum();
        if outside <= inside * 1e-24 {
            break;
        }
        for (p, q) in (0..size).flat_map(|p| (0..p).map(move |q| (p, q))) {
            let (pp, qq, pq) = (at(&matrix, p, p), at(&matrix, q, q), at(&matrix, p, q));
            if pq == 0.0 {
                continue;
            }
            let ratio = (qq - pp) / (2.0 * pq);
            let tangent = ratio.signum() / (ratio.abs() + ratio.hypot(1.0));
            let cosine = tangent.hypot(1.0).recip();
            let sine = tangent * cosine;
            // Rows p and q, then columns p and q.
            let (row_p, row_q): (Vec<f64>, Vec<f64>) =
                (0..size).map(|k| (at(&matrix, p, k), at(&matrix, q, k))).unzip();
            for (k, (a, b)) in row_p.into_iter().zip(row_q).enumerate() {
                put(&mut matrix, p, k, cosine * a - sine * b);
                put(&mut matrix, q, k, sine * a + cosine * b);
            }
            for k in 0..size {
                let (a, b) = (at(&matrix, k, p), at(&matrix, k, q));
                put(&mut matrix, k, p, cosine * a - sine * b);
                put(&mut matrix, k, q, sine * a + cosine * b);
            }
        }
    }
    (0..size).map(|n| at(&matrix, n, n)).collect()
}

fn put(matrix: &mut [Vec<f64>], row: usize, column: usize, value: f64) {
    if let Some(slot) = matrix.get_mut(row).and_then(|line| line.get_mut(column)) {
        *slot = value;
    }
}

#[cfg(test)]
mod tests {
    use half::bf16;

    use super::*;
    use crate::checkpoint::MemoryFiles;

    const ROWS: u32 = 160;
    const COLUMNS: u32 = 192;

    /// A number from -1 to 1 for two numbers of a kind, the same in every run.
    fn drawn(kind: u64, one: u32, other: u32) -> f64 {
        let seed = kind << 56 ^ u64::from(one) << 28 ^ u64::from(other);
        let mut z = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(0x1234_5678);
        z = (z ^ (z >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z ^= z >> 32;
        f64::from(u32::try_from(z >> 32).unwrap()) / f64::from(1_u32 << 31) - 1.0
    }

    /// The rank found of a product of this rank, added to a matrix of BF16, with `noise` times numbers without a pattern.
    fn of(product: u32, noise: f64) -> Option<(usize, bool)> {
        let change = |i: u32, j: u32| (0..product).map(|k| drawn(1, i, k) * drawn(2, j, k)).sum::<f64>() * 0.002;
        let file = |is_after: bool| {
            let values = (0..ROWS).flat_map(|i| (0..COLUMNS).map(move |j| (i, j))).map(|(i, j)| {
                let before = bf16::from_f64(drawn(3, i, j) * 0.05);
                let after = bf16::from_f64(before.to_f64() + change(i, j) + drawn(4, i, j) * noise);
                if is_after { after } else { before }
            });
            let bytes: Vec<u8> = values.flat_map(bf16::to_le_bytes).collect();
            let place = format!(r#""shape":[{ROWS},{COLUMNS}],"data_offsets":[0,{}]"#, bytes.len());
            let header = format!(r#"{{"w":{{"dtype":"BF16",{place}}}}}"#);
            [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &bytes].concat()
        };
        let files = [("a.safetensors".to_owned(), file(false)), ("b.safetensors".to_owned(), file(true))];
        let source = Source::Memory(MemoryFiles::new("model", files));
        let [one, other] = ["a.safetensors", "b.safetensors"].map(|name| Shard::read(&source, name));
        let found = rank([&source; 2], (&one, one.tensors.first()?), (&other, other.tensors.first()?))?;
        Some((found.rank, found.at_least))
    }

    #[test]
    fn the_rank_of_an_adapter_is_found_below_the_values_and_above_rounding() {
        // Rounding errors of these values are about 0.00004.
        for rank in [0, 1, 4, 16, 64] {
            assert_eq!(of(rank, 0.0), Some((usize::try_from(rank).unwrap(), false)), "{rank}");
        }
    }

    #[test]
    fn a_change_of_all_directions_has_no_small_rank() {
        assert_eq!(of(4, 0.01), Some((96, true)));
    }

    #[test]
    fn eigenvalues_are_those_of_known_matrices() {
        let mut found = eigenvalues(vec![vec![2.0, 1.0, 0.0], vec![1.0, 2.0, 0.0], vec![0.0, 0.0, 5.0]]);
        found.sort_by(f64::total_cmp);
        for (one, other) in found.iter().zip([1.0, 3.0, 5.0]) {
            assert!((one - other).abs() < 1e-9, "{found:?}");
        }
    }
}
