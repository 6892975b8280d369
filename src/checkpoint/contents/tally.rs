//! Counts the elements of a tensor, and adds up their numbers.
//!
//! The loops have neither early ends nor calls, so that the compiler vectorises them, once for each set of instructions in
//! `targets`; the one that the processor has is chosen at run time. Sums are made in the same order on every processor.

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the oldest processors")]

use multiversion::multiversion;

use super::super::{Dtype, Fault, FaultKind, Place};
use super::formats::{
    Bf16, F4, F6E2M3, F6E3M2, F8E4M3, F8E4M3Fnuz, F8E5M2, F8E5M2Fnuz, F8E8M0, F16, F32, F64, Format, I8, I16, I32, I64,
    Number, U8, U16, U32, U64, Word, unpack4, unpack6,
};

/// Bytes that are counted at a time: they fit into the fastest cache. A multiple of every width of an element, and of the
/// three bytes of four elements of six bits.
pub(super) const BLOCK: usize = 24 << 10;

/// Sums that are kept side by side: enough for a loop over them to be vectorised.
const LANES: usize = 64;

/// What a tensor, or a part of it, contains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::checkpoint) struct Tally {
    dtype: Dtype,
    /// Elements; a complex number counts as two.
    pub(super) elements: u64,
    pub(super) nan: u64,
    pub(super) infinite: u64,
    /// Elements that are 0 or -0.
    pub(super) zeros: u64,
    /// Position of the first element that is NaN or infinite.
    first: Option<u64>,
    /// Bytes, and the end of the last one that is not zero.
    bytes: u64,
    last: u64,
    /// Bits of the first element, and whether another one differs.
    value: Option<u64>,
    pub(super) varies: bool,
    /// The numbers, if they are added up.
    pub(super) sums: Option<Sums>,
}

/// Sums over the elements that are finite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sums {
    pub(super) min: f64,
    pub(super) max: f64,
    pub(super) sum: f64,
    pub(super) squares: f64,
    pub(super) denormals: u64,
}

impl Sums {
    const NONE: Self = Self { min: f64::INFINITY, max: f64::NEG_INFINITY, sum: 0.0, squares: 0.0, denormals: 0 };

    fn add(&mut self, other: &Self) {
        self.min = if other.min < self.min { other.min } else { self.min };
        self.max = if other.max > self.max { other.max } else { self.max };
        self.sum += other.sum;
        self.squares += other.squares;
        self.denormals = self.denormals.saturating_add(other.denormals);
    }
}

impl Tally {
    /// Counts nothing yet; `sums` says whether numbers are added up.
    pub(super) fn new(dtype: Dtype, sums: bool) -> Self {
        let sums = sums.then_some(Sums::NONE);
        let (elements, nan, infinite, zeros, first) = (0, 0, 0, 0, None);
        Self { dtype, elements, nan, infinite, zeros, first, bytes: 0, last: 0, value: None, varies: false, sums }
    }

    /// Counts the elements in `bytes`, which must start and end on an element. Sums are the same for any division of a
    /// tensor that divides it between blocks of [`BLOCK`] bytes.
    pub(super) fn add(&mut self, bytes: &[u8]) {
        piece(self, bytes);
    }

    /// Counts the elements of `len` bytes that are zeros.
    pub(super) fn skip(&mut self, len: u64) {
        let elements = len.saturating_mul(8).checked_div(width(self.dtype)).unwrap_or(0);
        if elements == 0 {
            return;
        }
        let before = (self.elements, self.bytes);
        let few = usize::try_from(len).unwrap_or(24).min(24);
        self.add([0; 24].get(..few).unwrap_or_default());
        // All are the same, so only those behind the first few are added here.
        let more = elements.saturating_sub(self.elements.saturating_sub(before.0));
        if self.dtype != Dtype::F8_E8M0 {
            self.zeros = self.zeros.saturating_add(more);
        } else if let Some(sums) = &mut self.sums {
            let least = F8E8M0::number(0);
            sums.sum += least * as_f64(more);
            sums.squares += least * least * as_f64(more);
        }
        self.elements = before.0.saturating_add(elements);
        self.bytes = before.1.saturating_add(len);
    }

    /// Adds the part that follows this one.
    pub(super) fn then(&mut self, next: &Self) {
        let first = next.first.map(|first| self.elements.saturating_add(first));
        self.first = self.first.or(first);
        self.last = if next.last > 0 { self.bytes.saturating_add(next.last) } else { self.last };
        self.varies |= next.varies || (self.value.is_some() && next.value.is_some() && self.value != next.value);
        self.value = self.value.or(next.value);
        self.bytes = self.bytes.saturating_add(next.bytes);
        self.elements = self.elements.saturating_add(next.elements);
        self.nan = self.nan.saturating_add(next.nan);
        self.infinite = self.infinite.saturating_add(next.infinite);
        self.zeros = self.zeros.saturating_add(next.zeros);
        if let (Some(sums), Some(next)) = (&mut self.sums, &next.sums) {
            sums.add(next);
        }
    }

