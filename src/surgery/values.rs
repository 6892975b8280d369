//! Decodes and encodes blocks of floating-point values.
//!
//! A value passes through binary32 on its way to and from the 16-bit types, as in torch, so that a block is equal to the
//! result of `tensor.to(dtype)` there: round to nearest, ties to even; what is too large becomes infinite, and subnormal
//! numbers are kept. Source: the constructors of `c10::Half` and `c10::BFloat16` take a `float`.

use half::f16;
use half::slice::HalfFloatSliceExt;

use crate::checkpoint::Dtype;

/// Whether values of `dtype` can be computed, not only copied.
#[must_use]
pub const fn can_compute(dtype: Dtype) -> bool {
    matches!(dtype, Dtype::F16 | Dtype::BF16 | Dtype::F32 | Dtype::F64)
}

/// A number rounded to a type for which [`can_compute`] holds.
#[must_use]
pub fn round(dtype: Dtype, number: f64) -> f64 {
    let (mut codec, mut bytes) = (Codec::default(), Vec::new());
    codec.encode_values(dtype, &[number], &mut bytes);
    codec.decode(dtype, &bytes).first().copied().unwrap_or(number)
}

/// Infinities, zeros and NaNs of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Census {
    pub(super) infinite: u64,
    pub(super) zero: u64,
    pub(super) nan: u64,
}

impl Census {
    /// The census of encoded values.
    pub(super) fn of_bytes(dtype: Dtype, bytes: &[u8]) -> Self {
        let half = |c: &[u8; 2]| u32::from(u16::from_le_bytes(*c) & 0x7FFF);
        match dtype {
            Dtype::F16 => Self::of_magnitudes(bytes.as_chunks().0.iter().map(half), 0x7C00),
            Dtype::BF16 => Self::of_magnitudes(bytes.as_chunks().0.iter().map(half), 0x7F80),
            Dtype::F32 => {
                let single = |c: &[u8; 4]| u32::from_le_bytes(*c) & 0x7FFF_FFFF;
                Self::of_magnitudes(bytes.as_chunks().0.iter().map(single), 0x7F80_0000)
            }
            _ => Self::of_values(bytes.as_chunks().0.iter().map(|c| f64::from_le_bytes(*c))),
        }
    }

    /// The census of the bits of values without their signs. Plain sums, so that the compiler vectorises the loop; a block
    /// has fewer than 2^32 values.
    fn of_magnitudes(magnitudes: impl Iterator<Item = u32>, infinity: u32) -> Self {
        let (mut infinite, mut zero, mut nan) = (0_u32, 0_u32, 0_u32);
        for magnitude in magnitudes {
            infinite = infinite.wrapping_add(u32::from(magnitude == infinity));
            zero = zero.wrapping_add(u32::from(magnitude == 0));
            nan = nan.wrapping_add(u32::from(magnitude > infinity));
        }
        Self { infinite: infinite.into(), zero: zero.into(), nan: nan.into() }
    }

    fn of_values(values: impl Iterator<Item = f64>) -> Self {
        values.fold(Self::default(), |census, value| Self {
            infinite: census.infinite.wrapping_add(u64::from(value.is_infinite())),
            zero: census.zero.wrapping_add(u64::from(value == 0.0)),
            nan: census.nan.wrapping_add(u64::from(value.is_nan())),
        })
    }
}

/// Buffers for the conversion of blocks; they grow to the largest block.
#[derive(Default)]
pub(super) struct Codec {
    f16: Vec<f16>,
    f32: Vec<f32>,
    f64: Vec<f64>,
}

impl Codec {
    /// Decodes whole elements into [`Self::values`]; a partial element at the end is ignored.
    pub(super) fn decode(&mut self, dtype: Dtype, bytes: &[u8]) -> &mut Vec<f64> {
        self.f64.clear();
        if dtype == Dtype::F64 {
            self.f64.extend(bytes.as_chunks::<8>().0.iter().map(|c| f64::from_le_bytes(*c)));
        } else {
            self.decode_f32(dtype, bytes);
            self.f64.extend(self.f32.iter().map(|v| f64::from(*v)));
        }
        &mut self.f64
    }

