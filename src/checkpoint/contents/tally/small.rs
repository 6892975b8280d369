//! Sums of floats of at most eight bits, in integers.
//!
//! Eight adjacent exponents are a class: the numbers of one class are multiples of its unit, and the multiples fit into 16
//! bits. In `F8_E4M3`, all numbers below 2 are of one class, as are most weights that were converted without a scale. Sums of
//! one class are exact in integers and in 64-bit floats, so both have the same bits.

use super::super::formats::Small;

/// Codes whose sums are kept in 32 bits: the square of a multiple is at most 1920².
const RUN: usize = 1024;

/// The class of the first elements of a block, if they are of one: most likely that of all.
#[inline(always)]
pub(super) fn class_of_first(layout: Small, codes: &[u8]) -> Option<u32> {
    let first = codes.iter().take(64);
    let (any, all) = first.fold((0, 0xff), |(any, all), code| (any | code, all & code));
    class(layout, any.into(), all.into())
}

/// The class of all elements of a block, from the bits that any and that all of them have; `None` for more than one.
#[inline(always)]
pub(super) fn class(layout: Small, any: u64, all: u64) -> Option<u32> {
    let class = |bits: u64| (bits & u64::from(magnitudes(layout))).wrapping_shr(layout.fraction.wrapping_add(3));
    u32::try_from(class(any)).ok().filter(|_| class(any) == class(all))
}

/// The bits without the sign.
#[inline(always)]
const fn magnitudes(layout: Small) -> u8 {
    0xff_u8.wrapping_shr(8_u32.wrapping_sub(layout.exponent).wrapping_sub(layout.fraction))
}

/// The sum of the numbers of a block, and of their squares. All must be finite and of this class. Called for each block.
#[inline(always)]
pub(super) fn added(codes: &[u8], layout: Small, class: u32) -> (f64, f64) {
    let (mut sum, mut squares) = (0_i64, 0_i64);
    let mut parts = [0; RUN];
    for run in codes.chunks(RUN) {
        let Some(parts) = parts.get_mut(..run.len()) else { continue };
        for (part, code) in parts.iter_mut().zip(run) {
            *part = multiple(*code, layout);
        }
        // Two loops, so that the compiler uses the instruction that adds products of pairs in the second one.
        let (mut all, mut products) = (0_i32, 0_i32);
        for part in &*parts {
            all = all.wrapping_add(i32::from(*part));
        }
        for part in &*parts {
            products = products.wrapping_add(i32::from(*part).wrapping_mul(i32::from(*part)));
        }
        sum = sum.wrapping_add(all.into());
        squares = squares.wrapping_add(products.cast_unsigned().into());
    }
    let exponent = class.wrapping_mul(8).wrapping_add(1023).wrapping_sub(layout.bias).wrapping_sub(layout.fraction);
    let unit = f64::from_bits(u64::from(exponent) << 52);
    (as_f64(sum) * unit, as_f64(squares) * unit * unit)
}

/// The number of a code, in units of its class.
#[inline(always)]
fn multiple(code: u8, layout: Small) -> i16 {
    let magnitude = code & magnitudes(layout);
    let hidden = 1_u8.wrapping_shl(layout.fraction);
    // A denormal number, which has no hidden bit, is below the number with it.
    let significand = magnitude.min(magnitude & hidden.wrapping_sub(1) | hidden);
    let exponent = magnitude.wrapping_shr(layout.fraction).max(1);
    let multiple = i16::from(significand).wrapping_shl((exponent & 7).into());
    if code > magnitude { multiple.wrapping_neg() } else { multiple }
}

#[expect(clippy::cast_precision_loss, reason = "sums of a block are below 2^53")]
const fn as_f64(n: i64) -> f64 {
    n as f64
}
