//! The bit patterns of each element type: which are NaN, infinite, zero or denormal, which number each one is, and how they
//! are ordered.

#![allow(
    clippy::cast_precision_loss,
    clippy::inline_always,
    clippy::verbose_bit_mask,
    reason = "a function that is not inlined is compiled for the oldest processors, masks are compared in vectors, and sums of large integers are not exact"
)]

use std::ops::{BitAnd, BitOr, BitXor};

/// A little-endian word of `N` bytes: the bits of one element.
pub(super) trait Word<const N: usize>:
    Copy + Eq + BitAnd<Output = Self> + BitOr<Output = Self> + BitXor<Output = Self> + Into<u64>
{
    /// The word of zeros.
    const ZERO: Self;
    /// Counts the elements of a block. As narrow as the word where that is wide enough, so that vectors hold many counters.
    type Count: Copy + Default + Into<u64>;
    /// A signed integer of the same width: every processor has vectors for its minimum and maximum.
    type Key: Copy + Ord;
    const FIRST_KEY: Self::Key;
    const LAST_KEY: Self::Key;

    fn read(bytes: [u8; N]) -> Self;

    /// Adds 1 to the counter of a block if the condition holds.
    fn plus(count: Self::Count, condition: bool) -> Self::Count;
}

macro_rules! words {
    ($($word:ident, $key:ident, $count:ident, $width:literal;)*) => { $(
        impl Word<$width> for $word {
            const ZERO: Self = 0;
            type Count = $count;
            type Key = $key;
            const FIRST_KEY: $key = $key::MIN;
            const LAST_KEY: $key = $key::MAX;

            #[inline(always)]
            fn read(bytes: [u8; $width]) -> Self {
                Self::from_le_bytes(bytes)
            }

            #[inline(always)]
            fn plus(count: $count, condition: bool) -> $count {
                count.wrapping_add($count::from(condition))
            }
        }
    )* };
}

words! {
    u8, i8, u16, 1;
    u16, i16, u16, 2;
    u32, i32, u32, 4;
    u64, i64, u64, 8;
}

/// Widths in bits, and the bias, of a float of at most eight bits.
#[derive(Clone, Copy)]
pub(super) struct Small {
    pub(super) exponent: u32,
    pub(super) fraction: u32,
    pub(super) bias: u32,
}

/// An element type whose elements have `N` bytes.
pub(super) trait Format<const N: usize> {
    type Word: Word<N>;

    /// A float that has all its numbers.
    type Number: Copy + Default + Into<f64>;

    /// Whether the square of every number fits into 53 bits.
    const SQUARES_ARE_EXACT: bool = N <= 2;

    /// The layout of a float of at most eight bits; `N` is 1.
    const SMALL: Option<Small> = None;

    /// Whether the element is NaN or infinite.
    #[inline(always)]
    fn special(_: Self::Word) -> bool {
        false
    }

    /// Whether a special element is infinite.
    #[inline(always)]
    fn infinite(_: Self::Word) -> bool {
        false
    }

    #[inline(always)]
    fn zero(word: Self::Word) -> bool {
        word == Self::Word::ZERO
    }

    /// Whether the element is nonzero and below the smallest normal number.
    #[inline(always)]
    fn denormal(_: Self::Word) -> bool {
        false
    }

    /// The number, of an element that is not special. Exact, except for integers of 64 bits.
    fn number(word: Self::Word) -> Self::Number;

    /// An integer that is ordered as the number is, of an element that is not special. That of -0 is below that of 0.
    fn key(word: Self::Word) -> <Self::Word as Word<N>>::Key;

    /// The element with this key.
    fn with_key(key: <Self::Word as Word<N>>::Key) -> Self::Word;
}

/// Flips the magnitude of negative numbers: makes a key of a sign and a magnitude, and these of a key.
macro_rules! flipped {
    ($bits:expr, $key:ident) => {{
        let bits: $key = $bits;
        bits ^ ((bits >> ($key::BITS - 1)) & $key::MAX)
    }};
}

