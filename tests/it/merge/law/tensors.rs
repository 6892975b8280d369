//! The law of planned tensors: whatever their types, shapes, slices, factors and treatment, the bytes that are streamed are
//! those of an implementation that holds all values and rounds by comparing neighbours.

#![expect(clippy::cast_precision_loss, clippy::float_cmp, reason = "mantissas and ties are exact")]

use std::path::PathBuf;

use ckpt_doctor::checkpoint::{Dtype, byte_len};
use ckpt_doctor::surgery::convert::CastLosses;
use ckpt_doctor::surgery::expr::{Factor, Product, TensorExpr};
use ckpt_doctor::surgery::planned_tensor::PlannedTensor;
use ckpt_doctor::surgery::tensor_ref::TensorRef;
use ckpt_doctor::surgery::transform;

use super::FEW;
use crate::support::Draw;

const TYPES: [Dtype; 4] = [Dtype::F16, Dtype::BF16, Dtype::F32, Dtype::F64];

/// Bits of exponent and mantissa.
fn format(dtype: Dtype) -> (u32, u32) {
    match dtype {
        Dtype::F16 => (5, 10),
        Dtype::BF16 => (8, 7),
        Dtype::F32 => (8, 23),
        _ => (11, 52),
    }
}

/// The value of encoded bits, by the definition of IEEE 754.
fn value(dtype: Dtype, bits: u64) -> f64 {
    let (exponent_bits, mantissa_bits) = format(dtype);
    let exponent = bits >> mantissa_bits & ((1 << exponent_bits) - 1);
    let mantissa = (bits & ((1 << mantissa_bits) - 1)) as f64;
    let sign = if bits >> (exponent_bits + mantissa_bits) & 1 == 1 { -1.0 } else { 1.0 };
    let bias = (1_i32 << (exponent_bits - 1)) - 1;
    let unit = |exponent: i32| 2_f64.powi(exponent / 2) * 2_f64.powi(exponent - exponent / 2);
    let shift = i32::try_from(mantissa_bits).unwrap();
    sign * match exponent {
        0 => mantissa * unit(1 - bias - shift),
        e if e == (1 << exponent_bits) - 1 => {
            if mantissa == 0.0 {
                f64::INFINITY
            } else {
                f64::NAN
            }
        }
        e => (mantissa + unit(shift)) * unit(i32::try_from(e).unwrap() - bias - shift),
    }
}

/// The bits of the nearest value, found by bisection; ties go to even bits. Infinity counts as the next power of two.
fn nearest(dtype: Dtype, of: f64) -> u64 {
    let (exponent_bits, mantissa_bits) = format(dtype);
    let sign = u64::from(of.is_sign_negative()) << (exponent_bits + mantissa_bits);
    let infinity = ((1_u64 << exponent_bits) - 1) << mantissa_bits;
    if of.is_nan() {
        return infinity + 1;
    }
    let of = of.abs();
    let (mut low, mut high) = (0_u64, infinity);
    while high - low > 1 {
        let middle = u64::midpoint(low, high);
        if value(dtype, middle) <= of { low = middle } else { high = middle }
    }
    let beyond = value(dtype, infinity - 1) + (value(dtype, infinity - 1) - value(dtype, infinity - 2));
    let top = if high == infinity { beyond } else { value(dtype, high) };
    let (down, up) = (of - value(dtype, low), top - of);
    sign | if down < up || (down == up && low % 2 == 0) { low } else { high }
}

/// A donor tensor with arbitrary bits, and a plan for it.
struct Case {
    bytes: Vec<u8>,
    from: TensorRef,
    fit: Fit,
    scale: Option<f64>,
    tensor: PlannedTensor,
}

/// How a tensor gets its shape.
#[derive(Clone, Copy, PartialEq)]
enum Fit {
    Stored,
    GrowRows,
    SampleRows,
    NewRows,
    Pad,
}

/// A donor's tensor at the start of a file of its own.
fn donor(path: &str, dtype: Dtype, shape: Vec<u64>) -> TensorRef {
    let len = byte_len(dtype, &shape).unwrap();
    let (donor, name) = ("a".to_owned(), "x".to_owned());
    TensorRef { donor, path: PathBuf::from(path), name, dtype, shape, offset: 0, len, slice: None }
}

