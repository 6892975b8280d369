//! Counts NaN and infinite elements, by the bit patterns of each dtype.

use super::super::{Dtype, Fault, FaultKind, Place, Shard, Tensor};

/// Elements that are searched at a time.
const BLOCK: usize = 4096;

/// Counts for one tensor.
pub(super) struct NonFiniteCounter {
    dtype: Dtype,
    nan: u64,
    infinite: u64,
    /// Position of the first such element.
    first: Option<u64>,
    seen: u64,
}

impl NonFiniteCounter {
    pub(super) fn new(dtype: Dtype) -> Self {
        Self { dtype, nan: 0, infinite: 0, first: None, seen: 0 }
    }

    /// Counts the elements in `bytes`, which must start and end on an element.
    pub(super) fn add(&mut self, bytes: &[u8]) {
        match self.dtype {
            Dtype::BF16 => self.wide(bytes, 0x7f80, |b| u16::from_le_bytes(b).into()),
            Dtype::F16 => self.wide(bytes, 0x7c00, |b| u16::from_le_bytes(b).into()),
            Dtype::F32 | Dtype::C64 => self.wide(bytes, 0x7f80_0000, |b| u32::from_le_bytes(b).into()),
            Dtype::F64 => self.wide(bytes, 0x7ff0_0000_0000_0000, u64::from_le_bytes),
            Dtype::F8_E5M2 => self.wide(bytes, 0x7c, |[b]: [u8; 1]| b.into()),
            // These dtypes have no infinity, and one or two patterns for NaN. Source: OCP 8-bit floating point
            // specification; ml_dtypes for the FNUZ variants.
            Dtype::F8_E4M3 => self.narrow(bytes, |b| b & 0x7f == 0x7f),
            Dtype::F8_E4M3FNUZ | Dtype::F8_E5M2FNUZ => self.narrow(bytes, |b| b == 0x80),
            Dtype::F8_E8M0 => self.narrow(bytes, |b| b == 0xff),
            _ => {}
        }
    }

    /// Counts the elements of `len` bytes that are zeros.
    pub(super) fn skip(&mut self, len: u64) {
        let width: u64 = match self.dtype {
            Dtype::BF16 | Dtype::F16 => 2,
            Dtype::F32 | Dtype::C64 => 4,
            Dtype::F64 => 8,
            _ => 1,
        };
        self.seen = self.seen.saturating_add(len.checked_div(width).unwrap_or(0));
    }

    /// IEEE formats: all exponent bits are set; the fraction is zero for infinity and nonzero for NaN.
    fn wide<const N: usize>(&mut self, bytes: &[u8], exponent: u64, bits: impl Fn([u8; N]) -> u64) {
        let (elements, _) = bytes.as_chunks::<N>();
        let special = |element: &[u8; N]| bits(*element) & exponent == exponent;
        let fraction = (exponent & exponent.wrapping_neg()).wrapping_sub(1);
        for (block, start) in elements.chunks(BLOCK).zip((0..).step_by(BLOCK)) {
            // Most blocks have none. The compiler vectorises this loop: it has no early end and counts nothing.
            if !block.iter().fold(false, |found, element| found | special(element)) {
                continue;
            }
            for (number, element) in (start..).zip(block).filter(|(_, element)| special(element)) {
                self.count(number, bits(*element) & fraction == 0);
            }
        }
        self.seen = self.seen.saturating_add(as_u64(elements.len()));
    }

    fn narrow(&mut self, bytes: &[u8], is_nan: impl Fn(u8) -> bool) {
        for (number, _) in bytes.iter().enumerate().filter(|(_, b)| is_nan(**b)) {
            self.count(number, false);
        }
        self.seen = self.seen.saturating_add(as_u64(bytes.len()));
    }

    fn count(&mut self, number: usize, infinite: bool) {
        let counter = if infinite { &mut self.infinite } else { &mut self.nan };
        *counter = counter.saturating_add(1);
        self.first.get_or_insert(self.seen.saturating_add(as_u64(number)));
    }

    pub(super) fn fault(&self, shard: &Shard, tensor: &Tensor) -> Option<Fault> {
        let first = self.first?;
        let place = Place::file(&*shard.name).in_tensor(&*tensor.name);
        let fault =
            Fault::new(FaultKind::NonFiniteWeights).at(place).with("nan", self.nan).with("infinite", self.infinite);
        Some(fault.with("elements", self.seen).with("first", first))
    }
}

pub(super) fn as_u64(n: usize) -> u64 {
    u64::try_from(n).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(dtype: Dtype, bytes: &[u8]) -> (u64, u64, Option<u64>) {
        let mut numbers = NonFiniteCounter::new(dtype);
        // In two pieces, as a large tensor arrives.
        let (one, two) = bytes.split_at(8);
        numbers.add(one);
        numbers.add(two);
        (numbers.nan, numbers.infinite, numbers.first)
    }

    fn words<const N: usize>(words: [[u8; N]; 4]) -> Vec<u8> {
        let filler = [[0; N]; 8];
        filler.into_iter().chain(words).flatten().collect()
    }

    #[test]
    fn each_type_has_its_own_patterns() {
        let largest_then_special = [
            (Dtype::F32, words([f32::MAX, f32::NAN, f32::INFINITY, f32::NEG_INFINITY].map(f32::to_le_bytes))),
            (Dtype::F64, words([f64::MAX, f64::NAN, f64::INFINITY, f64::NEG_INFINITY].map(f64::to_le_bytes))),
            (Dtype::F16, words([0x7bff_u16, 0x7e00, 0x7c00, 0xfc00].map(u16::to_le_bytes))),
            (Dtype::BF16, words([0x7f7f_u16, 0xffc0, 0x7f80, 0xff80].map(u16::to_le_bytes))),
            (Dtype::F8_E5M2, words([[0x7b_u8], [0x7f], [0x7c], [0xfc]])),
        ];
        for (dtype, bytes) in largest_then_special {
            assert_eq!(counts(dtype, &bytes), (1, 2, Some(9)), "{dtype}");
        }
        assert_eq!(counts(Dtype::F8_E4M3, &words([[0x7e_u8], [0x7f], [0xff], [0xfe]])), (2, 0, Some(9)));
        assert_eq!(counts(Dtype::F8_E4M3FNUZ, &words([[0x7f_u8], [0x80], [0xff], [0]])), (1, 0, Some(9)));
        assert_eq!(counts(Dtype::F8_E8M0, &words([[0xfe_u8], [0xff], [1], [0]])), (1, 0, Some(9)));
        assert_eq!(counts(Dtype::U8, &[0xff; 16]), (0, 0, None));
    }
}
