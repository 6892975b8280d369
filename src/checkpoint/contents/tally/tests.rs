//! Tests of the counts and sums.
#![allow(clippy::arithmetic_side_effects, clippy::float_cmp, reason = "expected values are exact")]

use super::*;

/// Bytes of elements with every pattern, and more of them than a block holds.
fn bytes(seed: u64) -> Vec<u8> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33).to_le_bytes()
    };
    (0..3 * BLOCK + 96).map(|_| next()[0]).collect()
}

fn tally(dtype: Dtype, bytes: &[u8]) -> Tally {
    let mut tally = Tally::new(dtype, true);
    tally.add(bytes);
    tally
}

/// The number of a code, from the definition of the format: sign, exponent with this bias, fraction.
fn defined(code: u32, exponent: u32, fraction: u32, bias: i32) -> f64 {
    let field = |at: u32, bits: u32| (code >> at) & ((1 << bits) - 1);
    let sign = if field(exponent + fraction, 1) == 1 { -1.0 } else { 1.0 };
    let (power, part) = (field(fraction, exponent), f64::from(field(0, fraction)) / f64::from(1_u32 << fraction));
    let power_of = |n: i32| f64::from(n).exp2();
    let power = i32::try_from(power).unwrap();
    sign * if power == 0 { part * power_of(1 - bias) } else { (1.0 + part) * power_of(power - bias) }
}

#[test]
fn codes_are_the_numbers_of_their_definitions() {
    for code in 0..=0xff_u8 {
        let at = u32::from(code);
        let same = |number: f32, exponent, fraction, bias| {
            let number = f64::from(number);
            assert_eq!(number, defined(at, exponent, fraction, bias), "{code:#x} {exponent} {fraction}");
        };
        same(F8E4M3::number(code), 4, 3, 7);
        same(F8E5M2::number(code), 5, 2, 15);
        same(F8E4M3Fnuz::number(code), 4, 3, 8);
        same(F8E5M2Fnuz::number(code), 5, 2, 16);
        assert_eq!(F8E8M0::number(code), (f64::from(code) - 127.0).exp2());
    }
    for code in 0..0x40_u8 {
        assert_eq!(f64::from(F6E2M3::number(code)), defined(code.into(), 2, 3, 1));
        assert_eq!(f64::from(F6E3M2::number(code)), defined(code.into(), 3, 2, 3));
        assert_eq!(f64::from(F4::number(code & 0xf)), defined((code & 0xf).into(), 2, 1, 1));
    }
    for code in (0..=0xffff_u16).filter(|code| !F16::special(*code)) {
        assert_eq!(f64::from(F16::number(code)).to_bits(), half::f16::from_bits(code).to_f64().to_bits());
    }
}

/// The numbers of a tensor of 32-bit floats, counted one after the other.
#[test]
fn a_tensor_is_counted_as_a_loop_counts_it() {
    let bytes = bytes(1);
    let found = tally(Dtype::F32, &bytes);
    let numbers: Vec<f32> = bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let count = |is: fn(&f32) -> bool| as_u64(numbers.iter().filter(|n| is(n)).count());
    assert!(count(|n| n.is_nan()) > 0);
    assert_eq!((found.nan, found.infinite), (count(|n| n.is_nan()), count(|n| n.is_infinite())));
    assert_eq!((found.elements, found.zeros), (as_u64(numbers.len()), count(|n| *n == 0.0)));
    assert_eq!(found.first, numbers.iter().position(|n| !n.is_finite()).map(as_u64));
    let finite: Vec<f64> = numbers.iter().filter(|n| n.is_finite()).map(|n| f64::from(*n)).collect();
    let sums = found.sums.unwrap();
    let near = |one: f64, other: f64| assert!((one - other).abs() <= 1e-9 * other.abs(), "{one} {other}");
    near(sums.squares, finite.iter().map(|n| n * n).sum());
    assert_eq!(sums.min, finite.iter().copied().fold(f64::INFINITY, f64::min));
    assert_eq!(sums.max, finite.iter().copied().fold(f64::NEG_INFINITY, f64::max));
    assert_eq!(sums.denormals, count(|n| n.is_subnormal()));
    assert!(found.varies);
}