fn case(random: &mut Draw) -> Case {
    let (from, to) = (TYPES[random.below(4)], TYPES[random.below(4)]);
    let fit = [Fit::Stored, Fit::GrowRows, Fit::SampleRows, Fit::NewRows, Fit::Pad][random.below(5)];
    let shape: Vec<u64> = (0..=random.below(3)).map(|_| random.below(6) as u64).collect();
    let mut wanted = shape.clone();
    match fit {
        Fit::Pad => wanted.iter_mut().for_each(|dim| *dim += random.below(4) as u64),
        Fit::GrowRows | Fit::SampleRows => wanted[0] += random.below(4) as u64,
        Fit::NewRows => wanted[0] = random.below(9) as u64,
        Fit::Stored => {}
    }
    let len = byte_len(from, &shape).unwrap();
    let width = usize::try_from(from.bits() / 8).unwrap();
    let count = usize::try_from(len).unwrap() / width;
    let mut bytes = Vec::new();
    for _ in 0..count {
        let bits = ((random.below(1 << 32) as u64) << 32) | random.below(1 << 32) as u64;
        // Half of the values have a usual magnitude, so that products and means are finite.
        let bits = if random.below(2) == 0 { nearest(from, bits.cast_signed() as f64 / 2_f64.powi(62)) } else { bits };
        bytes.extend_from_slice(&bits.to_le_bytes()[..width]);
    }
    let scale = [None, Some(64.0), Some(1.0 / 3.0), Some(-2e6)][random.below(4)];
    let from = donor("", from, shape);
    let (of, rows) = (from.clone(), wanted[0]);
    let fitted = match fit {
        Fit::Stored => TensorExpr::Stored(of),
        Fit::GrowRows => TensorExpr::GrowRows { of, rows },
        Fit::SampleRows => TensorExpr::SampleRows { of, rows },
        Fit::NewRows => {
            let instead_of = donor("unread", Dtype::U8, vec![3]);
            TensorExpr::NewRows { like: of, rows, sampled: false, instead_of }
        }
        Fit::Pad => TensorExpr::Pad { of, shape: wanted.clone() },
    };
    let tensor = PlannedTensor::new("x".to_owned(), fitted.converted(from.dtype, scale, to)).unwrap();
    assert_eq!((tensor.dtype, &tensor.shape), (to, &wanted));
    Case { bytes, from, fit, scale, tensor }
}

/// The donor's bits in the planned shape, before scaling and casting; the rows that `sample-rows` adds are `None`.
fn fitted(case: &Case) -> Vec<Option<u64>> {
    let Case { from, fit, .. } = case;
    let width = usize::try_from(from.dtype.bits() / 8).unwrap();
    let bits: Vec<u64> =
        case.bytes.chunks(width).map(|c| c.iter().rev().fold(0, |n, b| n << 8 | u64::from(*b))).collect();
    let to = &case.tensor.shape;
    let row = to[1..].iter().product::<u64>();
    let total = to.iter().product::<u64>();
    let index = |place: u64| {
        if *fit == Fit::NewRows {
            return None;
        }
        // The place in the donor of a place in the result.
        let (mut rest, mut at, mut stride) = (place, 0, 1);
        for (have, want) in from.shape.iter().zip(to).rev() {
            let coordinate = rest % want;
            rest /= want;
            if coordinate >= *have {
                return None;
            }
            at += coordinate * stride;
            stride *= have;
        }
        Some(usize::try_from(at).unwrap())
    };
    (0..total)
        .map(|place| match (index(place), fit) {
            (Some(at), _) => Some(bits[at]),
            (None, Fit::Pad) => Some(0),
            (None, Fit::SampleRows) => None,
            (None, _) => {
                let column = usize::try_from(place % row).unwrap();
                let row = usize::try_from(row).unwrap();
                let values = bits.iter().skip(column).step_by(row).map(|b| value(from.dtype, *b));
                let mean = values.clone().fold(0.0, |sum, v| sum + v) / (values.count().max(1) as f64);
                Some(through_single(from.dtype, mean))
            }
        })
        .collect()
}

/// Rounds to binary32 first, as torch does for the 16-bit types.
fn through_single(dtype: Dtype, of: f64) -> u64 {
    let of = if dtype == Dtype::F64 { of } else { value(Dtype::F32, nearest(Dtype::F32, of)) };
    nearest(dtype, of)
}

#[test]
fn planned_tensors_are_streamed_as_computed_at_once() {
    let mut random = Draw::new(7);
    for round in 0..FEW * 10 {
        let case = case(&mut random);
        let Case { bytes, from, tensor, .. } = &case;
        let scale = case.scale;
        let mut read = |_: &TensorRef, at: u64, buffer: &mut [u8]| {
            let at = usize::try_from(at).unwrap();
            buffer.copy_from_slice(&bytes[at..][..buffer.len()]);
            Ok(())
        };
        let mut out = Vec::new();
        let facts = transform::write(&mut read, tensor, &mut out).unwrap();
        assert_eq!(Some(out.len() as u64), byte_len(tensor.dtype, &tensor.shape), "{round}: {tensor:?}");
        let width = usize::try_from(tensor.dtype.bits() / 8).unwrap();
        let got = out.chunks(width).map(|c| c.iter().rev().fold(0_u64, |n, b| n << 8 | u64::from(*b)));
        let copies = from.dtype == tensor.dtype && scale.is_none();
        let (mut want_losses, mut sampled) = (CastLosses::default(), false);
        for (place, (got, donor)) in got.zip(fitted(&case)).enumerate() {
            let Some(donor) = donor else {
                sampled = true;
                continue;
            };
            let before = value(from.dtype, donor) * scale.unwrap_or(1.0);
            let what = format!("{round}: value {place} of {tensor:?}: {before:e} became {got:#x}");
            if before.is_nan() {
                assert!(value(tensor.dtype, got).is_nan(), "{what}");
            } else if copies {
                assert_eq!(got, donor, "{what}");
            } else {
                assert_eq!(got, through_single(tensor.dtype, before), "{what}");
            }
            let after = value(tensor.dtype, got);
            if !copies {
                let source = value(from.dtype, donor);
                want_losses.nan += u64::from(source.is_nan());
                want_losses.overflow += u64::from(source.is_finite() && after.is_infinite());
                want_losses.underflow += u64::from(source != 0.0 && after == 0.0);
            }
        }
        if !sampled {
            assert_eq!(facts.losses, want_losses, "{round}: {tensor:?}");
        }
    }
}