    /// End of the last byte that is not zero, counted from the start of the tensor; `None` when all are zero.
    pub(super) fn last_value(&self) -> Option<u64> {
        (self.last > 0).then_some(self.last)
    }

    /// Whether every element has the same bits.
    pub(super) const fn is_constant(&self) -> bool {
        self.value.is_some() && !self.varies
    }

    /// The fault of a tensor with elements that are NaN or infinite.
    pub(super) fn fault(&self, shard: &str, tensor: &str) -> Option<Fault> {
        let first = self.first?;
        let place = Place::file(shard).in_tensor(tensor);
        let fault =
            Fault::new(FaultKind::NonFiniteWeights).at(place).with("nan", self.nan).with("infinite", self.infinite);
        Some(fault.with("elements", self.elements).with("first", first))
    }
}

/// Bits of one element, where a complex number is two elements.
const fn width(dtype: Dtype) -> u64 {
    match dtype {
        Dtype::C64 => 32,
        other => other.bits(),
    }
}

#[expect(clippy::cast_precision_loss, reason = "a factor of a sum")]
const fn as_f64(n: u64) -> f64 {
    n as f64
}

pub(super) fn as_u64(n: usize) -> u64 {
    u64::try_from(n).unwrap_or(u64::MAX)
}

#[multiversion(targets(
    "x86_64+avx+avx2+avx512f+avx512bw+avx512cd+avx512dq+avx512vl+bmi1+bmi2+fma+lzcnt+popcnt",
    "x86_64+avx+avx2+bmi1+bmi2+fma+lzcnt+popcnt",
))]
fn piece(tally: &mut Tally, bytes: &[u8]) {
    let mut codes = Vec::new();
    for block in bytes.chunks(BLOCK) {
        let any = match tally.dtype {
            Dtype::BF16 => add::<2, Bf16>(tally, block),
            Dtype::F16 => add::<2, F16>(tally, block),
            Dtype::F32 | Dtype::C64 => add::<4, F32>(tally, block),
            Dtype::F64 => add::<8, F64>(tally, block),
            Dtype::F8_E4M3 => add::<1, F8E4M3>(tally, block),
            Dtype::F8_E5M2 => add::<1, F8E5M2>(tally, block),
            Dtype::F8_E8M0 => add::<1, F8E8M0>(tally, block),
            Dtype::F8_E4M3FNUZ => add::<1, F8E4M3Fnuz>(tally, block),
            Dtype::F8_E5M2FNUZ => add::<1, F8E5M2Fnuz>(tally, block),
            Dtype::U8 | Dtype::BOOL => add::<1, U8>(tally, block),
            Dtype::I8 => add::<1, I8>(tally, block),
            Dtype::U16 => add::<2, U16>(tally, block),
            Dtype::I16 => add::<2, I16>(tally, block),
            Dtype::U32 => add::<4, U32>(tally, block),
            Dtype::I32 => add::<4, I32>(tally, block),
            Dtype::U64 => add::<8, U64>(tally, block),
            Dtype::I64 => add::<8, I64>(tally, block),
            Dtype::F4 => {
                unpack4(block, &mut codes);
                add::<1, F4>(tally, &codes)
            }
            Dtype::F6_E2M3 => {
                unpack6(block, &mut codes);
                add::<1, F6E2M3>(tally, &codes)
            }
            Dtype::F6_E3M2 => {
                unpack6(block, &mut codes);
                add::<1, F6E3M2>(tally, &codes)
            }
        };
        if let Some(last) = any.then(|| block.iter().rposition(|byte| *byte != 0)).flatten() {
            tally.last = tally.bytes.saturating_add(as_u64(last)).saturating_add(1);
        }
        tally.bytes = tally.bytes.saturating_add(as_u64(block.len()));
    }
}

/// Counts one block of elements of `N` bytes, and returns whether one of their bits is set.
#[inline(always)]
fn add<const N: usize, F: Format<N>>(tally: &mut Tally, bytes: &[u8]) -> bool {
    let (elements, _) = bytes.as_chunks::<N>();
    let Some(start) = elements.first() else { return false };
    let start = F::Word::read(*start);
    let (mut differs, mut any, mut special) = (F::Word::ZERO, F::Word::ZERO, F::Word::ZERO);
    let mut denormals = 0_u64;
    for run in elements.chunks(F::Word::RUN) {
        let mut zeros = F::Word::ZERO;
        for element in run {
            let word = F::Word::read(*element);
            differs = differs | (word ^ start);
            any = any | word;
            zeros = zeros.plus(F::zero(word));
            special = special | F::Word::ZERO.plus(F::special(word));
        }
        tally.zeros = tally.zeros.saturating_add(zeros.into());
        if tally.sums.is_some() {
            let mut small = F::Word::ZERO;
            for element in run {
                small = small.plus(F::denormal(F::Word::read(*element)));
            }
            denormals = denormals.saturating_add(small.into());
        }
    }
    let special = special != F::Word::ZERO;
    if special {
        specials::<N, F>(tally, elements);
    }
    tally.varies |= differs != F::Word::ZERO || tally.value.is_some_and(|value| value != start.into());
    tally.value = tally.value.or(Some(start.into()));
    tally.elements = tally.elements.saturating_add(as_u64(elements.len()));
    if let Some(sums) = &mut tally.sums {
        sums.denormals = sums.denormals.saturating_add(denormals);
        sums.add(&if special { sums_of_some::<N, F>(elements) } else { sums_of_all::<N, F>(elements) });
    }
    any != F::Word::ZERO
}