/// Parts between blocks, in order, have the same bits as the whole; so have holes and the zeros that they stand for.
#[test]
fn parts_are_the_whole() {
    for dtype in Dtype::ALL {
        let mut bytes = bytes(2);
        bytes[BLOCK..2 * BLOCK].fill(0);
        let whole = tally(dtype, &bytes);
        let mut hole = Tally::new(dtype, true);
        hole.skip(as_u64(BLOCK));
        let mut parts = Tally::new(dtype, true);
        for (n, block) in bytes.chunks(BLOCK).enumerate() {
            parts.then(&if n == 1 { hole } else { tally(dtype, block) });
        }
        assert_eq!(parts, whole, "{dtype}");
        let zeros =
            [tally(dtype, &vec![0; BLOCK]), hole].map(|t| (t.zeros, t.is_constant(), t.last_value(), t.elements));
        assert_eq!(zeros[0], zeros[1], "{dtype}");
    }
}

#[test]
fn each_type_has_its_own_patterns() {
    let counts = |dtype, bytes: &[u8]| {
        let tally = tally(dtype, bytes);
        (tally.nan, tally.infinite, tally.zeros, tally.sums.unwrap().denormals, tally.first)
    };
    let floats = [1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.0, -0.0, 1e-40].map(f32::to_le_bytes).concat();
    assert_eq!(counts(Dtype::F32, &floats), (1, 2, 2, 1, Some(1)));
    let floats = [1.0, f64::NAN, f64::INFINITY, -0.0, 5e-324].map(f64::to_le_bytes).concat();
    assert_eq!(counts(Dtype::F64, &floats), (1, 1, 1, 1, Some(1)));
    let words = |words: &[u16]| words.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<_>>();
    assert_eq!(counts(Dtype::F16, &words(&[0x7bff, 0x7e00, 0x7c00, 0xfc00, 0x8000, 0x83ff])), (1, 2, 1, 1, Some(1)));
    assert_eq!(counts(Dtype::BF16, &words(&[0x7f7f, 0xffc0, 0x7f80, 0xff80, 0x8000, 0x7f])), (1, 2, 1, 1, Some(1)));
    assert_eq!(counts(Dtype::F8_E5M2, &[0x7b, 0x7f, 0x7c, 0xfc, 0x80, 0x83]), (1, 2, 1, 1, Some(1)));
    assert_eq!(counts(Dtype::F8_E4M3, &[0x7e, 0x7f, 0xff, 0xfe, 0x80, 0x87]), (2, 0, 1, 1, Some(1)));
    assert_eq!(counts(Dtype::F8_E4M3FNUZ, &[0x7f, 0x80, 0xff, 0, 0x87]), (1, 0, 1, 1, Some(1)));
    assert_eq!(counts(Dtype::F8_E5M2FNUZ, &[0x7f, 0x80, 0xff, 0, 0x83]), (1, 0, 1, 1, Some(1)));
    assert_eq!(counts(Dtype::F8_E8M0, &[0xfe, 0xff, 1, 0]), (1, 0, 0, 0, Some(1)));
    assert_eq!(counts(Dtype::F4, &[0x10, 0x89]), (0, 0, 2, 2, None));
    // 0x20 (-0), 0x1f, 0, 1.
    assert_eq!(counts(Dtype::F6_E2M3, &[0xe0, 0x07, 0x04]), (0, 0, 2, 1, None));
    assert_eq!(counts(Dtype::U8, &[0xff, 0, 1]), (0, 0, 1, 0, None));
    assert_eq!(counts(Dtype::C64, &floats[..8]).4, None);
}

/// Keys of all elements of a type, in the order of their numbers.
fn ordered<const N: usize, F: Format<N>>(words: impl Iterator<Item = F::Word>) {
    let mut elements: Vec<(f64, F::Word)> =
        words.filter(|word| !F::special(*word)).map(|word| (F::number(word).into(), word)).collect();
    elements.sort_by(|one, other| one.0.total_cmp(&other.0));
    let keys: Vec<_> = elements.iter().map(|(_, word)| F::key(*word)).collect();
    assert!(keys.is_sorted());
    assert!(elements.iter().zip(keys).all(|((_, word), key)| F::with_key(key) == *word));
}