/// Formats of IEEE 754 layout: all exponent bits are set in NaN, whose fraction is nonzero, and in infinity.
macro_rules! ieee {
    ($($format:ident, $word:ident, $key:ident, $width:literal, $magnitude:literal, $exponent:literal, $small:expr, $number:ident, $convert:expr;)*) => { $(
        pub(super) struct $format;

        impl Format<$width> for $format {
            type Word = $word;
            type Number = $number;
            const SQUARES_ARE_EXACT: bool = $width <= 4;
            const SMALL: Option<Small> = $small;

            #[inline(always)]
            fn special(word: $word) -> bool {
                word & $exponent == $exponent
            }

            #[inline(always)]
            fn infinite(word: $word) -> bool {
                word & $magnitude == $exponent
            }

            #[inline(always)]
            fn zero(word: $word) -> bool {
                word & $magnitude == 0
            }

            #[inline(always)]
            fn denormal(word: $word) -> bool {
                let smallest: $word = $exponent & (!$exponent + 1);
                (word & $magnitude).wrapping_sub(1) < smallest.wrapping_sub(1)
            }

            #[inline(always)]
            fn number(word: $word) -> $number {
                $convert(word)
            }

            #[inline(always)]
            fn key(word: $word) -> $key {
                flipped!(word.cast_signed(), $key)
            }

            #[inline(always)]
            fn with_key(key: $key) -> $word {
                flipped!(key, $key).cast_unsigned()
            }
        }
    )* };
}

ieee! {
    F64, u64, i64, 8, 0x7fff_ffff_ffff_ffff, 0x7ff0_0000_0000_0000, None, f64, f64::from_bits;
    F32, u32, i32, 4, 0x7fff_ffff, 0x7f80_0000, None, f32, f32::from_bits;
    Bf16, u16, i16, 2, 0x7fff, 0x7f80, None, f32, |word: u16| f32::from_bits(u32::from(word) << 16);
    F16, u16, i16, 2, 0x7fff, 0x7c00, None, f32, |word: u16| widened::<5, 10, 15>(word.into());
    F8E5M2, u8, i8, 1, 0x7f, 0x7c, Some(Small { exponent: 5, fraction: 2, bias: 15 }), f32, |word: u8| widened::<5, 2, 15>(word.into());
}

/// The number of a code with a sign, an exponent and a fraction, of these many bits. Exact, and without denormal operands,
/// which some processors multiply slowly.
#[inline(always)]
fn widened<const EXPONENT: u32, const FRACTION: u32, const BIAS: u32>(code: u32) -> f32 {
    let width = const { EXPONENT.wrapping_add(FRACTION) };
    let magnitude = code & const { (1_u32 << EXPONENT.wrapping_add(FRACTION)).wrapping_sub(1) };
    let exponent = |biased: u32| biased.wrapping_sub(BIAS) << 23;
    let normal = f32::from_bits((magnitude << 23_u32.wrapping_sub(FRACTION)).wrapping_add(exponent(127)));
    // With an exponent of zero, this is 2^-BIAS * (1 + fraction), and the number is 2^(1 - BIAS) * fraction. With any other
    // exponent, the same calculation never makes a number smaller.
    let denormal = normal + (normal - f32::from_bits(exponent(128)));
    let number = if denormal < normal { denormal } else { normal };
    let sign = code << 31_u32.wrapping_sub(width) & (1 << 31);
    f32::from_bits(number.to_bits() | sign)
}

/// Formats of at most eight bits without infinity: at most one magnitude, or one pattern, is NaN.
macro_rules! small {
    ($($format:ident, $exponent:literal, $fraction:literal, $bias:literal, $special:expr, $zero:expr;)*) => { $(
        pub(super) struct $format;

        impl Format<1> for $format {
            type Word = u8;
            type Number = f32;
            const SMALL: Option<Small> = Some(Small { exponent: $exponent, fraction: $fraction, bias: $bias });

            #[inline(always)]
            fn special(word: u8) -> bool {
                $special(word)
            }

            #[inline(always)]
            fn zero(word: u8) -> bool {
                $zero(word)
            }

            #[inline(always)]
            fn denormal(word: u8) -> bool {
                let magnitude = word & (0xff_u8 >> (8 - ($exponent + $fraction)));
                magnitude.wrapping_sub(1) < (1_u8 << $fraction).wrapping_sub(1)
            }

            #[inline(always)]
            fn number(word: u8) -> f32 {
                widened::<$exponent, $fraction, $bias>(word.into())
            }

            #[inline(always)]
            fn key(word: u8) -> i8 {
                // The sign becomes the highest bit.
                flipped!((word << (7 - $exponent - $fraction)).cast_signed(), i8)
            }

            #[inline(always)]
            fn with_key(key: i8) -> u8 {
                flipped!(key, i8).cast_unsigned() >> (7 - $exponent - $fraction)
            }
        }
    )* };
}

