//! Sums of products, and linear equations, in binary64 and in a fixed order.

use std::io;

/// Adds Σ a bᵀ over the rows of `left` and `right`, row by row; of a symmetric sum, the lower triangle. `width` is that of `right`.
pub(super) fn add_products(out: &mut [f64], left: &[f64], right: &[f64], width: usize, is_symmetric: bool) {
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
pub(super) fn add_rows(sums: &mut [f64], factors: &[f64], rows: &[f64], width: usize) {
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
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
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
pub(super) fn cholesky(matrix: &mut [f64], width: usize) -> io::Result<()> {
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

/// Solves `L Lᵀ z = v` for vectors that are stored component by component, in their place.
pub(super) fn solve(factor: &[f64], vectors: &mut [f64], width: usize, count: usize) {
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