#[test]
fn keys_have_the_order_of_the_numbers() {
    ordered::<2, Bf16>(0..=u16::MAX);
    ordered::<2, F16>(0..=u16::MAX);
    ordered::<2, I16>(0..=u16::MAX);
    ordered::<2, U16>(0..=u16::MAX);
    ordered::<1, F8E4M3>(0..=u8::MAX);
    ordered::<1, F8E5M2>(0..=u8::MAX);
    ordered::<1, F8E4M3Fnuz>(0..=u8::MAX);
    ordered::<1, F8E5M2Fnuz>(0..=u8::MAX);
    ordered::<1, F8E8M0>(0..=u8::MAX);
    ordered::<1, F6E2M3>(0..=0x3f);
    ordered::<1, F6E3M2>(0..=0x3f);
    ordered::<1, F4>(0..=0xf);
    ordered::<1, I8>(0..=u8::MAX);
    ordered::<1, U8>(0..=u8::MAX);
    let wide = [0, 1, 0x7f7f_ffff, 0x8000_0000, 0x8000_0001, 0xff7f_ffff, 0x3f80_0000, 0xbf80_0000];
    ordered::<4, F32>(wide.into_iter());
    ordered::<4, I32>(wide.into_iter());
    ordered::<4, U32>(wide.into_iter());
    let wide = wide.map(|word| u64::from(word) << 32 | 1);
    ordered::<8, F64>(wide.into_iter());
    ordered::<8, I64>(wide.into_iter());
    ordered::<8, U64>(wide.into_iter());
}

/// NaN and infinities count as nothing: the sums have the bits of those with zeros in their places.
#[test]
fn special_elements_are_left_out_of_sums() {
    for dtype in [Dtype::BF16, Dtype::F16] {
        let (exponent, bytes) = (if dtype == Dtype::BF16 { 0x7f80 } else { 0x7c00 }, bytes(3));
        let words = bytes.as_chunks().0.iter().map(|word| u16::from_le_bytes(*word));
        let zeroed = words.map(|word| if word & exponent == exponent { 0 } else { word });
        let zeroed: Vec<u8> = zeroed.flat_map(u16::to_le_bytes).collect();
        let (found, expected) = (tally(dtype, &bytes), tally(dtype, &zeroed));
        assert!(found.nan > 0, "{dtype}");
        assert_eq!(found.sums, expected.sums, "{dtype}");
    }
}

/// What a loop over the elements counts, one after the other; sums are exact, as integers in units of 2^-24.
fn counted<const N: usize, F: Format<N>>(dtype: Dtype, bytes: &[u8]) -> Tally {
    let mut tally = Tally::new(dtype, true);
    let (mut sums, mut sum, mut squares) = (Sums::NONE, 0_i128, 0_i128);
    for (at, element) in bytes.as_chunks::<N>().0.iter().enumerate() {
        let word = F::Word::read(*element);
        tally.elements += 1;
        tally.zeros += u64::from(F::zero(word));
        tally.varies |= tally.value.is_some_and(|value| value != word.into());
        tally.value = tally.value.or(Some(word.into()));
        if F::special(word) {
            tally.infinite += u64::from(F::infinite(word));
            tally.nan += u64::from(!F::infinite(word));
            tally.first = tally.first.or(Some(as_u64(at)));
            continue;
        }
        let number: f64 = F::number(word).into();
        sums.denormals += u64::from(F::denormal(word));
        sums.min = if number.total_cmp(&sums.min).is_lt() { number } else { sums.min };
        sums.max = if number.total_cmp(&sums.max).is_gt() { number } else { sums.max };
        #[allow(clippy::cast_possible_truncation, reason = "a multiple of the unit")]
        let units = (number * 24_f64.exp2()) as i128;
        sum += units;
        squares += units * units;
    }
    #[allow(clippy::cast_precision_loss, reason = "rounded once")]
    let number = |units: i128, exponent: f64| units as f64 * exponent.exp2();
    (sums.sum, sums.squares) = (number(sum, -24.0), number(squares, -48.0));
    tally.bytes = as_u64(bytes.len());
    tally.last = bytes.iter().rposition(|byte| *byte != 0).map_or(0, |last| as_u64(last) + 1);
    tally.sums = Some(sums);
    tally
}

