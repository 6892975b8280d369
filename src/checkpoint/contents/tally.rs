//! Counts the elements of a tensor, and adds up their numbers.
//!
//! The loops have neither early ends nor calls, so that the compiler vectorises them, once for each set of instructions in
//! `targets`; the one that the processor has is chosen at run time. Sums are made in the same order on every processor.

#![allow(
    clippy::inline_always,
    clippy::verbose_bit_mask,
    reason = "a function that is not inlined is compiled for the oldest processors, and masks are compared in vectors"
)]

use std::array::from_ref;

use multiversion::multiversion;
use multiversion::target::target_cfg_f;

use super::super::{Dtype, Fault, FaultKind, Place};
use super::formats::{
    Bf16, F4, F6E2M3, F6E3M2, F8E4M3, F8E4M3Fnuz, F8E5M2, F8E5M2Fnuz, F8E8M0, F16, F32, F64, Format, I8, I16, I32, I64,
    U8, U16, U32, U64, Word, unpack4, unpack6,
};

/// Bytes that are counted at a time: they fit into the fastest cache. A multiple of every width of an element, and of the
/// three bytes of four elements of six bits.
pub(super) const BLOCK: usize = 24 << 10;

// A block has at most two elements for each byte, and the narrowest counter has 16 bits.
const _: () = assert!(BLOCK <= (u16::MAX / 2) as usize);

/// Sums that are kept side by side: enough for a loop over them to be vectorised.
const LANES: usize = 64;

/// Numbers that are added to a lane between reading and writing its sums. With many more, the loop is not vectorised.
const ROWS: usize = 4;

/// Bytes of a lane that are counted between reading and writing its counter.
const BYTE_ROWS: usize = 8;

/// Bytes of a lane that a counter of eight bits is wide enough for.
const PART_ROWS: usize = 96;

// A byte has at most two elements.
const _: () = assert!(PART_ROWS <= (u8::MAX / 2) as usize);

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
    /// Whether a multiplication and an addition are one instruction.
    const FUSED: bool = target_cfg_f!(target_feature = "fma");
    let mut codes = Vec::new();
    for block in bytes.chunks(BLOCK) {
        let any = match tally.dtype {
            Dtype::F4 if tally.sums.is_none() => pairs(tally, block),
            Dtype::F6_E2M3 | Dtype::F6_E3M2 if tally.sums.is_none() => {
                let (groups, rest) = block.as_chunks();
                unpack6(rest, &mut codes);
                // Both types have the same zeros.
                quartets(tally, groups) | add::<1, F6E2M3, FUSED>(tally, &codes)
            }
            Dtype::BF16 => add::<2, Bf16, FUSED>(tally, block),
            Dtype::F16 => add::<2, F16, FUSED>(tally, block),
            Dtype::F32 | Dtype::C64 => add::<4, F32, FUSED>(tally, block),
            Dtype::F64 => add::<8, F64, FUSED>(tally, block),
            Dtype::F8_E4M3 => add::<1, F8E4M3, FUSED>(tally, block),
            Dtype::F8_E5M2 => add::<1, F8E5M2, FUSED>(tally, block),
            Dtype::F8_E8M0 => add::<1, F8E8M0, FUSED>(tally, block),
            Dtype::F8_E4M3FNUZ => add::<1, F8E4M3Fnuz, FUSED>(tally, block),
            Dtype::F8_E5M2FNUZ => add::<1, F8E5M2Fnuz, FUSED>(tally, block),
            Dtype::U8 | Dtype::BOOL => add::<1, U8, FUSED>(tally, block),
            Dtype::I8 => add::<1, I8, FUSED>(tally, block),
            Dtype::U16 => add::<2, U16, FUSED>(tally, block),
            Dtype::I16 => add::<2, I16, FUSED>(tally, block),
            Dtype::U32 => add::<4, U32, FUSED>(tally, block),
            Dtype::I32 => add::<4, I32, FUSED>(tally, block),
            Dtype::U64 => add::<8, U64, FUSED>(tally, block),
            Dtype::I64 => add::<8, I64, FUSED>(tally, block),
            Dtype::F4 => {
                unpack4(block, &mut codes);
                add::<1, F4, FUSED>(tally, &codes)
            }
            Dtype::F6_E2M3 => {
                unpack6(block, &mut codes);
                add::<1, F6E2M3, FUSED>(tally, &codes)
            }
            Dtype::F6_E3M2 => {
                unpack6(block, &mut codes);
                add::<1, F6E3M2, FUSED>(tally, &codes)
            }
        };
        if let Some(last) = any.then(|| block.iter().rposition(|byte| *byte != 0)).flatten() {
            tally.last = tally.bytes.saturating_add(as_u64(last)).saturating_add(1);
        }
        tally.bytes = tally.bytes.saturating_add(as_u64(block.len()));
    }
}