    /// Appends the values of the last [`Self::decode`] to `out`.
    pub(super) fn encode(&mut self, dtype: Dtype, out: &mut Vec<u8>) {
        let values = std::mem::take(&mut self.f64);
        self.encode_values(dtype, &values, out);
        self.f64 = values;
    }

    /// Appends the encoded values to `out`.
    pub(super) fn encode_values(&mut self, dtype: Dtype, values: &[f64], out: &mut Vec<u8>) {
        if dtype == Dtype::F64 {
            out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
            return;
        }
        self.f32.clear();
        #[expect(clippy::cast_possible_truncation, reason = "rounding to the type of the tensor is the purpose")]
        self.f32.extend(values.iter().map(|v| *v as f32));
        self.encode_f32(dtype, out);
    }

    /// Decodes whole elements of a type of at most 32 bits.
    pub(super) fn singles(&mut self, dtype: Dtype, bytes: &[u8]) -> &mut Vec<f32> {
        self.decode_f32(dtype, bytes);
        &mut self.f32
    }

    /// Appends the values of the last [`Self::singles`] to `out`, as a type of at most 32 bits.
    pub(super) fn encode_singles(&mut self, dtype: Dtype, out: &mut Vec<u8>) {
        self.encode_f32(dtype, out);
    }

    /// Rounds values to a type of at most 32 bits.
    pub(super) fn round(&mut self, dtype: Dtype, values: &mut Vec<f32>) {
        let mut bytes = Vec::new();
        std::mem::swap(&mut self.f32, values);
        self.encode_f32(dtype, &mut bytes);
        self.decode_f32(dtype, &bytes);
        std::mem::swap(&mut self.f32, values);
    }

    /// Converts between two types of at most 32 bits.
    pub(super) fn cast(&mut self, from: Dtype, to: Dtype, bytes: &[u8], out: &mut Vec<u8>) {
        self.decode_f32(from, bytes);
        self.encode_f32(to, out);
    }

    fn decode_f32(&mut self, dtype: Dtype, bytes: &[u8]) {
        self.f32.clear();
        match dtype {
            Dtype::F16 => {
                self.f16.clear();
                self.f16.extend(bytes.as_chunks::<2>().0.iter().map(|c| f16::from_le_bytes(*c)));
                self.f32.resize(self.f16.len(), 0.0);
                self.f16.convert_to_f32_slice(&mut self.f32);
            }
            Dtype::BF16 => {
                let widen = |c: &[u8; 2]| f32::from_bits(u32::from(u16::from_le_bytes(*c)) << 16);
                self.f32.extend(bytes.as_chunks::<2>().0.iter().map(widen));
            }
            _ => self.f32.extend(bytes.as_chunks::<4>().0.iter().map(|c| f32::from_le_bytes(*c))),
        }
    }

    fn encode_f32(&mut self, dtype: Dtype, out: &mut Vec<u8>) {
        let start = out.len();
        match dtype {
            Dtype::F16 => {
                self.f16.clear();
                self.f16.resize(self.f32.len(), f16::ZERO);
                self.f16.convert_from_f32_slice(&self.f32);
                out.resize(start.saturating_add(self.f16.len().saturating_mul(2)), 0);
                let place = out.get_mut(start..).unwrap_or_default();
                for (to, v) in place.as_chunks_mut::<2>().0.iter_mut().zip(&self.f16) {
                    *to = v.to_le_bytes();
                }
            }
            Dtype::BF16 => {
                out.resize(start.saturating_add(self.f32.len().saturating_mul(2)), 0);
                let place = out.get_mut(start..).unwrap_or_default();
                for (to, v) in place.as_chunks_mut::<2>().0.iter_mut().zip(&self.f32) {
                    *to = narrow(*v).to_le_bytes();
                }
            }
            _ => {
                out.resize(start.saturating_add(self.f32.len().saturating_mul(4)), 0);
                let place = out.get_mut(start..).unwrap_or_default();
                for (to, v) in place.as_chunks_mut::<4>().0.iter_mut().zip(&self.f32) {
                    *to = v.to_le_bytes();
                }
            }
        }
    }
}