/// Compares contents of many kinds and lengths with a loop, whole and in parts between blocks. Sums of these types have the
/// bits of the exact ones where `exact` says so.
fn compared<const N: usize, F: Format<N>>(dtype: Dtype, high: u8, exact: fn(&str) -> bool) {
    let bits = |mask: u8, set: u8| {
        let words = bytes(4).into_iter().enumerate();
        words.map(|(n, byte)| if n % N == N - 1 { byte & mask | set } else { byte }).collect::<Vec<u8>>()
    };
    let mut mixed = bits(0x87, 0x30);
    mixed[BLOCK + 40..BLOCK + 60].fill(0xff);
    mixed[2 * BLOCK..2 * BLOCK + 2 * N].fill(high);
    let mut later = bits(0x9f, 0x20);
    later[BLOCK + 100 * N + N - 1] = 0x50;
    let kinds = [
        ("random", bits(0xff, 0)),
        ("lowest exponents", bits(0x83, 0)),
        ("around one", bits(0x83, 0x3c)),
        ("one class", bits(0x9f, 0x20)),
        ("another class later", later),
        ("lower half", bits(0xbf, 0)),
        ("upper half", bits(0x9b, 0x40)),
        ("zeros", bits(0, 0).into_iter().map(|_| 0).collect()),
        (
            "negative",
            bits(0, 0xff).into_iter().enumerate().map(|(n, b)| if n % N == N - 1 { 0x80 } else { b }).collect(),
        ),
        ("special elements in a few places", mixed),
        ("no finite element", vec![0xff; 3 * BLOCK + 96]),
    ];
    for (kind, bytes) in &kinds {
        for elements in [1, 2, 31, 33, 63, 65, 1023, 1024, 1025, 5000, BLOCK / N, BLOCK / N + 1, bytes.len() / N] {
            let bytes = &bytes[..elements * N];
            let (found, expected) = (tally(dtype, bytes), counted::<N, F>(dtype, bytes));
            let (sums, exactly) = (found.sums.unwrap(), expected.sums.unwrap());
            if exact(kind) {
                assert_eq!(found, expected, "{dtype} {kind} {elements}");
                assert_eq!(sums.sum.to_bits(), exactly.sum.to_bits(), "{dtype} {kind} {elements}");
            }
            let near = |one: f64, other: f64| {
                let allowed = 1e-13 * exactly.squares.max(exactly.sum.abs());
                assert!((one - other).abs() <= allowed, "{dtype} {kind} {elements}: {one} {other}");
            };
            near(sums.sum, exactly.sum);
            near(sums.squares, exactly.squares);
            assert_eq!(Tally { sums: None, ..found }, Tally { sums: None, ..expected }, "{dtype} {kind} {elements}");
            let counts = |sums: Sums| (sums.min.to_bits(), sums.max.to_bits(), sums.denormals);
            assert_eq!(counts(sums), counts(exactly), "{dtype} {kind} {elements}");
            for blocks in 1..3 {
                let mut parts = Tally::new(dtype, true);
                bytes.chunks(blocks * BLOCK).for_each(|part| parts.add(part));
                assert_eq!(parts, found, "{dtype} {kind} {elements} {blocks}");
            }
        }
    }
}