/// Whatever the types and shapes of a matrix and of two factors, their sum and product is what a loop over all values gives.
#[test]
fn products_are_added_as_computed_at_once() {
    let mut random = Draw::new(11);
    for round in 0..FEW * 2 {
        let (dtype, of) = (TYPES[random.below(3)], TYPES[random.below(4)]);
        // Some rows are longer than the columns that are summed at a time.
        let long = if round % 10 == 0 { 1500 } else { 12 };
        let [rows, inner, columns] = [1 + random.below(4), 1 + random.below(9), 1 + random.below(long)];
        let mut numbers = |count: usize, dtype: Dtype| -> Vec<u64> {
            (0..count).map(|_| nearest(dtype, random.below(4001) as f64 / 1000.0 - 2.0)).collect()
        };
        let (base, left, right) =
            (numbers(rows * columns, dtype), numbers(rows * inner, of), numbers(inner * columns, of));
        let (is_left_turned, is_right_turned) = (round % 2 == 1, round % 3 == 1);
        let scale = [1.0, 0.5, 1.0 / 3.0, 0.0][random.below(4)];
        let rounded = random.below(2) == 1;
        let turned = |values: &[u64], [rows, columns]: [usize; 2]| -> Vec<u64> {
            (0..columns).flat_map(|column| (0..rows).map(move |row| values[row * columns + column])).collect()
        };
        let factor = |path: &str, values: &[u64], [rows, columns]: [usize; 2], is_turned: bool| {
            let stored = if is_turned { turned(values, [rows, columns]) } else { values.to_vec() };
            let shape = if is_turned { vec![columns as u64, rows as u64] } else { vec![rows as u64, columns as u64] };
            let from = donor(path, of, shape);
            (stored, if is_turned { Factor::Transposed(from) } else { Factor::Stored(from) })
        };
        let (left_stored, left_factor) = factor("left", &left, [rows, inner], is_left_turned);
        let (right_stored, right_factor) = factor("right", &right, [inner, columns], is_right_turned);
        let to = Box::new(TensorExpr::Stored(donor("base", dtype, vec![rows as u64, columns as u64])));
        let product = Product { left: left_factor, right: right_factor, scale, rounded };
        let tensor = PlannedTensor::new("x".to_owned(), TensorExpr::AddProduct { to, product }).unwrap();
        let encoded = |dtype: Dtype, values: &[u64]| -> Vec<u8> {
            let width = usize::try_from(dtype.bits() / 8).unwrap();
            values.iter().flat_map(|bits| bits.to_le_bytes()[..width].to_vec()).collect()
        };
        let files = [
            ("base", encoded(dtype, &base)),
            ("left", encoded(of, &left_stored)),
            ("right", encoded(of, &right_stored)),
        ];
        let mut read = |from: &TensorRef, at: u64, buffer: &mut [u8]| {
            let (_, bytes) = files.iter().find(|(name, _)| from.path.to_str() == Some(name)).unwrap();
            let at = usize::try_from(at).unwrap();
            buffer.copy_from_slice(&bytes[at..][..buffer.len()]);
            Ok(())
        };
        let mut out = Vec::new();
        let facts = transform::write(&mut read, &tensor, &mut out).unwrap();
        assert_eq!(facts.losses, CastLosses::default(), "{round}");
        let single = |of: f64| value(Dtype::F32, nearest(Dtype::F32, of));
        let mut want = Vec::new();
        for (place, base) in base.iter().enumerate() {
            let (row, column) = (place / columns, place % columns);
            let term =
                |k: usize| single(value(of, left[row * inner + k])) * single(value(of, right[k * columns + column]));
            let sum = (0..inner).fold(0.0, |sum, k| sum + term(k));
            let delta = single(single(sum) * single(scale));
            let delta = if rounded { value(dtype, nearest(dtype, delta)) } else { delta };
            want.push(through_single(dtype, value(dtype, *base) + delta));
        }
        assert!(out == encoded(dtype, &want), "{round}: {tensor:?}");
    }
}