/// The counter of elements of a block.
type Count<const N: usize, F> = <<F as Format<N>>::Word as Word<N>>::Count;

/// Counts one block of elements of `N` bytes, and returns whether one of their bits is set.
#[inline(always)]
fn add<const N: usize, F: Format<N>, const FUSED: bool>(tally: &mut Tally, bytes: &[u8]) -> bool {
    let (elements, _) = bytes.as_chunks::<N>();
    let Some(start) = elements.first() else { return false };
    let start = F::Word::read(*start);
    let (mut differs, mut any, mut all, mut special) = (F::Word::ZERO, F::Word::ZERO, start, false);
    let mut zeros = Count::<N, F>::default();
    // The first loop waits for the memory, so it is the one with the most work. What it adds up is right unless an element is
    // special, or of another class than the first ones.
    let class = F::SMALL.and_then(|layout| small::class_of_first(layout, elements.as_flattened()));
    let early = match (F::SMALL, class) {
        _ if tally.sums.is_none() => (0.0, 0.0),
        (Some(layout), Some(class)) => small::added(elements.as_flattened(), layout, class),
        _ => added::<N, F, false, FUSED>(elements),
    };
    for element in elements {
        let word = F::Word::read(*element);
        differs = differs | (word ^ start);
        any = any | word;
        all = all & word;
        // Those of one byte are counted faster by themselves.
        if N > 1 {
            zeros = F::Word::plus(zeros, F::zero(word));
        }
        special |= F::special(word);
    }
    let zeros = if N > 1 { zeros.into() } else { count::<N, F>(elements, F::zero) };
    tally.zeros = tally.zeros.saturating_add(zeros);
    if special {
        specials::<N, F>(tally, elements);
    }
    tally.varies |= differs != F::Word::ZERO || tally.value.is_some_and(|value| value != start.into());
    tally.value = tally.value.or(Some(start.into()));
    tally.elements = tally.elements.saturating_add(as_u64(elements.len()));
    if let Some(sums) = &mut tally.sums {
        let (min, max) = if special { range::<N, F, true>(elements) } else { range::<N, F, false>(elements) };
        let (sum, squares) = if special {
            added::<N, F, true, FUSED>(elements)
        } else if F::SMALL
            .is_some_and(|layout| class.is_some() && class != small::class(layout, any.into(), all.into()))
        {
            added::<N, F, false, FUSED>(elements)
        } else {
            early
        };
        let denormals = count::<N, F>(elements, F::denormal);
        sums.add(&Sums { min, max, sum, squares, denormals });
    }
    any != F::Word::ZERO
}

/// The elements of a block for which a condition holds.
#[inline(always)]
fn count<const N: usize, F: Format<N>>(elements: &[[u8; N]], holds: impl Fn(F::Word) -> bool) -> u64 {
    if N == 1 {
        return count_bytes(elements.as_flattened(), |byte| holds(F::Word::read([byte; N])).into());
    }
    let mut found = Count::<N, F>::default();
    for element in elements {
        found = F::Word::plus(found, holds(F::Word::read(*element)));
    }
    found.into()
}

/// The sum of `found`, which is at most 2, over the bytes of a block.
#[inline(always)]
fn count_bytes(bytes: &[u8], found: impl Fn(u8) -> u8) -> u64 {
    let mut all = 0_u64;
    for part in bytes.chunks(PART_ROWS * LANES) {
        let mut counters = [0_u8; LANES];
        let (rows, rest) = part.as_chunks::<LANES>();
        let (groups, last) = rows.as_chunks::<BYTE_ROWS>();
        for group in groups {
            // By number, as in `add_rows`.
            for lane in 0..LANES {
                let Some(counter) = counters.get_mut(lane) else { continue };
                let bytes = group.iter().filter_map(|row| row.get(lane));
                *counter = bytes.fold(*counter, |sum, byte| sum.wrapping_add(found(*byte)));
            }
        }
        // Two sums: one over both is not vectorised.
        let counted: u64 = counters.iter().map(|counter| u64::from(*counter)).sum();
        let rest: u64 = last.as_flattened().iter().chain(rest).map(|byte| u64::from(found(*byte))).sum();
        all = all.saturating_add(counted).saturating_add(rest);
    }
    all
}