/// The bits of a binary32 value rounded to bfloat16; NaN keeps its sign and becomes quiet.
///
/// Without branches, so that the compiler vectorises loops over it. Source: `round_to_nearest_even` in c10's `BFloat16.h`.
const fn narrow(value: f32) -> u16 {
    let bits = value.to_bits();
    // An addition of at most 0x8000 to a finite number or an infinity does not overflow.
    let rounded = bits.wrapping_add(0x7FFF).wrapping_add((bits >> 16) & 1) >> 16;
    let quiet = (bits >> 16) | 0x40;
    let half = if value.is_nan() { quiet } else { rounded };
    #[expect(clippy::cast_possible_truncation, reason = "shifted to 16 bits")]
    let half = half as u16;
    half
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cast(from: Dtype, to: Dtype, bytes: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        Codec::default().cast(from, to, bytes, &mut out);
        out
    }

    /// The value of 16 bits of a type, in binary64.
    fn wide(dtype: Dtype, bits: u16) -> f64 {
        let mut codec = Codec::default();
        codec.decode(dtype, &bits.to_le_bytes())[0]
    }

    #[test]
    fn every_16_bit_value_survives_binary32_and_back() {
        for dtype in [Dtype::F16, Dtype::BF16] {
            for bits in 0..=u16::MAX {
                let narrow = bits.to_le_bytes();
                let back = cast(Dtype::F32, dtype, &cast(dtype, Dtype::F32, &narrow));
                if wide(dtype, bits).is_nan() {
                    assert!(wide(dtype, u16::from_le_bytes([back[0], back[1]])).is_nan(), "{dtype} {bits:#x}");
                } else {
                    assert_eq!(back, narrow, "{dtype} {bits:#x}");
                }
            }
        }
    }

    /// The tie between two neighbours rounds to the even one, and the next binary32 values to the nearer ones.
    #[test]
    fn ties_round_to_even() {
        let single = |dtype: Dtype, bits: u16| {
            let wide = cast(dtype, Dtype::F32, &bits.to_le_bytes());
            f32::from_le_bytes(wide.try_into().unwrap())
        };
        let round = |dtype: Dtype, value: f32| {
            let narrow = cast(Dtype::F32, dtype, &value.to_le_bytes());
            u16::from_le_bytes(narrow.try_into().unwrap())
        };
        for (dtype, largest) in [(Dtype::F16, 0x7BFF), (Dtype::BF16, 0x7F7F)] {
            for bits in 0..largest {
                let tie = f32::midpoint(single(dtype, bits), single(dtype, bits + 1));
                assert_eq!(round(dtype, tie), bits + bits % 2, "{dtype} {tie:e}");
                assert_eq!(round(dtype, tie.next_down()), bits, "{dtype} below {tie:e}");
                assert_eq!(round(dtype, tie.next_up()), bits + 1, "{dtype} above {tie:e}");
                assert_eq!(round(dtype, -tie), 0x8000 | (bits + bits % 2), "{dtype} -{tie:e}");
            }
        }
        assert_eq!(round(Dtype::F16, 65520_f32.next_down()), 0x7BFF);
        assert_eq!(round(Dtype::F16, 65520.0), 0x7C00);
        assert_eq!(round(Dtype::BF16, f32::MAX), 0x7F80);
    }

    #[test]
    fn a_census_counts_what_is_stored() {
        let values = [0.0, -0.0, 1.0, f32::INFINITY, f32::NEG_INFINITY, f32::NAN, -f32::NAN, 1e-45, f32::MAX];
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let want = |infinite, zero| Census { infinite, zero, nan: 2 };
        assert_eq!(Census::of_bytes(Dtype::F32, &bytes), want(2, 2));
        assert_eq!(Census::of_values(values.iter().map(|v| f64::from(*v))), want(2, 2));
        for dtype in [Dtype::F16, Dtype::BF16] {
            assert_eq!(Census::of_bytes(dtype, &cast(Dtype::F32, dtype, &bytes)), want(3, 3), "{dtype}");
        }
        let wide: Vec<u8> = values.iter().flat_map(|v| f64::from(*v).to_le_bytes()).collect();
        assert_eq!(Census::of_bytes(Dtype::F64, &wide), want(2, 2));
    }
}