#[test]
fn small_floats_are_counted_as_a_loop_counts_them() {
    compared::<1, F8E4M3>(Dtype::F8_E4M3, 0x7f, |_| true);
    compared::<1, F8E4M3Fnuz>(Dtype::F8_E4M3FNUZ, 0x80, |_| true);
    let one_class = |kind: &str| !["random", "lower half", "upper half", "another class later"].contains(&kind);
    compared::<1, F8E5M2>(Dtype::F8_E5M2, 0x7c, one_class);
    compared::<1, F8E5M2Fnuz>(Dtype::F8_E5M2FNUZ, 0x80, one_class);
    compared::<2, F16>(Dtype::F16, 0x7c, |kind| ["zeros", "negative", "no finite element"].contains(&kind));
}

/// Blocks of one class are added up as integers, and as floats with the same result.
#[test]
fn integers_and_floats_have_the_same_sums() {
    fn same<F: Format<1, Word = u8>>() {
        let layout = F::SMALL.unwrap();
        let mut classes = 0;
        for class in 0..4 {
            let codes: Vec<u8> = (bytes(5).into_iter())
                .filter(|code| {
                    small::class(layout, (*code).into(), (*code).into()) == Some(class) && !F::special(*code)
                })
                .collect();
            classes += u32::from(!codes.is_empty());
            for len in [0, 1, 63, 1025, codes.len()] {
                let codes = &codes[..len.min(codes.len())];
                let (integers, floats) =
                    (small::added(codes, layout, class), added::<1, F, false, false>(codes.as_chunks().0));
                assert_eq!(integers.0.to_bits(), floats.0.to_bits(), "{class} {len}");
                assert_eq!(integers.1.to_bits(), floats.1.to_bits(), "{class} {len}");
            }
        }
        assert_eq!(classes, 1 << (layout.exponent - 3));
    }
    same::<F8E4M3>();
    same::<F8E4M3Fnuz>();
    same::<F8E5M2>();
    same::<F8E5M2Fnuz>();
}

/// What is counted of packed elements without sums is what is counted of them one by one.
#[test]
fn packed_elements_are_counted_as_single_ones() {
    let random = bytes(6);
    let constant = |bytes: [u8; 3]| bytes.into_iter().cycle().take(BLOCK + 99).collect::<Vec<u8>>();
    // Of six bits: signs only, ones only, and magnitudes of a single bit in the first and in the last element.
    let sixes = [[0x20, 0x08, 0x82], [0x41, 0x10, 0x04], [0x01, 0, 0], [0, 0, 0x40]];
    let mut all: Vec<Vec<u8>> =
        [0, 0x88, 0x80, 0x08, 0x55, 0x22].map(|byte| [byte; 3]).into_iter().chain(sixes).map(constant).collect();
    for late in [1, 25, BLOCK - 3, BLOCK - 1, BLOCK + 50] {
        let mut bytes = constant([0; 3]);
        bytes[late] = 0x10;
        all.push(bytes);
    }
    all.push(random);
    for dtype in [Dtype::F4, Dtype::F6_E2M3, Dtype::F6_E3M2] {
        for (kind, bytes) in all.iter().enumerate() {
            for len in [0, 3, 21, 24, 27, 48, 66, BLOCK, BLOCK + 51, bytes.len()] {
                let bytes = &bytes[..len.min(bytes.len())];
                let mut packed = Tally::new(dtype, false);
                packed.add(bytes);
                assert_eq!(packed, Tally { sums: None, ..tally(dtype, bytes) }, "{dtype} {kind} {len}");
            }
        }
    }
}

/// Elements of four and six bits are taken apart from the lowest bit of a block on.
#[test]
fn packed_elements_are_taken_apart() {
    let bytes: Vec<u8> = (0..300_u32).map(|i| i.wrapping_mul(2_654_435_761).to_be_bytes()[0]).collect();
    let defined = |width: usize| -> Vec<u8> {
        let bit = |at: usize| bytes[at / 8] >> (at % 8) & 1;
        (0..bytes.len() * 8 / width).map(|n| (0..width).map(|i| bit(n * width + i) << i).sum()).collect()
    };
    let mut codes = Vec::new();
    unpack4(&bytes, &mut codes);
    assert_eq!(codes, defined(4));
    unpack6(&bytes, &mut codes);
    assert_eq!(codes, defined(6));
}