/// Counts one block of elements of four bits, two in a byte, without taking them apart: there are no sums, and none is NaN or
/// infinite. Returns whether a bit is set.
#[inline(always)]
fn pairs(tally: &mut Tally, bytes: &[u8]) -> bool {
    let Some(first) = bytes.first() else { return false };
    // The lower half is the first element.
    let start = first & 0xf;
    let same = start << 4 | start;
    let (mut differs, mut any) = (0_u8, 0_u8);
    for pair in bytes {
        differs |= pair ^ same;
        any |= pair;
    }
    let zeros = count_bytes(bytes, |pair| u8::from(pair & 0x07 == 0).wrapping_add((pair & 0x70 == 0).into()));
    tally.zeros = tally.zeros.saturating_add(zeros);
    tally.varies |= differs != 0 || tally.value.is_some_and(|value| value != u64::from(start));
    tally.value = tally.value.or(Some(start.into()));
    tally.elements = tally.elements.saturating_add(as_u64(bytes.len()).saturating_mul(2));
    any != 0
}

/// Counts elements of six bits, four in three bytes, as [`pairs`] counts those of four. A group has thirty-two.
#[inline(always)]
fn quartets(tally: &mut Tally, groups: &[[u8; 24]]) -> bool {
    let Some([first, ..]) = groups.first() else { return false };
    let start = u64::from(first & 0x3f);
    let mut eights = Eights { same: start.wrapping_mul(Eights::LOWEST), differs: 0, any: 0 };
    let mut nonzero = 0_u64;
    for group in groups {
        let ([one, two, three], _) = group.as_chunks() else { continue };
        let (one, two, three) = (u64::read(*one), u64::read(*two), u64::read(*three));
        let first = eights.nonzero(one);
        let second = eights.nonzero(one >> 48 | two << 16);
        let third = eights.nonzero(two >> 32 | three << 32);
        let fourth = eights.nonzero(three >> 16);
        // Each has one bit in six.
        let found = first | second >> 1 | third >> 2 | fourth >> 3;
        nonzero = nonzero.wrapping_add(found.count_ones().into());
    }
    let elements = as_u64(groups.len()).saturating_mul(32);
    tally.zeros = tally.zeros.saturating_add(elements.saturating_sub(nonzero));
    tally.varies |= eights.differs != 0 || tally.value.is_some_and(|value| value != start);
    tally.value = tally.value.or(Some(start));
    tally.elements = tally.elements.saturating_add(elements);
    eights.any != 0
}

/// Words of eight elements of six bits.
struct Eights {
    /// The first element, eight times.
    same: u64,
    differs: u64,
    any: u64,
}

impl Eights {
    /// The lowest bit of each element.
    const LOWEST: u64 = 0x0410_4104_1041;
    const ALL: u64 = Self::LOWEST * 0x3f;
    const SIGNS: u64 = Self::LOWEST * 0x20;
    const MAGNITUDES: u64 = Self::LOWEST * 0x1f;

    /// Adds the eight elements in the lower bits of a word; returns the sign bit of those that are not zero.
    #[inline(always)]
    const fn nonzero(&mut self, word: u64) -> u64 {
        let eight = word & Self::ALL;
        self.differs |= eight ^ self.same;
        self.any |= eight;
        // A magnitude that is not zero carries into the bit of its sign.
        (eight & Self::MAGNITUDES).wrapping_add(Self::MAGNITUDES) & Self::SIGNS
    }
}

/// Counts the NaN and infinities of a block that has some. Called before its elements are counted.
#[inline(always)]
fn specials<const N: usize, F: Format<N>>(tally: &mut Tally, elements: &[[u8; N]]) {
    let (special, infinite) = (count::<N, F>(elements, F::special), count::<N, F>(elements, F::infinite));
    tally.nan = tally.nan.saturating_add(special.saturating_sub(infinite));
    tally.infinite = tally.infinite.saturating_add(infinite);
    if tally.first.is_none() {
        let first = elements.iter().position(|element| F::special(F::Word::read(*element)));
        tally.first = first.map(|first| tally.elements.saturating_add(as_u64(first)));
    }
}