// Sources: OCP 8-bit floating point specification; OCP microscaling formats; ml_dtypes for the FNUZ variants, whose only NaN
// has the bits of minus zero.
small! {
    F8E4M3, 4, 3, 7, |word: u8| word & 0x7f == 0x7f, |word: u8| word & 0x7f == 0;
    F8E4M3Fnuz, 4, 3, 8, |word: u8| word == 0x80, |word: u8| word == 0;
    F8E5M2Fnuz, 5, 2, 16, |word: u8| word == 0x80, |word: u8| word == 0;
    F6E2M3, 2, 3, 1, |_| false, |word: u8| word & 0x1f == 0;
    F6E3M2, 3, 2, 3, |_| false, |word: u8| word & 0x1f == 0;
    F4, 2, 1, 1, |_| false, |word: u8| word & 7 == 0;
}

/// Powers of two from 2^-127 on: no sign, no zero, no denormals.
pub(super) struct F8E8M0;

impl Format<1> for F8E8M0 {
    type Word = u8;
    type Number = f64;

    #[inline(always)]
    fn special(word: u8) -> bool {
        word == 0xff
    }

    #[inline(always)]
    fn zero(_: u8) -> bool {
        false
    }

    #[inline(always)]
    fn number(word: u8) -> f64 {
        f64::from_bits(u64::from(word).wrapping_add(1023 - 127) << 52)
    }

    #[inline(always)]
    fn key(word: u8) -> i8 {
        U8::key(word)
    }

    #[inline(always)]
    fn with_key(key: i8) -> u8 {
        U8::with_key(key)
    }
}

/// Integers and truth values. The key of an unsigned one has the highest bit flipped.
macro_rules! integers {
    ($($format:ident, $word:ident, $key:ident, $width:literal, $flip:expr, $number:ident, $convert:expr;)*) => { $(
        pub(super) struct $format;

        impl Format<$width> for $format {
            type Word = $word;
            type Number = $number;

            #[inline(always)]
            fn number(word: $word) -> $number {
                $convert(word)
            }

            #[inline(always)]
            fn key(word: $word) -> $key {
                word.cast_signed() ^ $flip
            }

            #[inline(always)]
            fn with_key(key: $key) -> $word {
                (key ^ $flip).cast_unsigned()
            }
        }
    )* };
}

integers! {
    U8, u8, i8, 1, i8::MIN, f32, f32::from;
    I8, u8, i8, 1, 0, f32, |word: u8| f32::from(word.cast_signed());
    U16, u16, i16, 2, i16::MIN, f32, f32::from;
    I16, u16, i16, 2, 0, f32, |word: u16| f32::from(word.cast_signed());
    U32, u32, i32, 4, i32::MIN, f64, f64::from;
    I32, u32, i32, 4, 0, f64, |word: u32| f64::from(word.cast_signed());
    U64, u64, i64, 8, i64::MIN, f64, |word: u64| word as f64;
    I64, u64, i64, 8, 0, f64, |word: u64| word.cast_signed() as f64;
}

/// Takes elements of four bits apart, low half first.
#[inline(always)]
pub(super) fn unpack4(bytes: &[u8], codes: &mut Vec<u8>) {
    codes.resize(bytes.len().saturating_mul(2), 0);
    for (pair, byte) in codes.as_chunks_mut().0.iter_mut().zip(bytes) {
        *pair = [byte & 0xf, byte >> 4];
    }
}

/// Takes elements of six bits apart, from the lowest bit on: four in three bytes.
#[inline(always)]
pub(super) fn unpack6(bytes: &[u8], codes: &mut Vec<u8>) {
    let (triples, _) = bytes.as_chunks();
    codes.resize(triples.len().saturating_mul(4), 0);
    for (four, [one, two, three]) in codes.as_chunks_mut().0.iter_mut().zip(triples) {
        let bits = u32::from_le_bytes([*one, *two, *three, 0]);
        let apart = bits & 0x3f | bits << 2 & 0x3f00 | bits << 4 & 0x003f_0000 | bits << 6 & 0x3f00_0000;
        *four = apart.to_le_bytes();
    }
}