/// Counts the NaN and infinities of a block that has some.
#[inline(never)]
fn specials<const N: usize, F: Format<N>>(tally: &mut Tally, elements: &[[u8; N]]) {
    for (number, element) in (0..).zip(elements) {
        let word = F::Word::read(*element);
        if F::special(word) {
            let counter = if F::infinite(word) { &mut tally.infinite } else { &mut tally.nan };
            *counter = counter.saturating_add(1);
            tally.first.get_or_insert(tally.elements.saturating_add(number));
        }
    }
}

/// The sums of a block of finite elements.
#[inline(always)]
fn sums_of_all<const N: usize, F: Format<N>>(elements: &[[u8; N]]) -> Sums {
    let mut lanes = Lanes::<F::Number>::NONE;
    let mut rows = [[F::Number::HIGHEST; LANES]; 4];
    let (groups, rest) = elements.as_chunks::<{ LANES * 4 }>();
    for group in groups {
        for (number, element) in rows.as_flattened_mut().iter_mut().zip(group) {
            *number = F::number(F::Word::read(*element));
        }
        lanes.add(&rows);
    }
    for (place, element) in rest.iter().enumerate() {
        lanes.add_one(place % LANES, F::number(F::Word::read(*element)));
    }
    lanes.sums()
}

/// The sums of the finite elements of a block that has others, in the order of [`sums_of_all`].
#[inline(never)]
fn sums_of_some<const N: usize, F: Format<N>>(elements: &[[u8; N]]) -> Sums {
    let mut lanes = Lanes::<F::Number>::NONE;
    for (place, element) in elements.iter().enumerate() {
        let word = F::Word::read(*element);
        if !F::special(word) {
            lanes.add_one(place % LANES, F::number(word));
        }
    }
    lanes.sums()
}

/// Sums of every sixty-fourth element.
struct Lanes<T> {
    min: [T; LANES],
    max: [T; LANES],
    sum: [f64; LANES],
    squares: [f64; LANES],
}

impl<T: Number> Lanes<T> {
    const NONE: Self =
        Self { min: [T::HIGHEST; LANES], max: [T::LOWEST; LANES], sum: [0.0; LANES], squares: [0.0; LANES] };

    /// Adds four numbers to each lane, one after the other.
    #[inline(always)]
    fn add(&mut self, [one, two, three, four]: &[[T; LANES]; 4]) {
        let numbers = || one.iter().zip(two).zip(three).zip(four);
        for ((min, max), (((one, two), three), four)) in self.min.iter_mut().zip(&mut self.max).zip(numbers()) {
            for number in [*one, *two, *three, *four] {
                *min = if number < *min { number } else { *min };
                *max = if number > *max { number } else { *max };
            }
        }
        for ((sum, squares), (((one, two), three), four)) in self.sum.iter_mut().zip(&mut self.squares).zip(numbers()) {
            for number in [*one, *two, *three, *four] {
                let number: f64 = number.into();
                *sum += number;
                *squares += number * number;
            }
        }
    }

    fn add_one(&mut self, lane: usize, number: T) {
        let lanes = self.min.iter_mut().zip(&mut self.max).zip(self.sum.iter_mut().zip(&mut self.squares));
        if let Some(((min, max), (sum, squares))) = lanes.into_iter().nth(lane) {
            *min = if number < *min { number } else { *min };
            *max = if number > *max { number } else { *max };
            let number: f64 = number.into();
            *sum += number;
            *squares += number * number;
        }
    }

    #[inline(always)]
    fn sums(mut self) -> Sums {
        let mut half = LANES / 2;
        while half > 0 {
            fold(&mut self.min, half, |one, other| if other < one { other } else { one });
            fold(&mut self.max, half, |one, other| if other > one { other } else { one });
            fold(&mut self.sum, half, |one, other| one + other);
            fold(&mut self.squares, half, |one, other| one + other);
            half /= 2;
        }
        let ([min, ..], [max, ..], [sum, ..], [squares, ..]) = (self.min, self.max, self.sum, self.squares);
        Sums { min: min.into(), max: max.into(), sum, squares, denormals: 0 }
    }
}

/// Combines the second `half` lanes with the first.
#[inline(always)]
fn fold<T: Copy>(lanes: &mut [T; LANES], half: usize, combine: impl Fn(T, T) -> T) {
    if let Some((first, second)) = lanes.split_at_mut_checked(half) {
        for (one, other) in first.iter_mut().zip(second) {
            *one = combine(*one, *other);
        }
    }
}

#[cfg(test)]
mod tests;