/// The smallest and the largest number of a block; infinities of the opposite sign when no element is finite. `SPECIAL` is
/// whether there may be elements that are not: they are left out.
#[inline(always)]
fn range<const N: usize, F: Format<N>, const SPECIAL: bool>(elements: &[[u8; N]]) -> (f64, f64) {
    let (mut low, mut high) = (F::Word::LAST_KEY, F::Word::FIRST_KEY);
    if SPECIAL {
        // Two loops: one with both choices is not vectorised.
        for element in elements {
            let word = F::Word::read(*element);
            low = low.min(if F::special(word) { F::Word::LAST_KEY } else { F::key(word) });
        }
        for element in elements {
            let word = F::Word::read(*element);
            high = high.max(if F::special(word) { F::Word::FIRST_KEY } else { F::key(word) });
        }
    } else {
        for element in elements {
            let key = F::key(F::Word::read(*element));
            low = low.min(key);
            high = high.max(key);
        }
    }
    if low > high {
        return (f64::INFINITY, f64::NEG_INFINITY);
    }
    (F::number(F::with_key(low)).into(), F::number(F::with_key(high)).into())
}

/// The sum of the finite numbers of a block, and of their squares. Each lane adds up every sixty-fourth element, in order.
/// `SPECIAL` is whether there may be elements that are not finite: they count as 0.
#[inline(always)]
fn added<const N: usize, F: Format<N>, const SPECIAL: bool, const FUSED: bool>(elements: &[[u8; N]]) -> (f64, f64) {
    let (mut sum, mut squares) = ([0.0; LANES], [0.0; LANES]);
    let (rows, rest) = elements.as_chunks();
    let (groups, last) = rows.as_chunks();
    let mut numbers = [[F::Number::default(); LANES]; ROWS];
    for group in groups {
        if N > 2 {
            add_rows::<N, F, FUSED, _, ROWS>(&mut sum, &mut squares, group, decoded::<N, F, SPECIAL>);
        } else {
            // Vectors of the narrower numbers have more of them, so these are decoded first.
            for (number, element) in numbers.as_flattened_mut().iter_mut().zip(group.as_flattened()) {
                *number = decoded::<N, F, SPECIAL>(*element);
            }
            add_rows::<N, F, FUSED, _, ROWS>(&mut sum, &mut squares, &numbers, |number| number);
        }
    }
    for row in last {
        add_rows::<N, F, FUSED, _, 1>(&mut sum, &mut squares, from_ref(row), decoded::<N, F, SPECIAL>);
    }
    for ((sum, squares), element) in sum.iter_mut().zip(&mut squares).zip(rest) {
        add_one::<N, F, FUSED>(sum, squares, decoded::<N, F, SPECIAL>(*element));
    }
    let mut half = LANES / 2;
    while half > 0 {
        fold(&mut sum, half);
        fold(&mut squares, half);
        half /= 2;
    }
    let ([sum, ..], [squares, ..]) = (sum, squares);
    (sum, squares)
}

/// The number of an element; 0 for one that is not finite.
#[inline(always)]
fn decoded<const N: usize, F: Format<N>, const SPECIAL: bool>(element: [u8; N]) -> F::Number {
    let word = F::Word::read(element);
    if SPECIAL && F::special(word) { F::Number::default() } else { F::number(word) }
}

/// Adds one element of each of the `R` rows to every lane.
#[inline(always)]
fn add_rows<const N: usize, F: Format<N>, const FUSED: bool, T: Copy, const R: usize>(
    sum: &mut [f64; LANES],
    squares: &mut [f64; LANES],
    rows: &[[T; LANES]; R],
    number: impl Fn(T) -> F::Number,
) {
    // By number: zipped iterators are not vectorised.
    for lane in 0..LANES {
        let (Some(sum), Some(squares)) = (sum.get_mut(lane), squares.get_mut(lane)) else { continue };
        // Kept in registers until all rows are added.
        let mut both = (*sum, *squares);
        for element in rows.iter().filter_map(|row| row.get(lane)) {
            add_one::<N, F, FUSED>(&mut both.0, &mut both.1, number(*element));
        }
        (*sum, *squares) = both;
    }
}

#[inline(always)]
fn add_one<const N: usize, F: Format<N>, const FUSED: bool>(sum: &mut f64, squares: &mut f64, number: F::Number) {
    let number: f64 = number.into();
    *sum += number;
    // An exact square is rounded with the sum alone, so both are the same on every processor.
    *squares =
        if FUSED && F::SQUARES_ARE_EXACT { number.mul_add(number, *squares) } else { *squares + number * number };
}

/// Adds the second `half` lanes to the first.
#[inline(always)]
fn fold(lanes: &mut [f64; LANES], half: usize) {
    if let Some((first, second)) = lanes.split_at_mut_checked(half) {
        for (one, other) in first.iter_mut().zip(second) {
            *one += *other;
        }
    }
}

mod small;
#[cfg(test)]
mod tests;
