//! Rows C: the safetensors container.

use super::place::{SHARD, entry, file, header, nested};
use super::run::large;
use super::{Case, case, clean};

/// A whole shard with one tensor `a` of four bytes.
fn plain() -> Vec<u8> {
    file(header(&entry("a", "F32", "[1]", 0, 4)), 4)
}

/// The first eight bytes, and `rest` bytes after them.
fn length(stated: u64, rest: usize) -> Vec<u8> {
    [&stated.to_le_bytes()[..], &vec![0xee; rest]].concat()
}

pub fn cases() -> Vec<Case> {
    [lengths(), sizes(), twice(), layout(), types(), text(), metadata(), names()].into_iter().flatten().collect()
}

/// C1: the header length in the first eight bytes.
fn lengths() -> Vec<Case> {
    let stated = |name: &str, bytes: Vec<u8>| case("C1", name, "SAF001", SHARD, move |d| d.shard(&bytes));
    let mut swapped = plain();
    swapped[..8].reverse();
    vec![
        stated("length 0", length(0, 64)),
        case("C1", "eight NULs", "SAF002", SHARD, |d| d.shard(length(0, 0))),
        stated("one byte more than there is", length(65, 64)),
        stated("a little more than there is", length(100, 64)),
        stated("100 MB in 64 bytes", length(100_000_000, 64)),
        stated("2^63", length(1 << 63, 64)),
        stated("2^63 - 1", length(i64::MAX as u64, 64)),
        stated("2^64 - 1", length(u64::MAX, 64)),
        stated("2^64 - 8", length(u64::MAX - 7, 64)),
        stated("2^64 - 9", length(u64::MAX - 8, 64)),
        stated("big-endian", swapped),
        case("C1", "header over 100 MB", "SAF001", SHARD, |d| {
            d.shard(length(100_000_001, 0));
            let file = std::fs::File::options().write(true).open(d.root.join(SHARD)).unwrap();
            file.set_len(300_000_000).unwrap();
        }),
        case("C1", "no bytes", "SAF003", SHARD, |d| d.shard("")),
        case("C1", "one byte", "SAF001", SHARD, |d| d.shard("x")),
        case("C1", "seven bytes", "SAF001", SHARD, |d| d.shard("1234567")),
        case("C1", "header of 100 MB of NULs", "SAF004", SHARD, |d| {
            d.shard(length(100_000_000, 0));
            let file = std::fs::File::options().write(true).open(d.root.join(SHARD)).unwrap();
            file.set_len(100_000_008).unwrap();
        }),
    ]
}

/// C2, C3, C9: sizes.
fn sizes() -> Vec<Case> {
    let one = |row, name: &str, codes, dtype: &'static str, shape: &'static str, end: u64| {
        case(row, name, codes, "a", move |d| {
            d.tensors(&entry("a", dtype, shape, 0, end), usize::try_from(end).unwrap());
        })
    };
    let huge = |count: u64, size: u64| {
        let entry = move |i| entry(&format!("t{i}"), "U8", &format!("[{size}]"), i * size, (i + 1) * size);
        (0..count).map(entry).collect::<Vec<_>>().join(",")
    };
    let eight = huge(8, (1 << 61) - 1);
    vec![
        case("C2", "eight tensors of 2^61 - 1 bytes", "SAF016", SHARD, move |d| d.tensors(&eight, 0)),
        case("C2", "one of 2^64 - 1 bytes", "SAF016", SHARD, move |d| d.tensors(&huge(1, u64::MAX), 0)),
        case("C2", "the sum wraps to the size", "SAF016", SHARD, move |d| {
            let half = 1_u64 << 63;
            let a = entry("a", "U8", &format!("[{half}]"), 0, half);
            d.tensors(&format!("{a},{}", entry("b", "U8", &format!("[{}]", half - 1), half, u64::MAX)), 3);
        }),
        one("C3", "2^32 by 2^32", "SAF012", "F32", "[4294967296,4294967296]", 4),
        one("C3", "2^63 by 2", "SAF012", "U8", "[9223372036854775808,2]", 0),
        one("C3", "wraps to exactly the size", "SAF012", "F32", "[4611686018427387905,4]", 16),
        one("C3", "bits overflow", "SAF012", "F64", "[2305843009213693952]", 0),
        one("C3", "overflow, then 0", "SAF012", "U8", "[1099511627776,1099511627776,0]", 0),
        clean("C3", "0, then what would overflow", |d| {
            d.tensors(&entry("a", "U8", "[0,1099511627776,1099511627776]", 0, 0), 0);
        }),
        one("C3", "2^64 does not fit", "SAF011", "U8", "[18446744073709551616]", 0),
        case("C3", "a million dimensions", "SAF011", "a", |d| {
            d.tensors(&entry("a", "U8", &format!("[{}1]", "1,".repeat(1_000_000)), 0, 1), 1);
        }),
        case("C3", "offsets near 2^64", "SAF016", "a", |d| {
            d.tensors(&entry("a", "U8", "[1]", u64::MAX - 1, u64::MAX), 1);
        }),
        one("C3", "shape and bytes disagree", "SAF014", "F32", "[2]", 4),
        one("C9", "three of four bits", "SAF013", "F4", "[3]", 2),
        one("C9", "one of six bits", "SAF013", "F6_E2M3", "[1]", 1),
        one("C9", "five of six bits", "SAF013", "F6_E3M2", "[5]", 4),
    ]
}

/// C4: duplicate names.
fn twice() -> Vec<Case> {
    let a = entry("a", "F32", "[1]", 0, 4);
    let two = |name: &str, other: String| {
        let both = format!("{a},{other}");
        case("C4", name, "SAF006", SHARD, move |d| d.tensors(&both, 4))
    };
    let raw = |name: &str, text: &'static str| case("C4", name, "SAF006", SHARD, move |d| d.shard(file(text, 4)));
    vec![
        two("the same entry twice", a.clone()),
        two("another dtype", entry("a", "I32", "[1]", 0, 4)),
        two("another shape", entry("a", "F32", "[1,1]", 0, 4)),
        two("other bytes", entry("a", "F32", "[0]", 4, 4)),
        two("spelled with an escape", entry(r"\u0061", "U32", "[1]", 0, 4)),
        raw(
            "__metadata__ twice",
            r#"{"__metadata__":{"format":"pt"},"__metadata__":{},"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}"#,
        ),
        raw(
            "a key of __metadata__ twice",
            r#"{"__metadata__":{"format":"pt","format":"tf"},"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}"#,
        ),
        raw(
            "dtype twice",
            r#"{"__metadata__":{"format":"pt"},"a":{"dtype":"F32","dtype":"I32","shape":[1],"data_offsets":[0,4]}}"#,
        ),
        raw(
            "offsets twice",
            r#"{"__metadata__":{"format":"pt"},"a":{"dtype":"F32","shape":[1],"data_offsets":[0,0],"data_offsets":[0,4]}}"#,
        ),
    ]
}

/// C5, C6, C7: overlapping bytes, holes and missing bytes.
fn layout() -> Vec<Case> {
    let of = |row, name: &str, code, at, entries: String, data| {
        case(row, name, code, at, move |d| d.tensors(&entries, data))
    };
    let bytes = |name: &str, begin, end: u64| entry(name, "U8", &format!("[{}]", end - begin), begin, end);
    let append = |name: &str, tail: Vec<u8>| {
        case("C6", name, "SAF019", SHARD, move |d| d.shard([plain(), tail.clone()].concat()))
    };
    let cut = |name: &str, code, keep: usize| {
        case("C7", name, code, SHARD, move |d| d.shard(&file(header(&entry("a", "U8", "[100]", 0, 100)), 100)[..keep]))
    };
    let end = file(header(&entry("a", "U8", "[100]", 0, 100)), 0).len();
    let aliases: Vec<_> = (0..10_000).map(|i| bytes(&format!("t{i}"), 0, 1000)).collect();
    vec![
        of("C5", "two overlap", "SAF017", "b", [bytes("a", 0, 4), bytes("b", 2, 6)].join(","), 6),
        of("C5", "the same bytes twice", "SAF017", "b", [bytes("a", 0, 4), bytes("b", 0, 4)].join(","), 4),
        of("C5", "one inside another", "SAF017", "b", [bytes("a", 0, 8), bytes("b", 2, 4)].join(","), 8),
        of("C5", "ten thousand aliases", "SAF017", SHARD, aliases.join(","), 1000),
        of("C5", "end before begin", "SAF015", "a", entry("a", "U8", "[4]", 4, 0), 4),
        of("C6", "leading gap", "SAF018", "a", bytes("a", 4, 8), 8),
        of("C6", "hole", "SAF018", "b", [bytes("a", 0, 4), bytes("b", 6, 8)].join(","), 8),
        append("a byte too many", vec![0]),
        append("appended zip", [&b"PK\x03\x04"[..], &[0; 60]].concat()),
        append("appended NULs", vec![0; 4096]),
        append("another shard appended", plain()),
        append("appended pickle", b"\x80\x04\x95cos\nsystem\n".to_vec()),
        of(
            "C6",
            "no tensors, and data",
            "SAF019",
            SHARD,
            r#""__metadata__x":{"dtype":"U8","shape":[0],"data_offsets":[0,0]}"#.to_owned(),
            9,
        ),
        cut("one byte short", "SAF016", end + 99),
        cut("half of the data", "SAF016", end + 50),
        cut("the header alone", "SAF016", end),
        cut("inside the header", "SAF001", end - 10),
        cut("the length alone", "SAF001", 8),
        cut("inside the length", "SAF001", 5),
    ]
}

/// C8: element types.
fn types() -> Vec<Case> {
    let typed = |name: &str, dtype: &'static str| {
        case("C8", name, "SAF010", "a", move |d| d.tensors(&entry("a", dtype, "[2]", 0, 2), 2))
    };
    let of = |name: &str, text: &'static str| {
        case("C8", name, "SAF011", "a", move |d| {
            d.tensors(&format!(r#""a":{{"dtype":{text},"shape":[1],"data_offsets":[0,1]}}"#), 1);
        })
    };
    vec![
        typed("I4", "I4"),
        typed("lower case", "bf16"),
        typed("F8_E4M3FN", "F8_E4M3FN"),
        typed("none", ""),
        typed("torch's spelling", "torch.bfloat16"),
        typed("escape codes", "\\u001b[31mF32"),
        case("C8", "a megabyte", "SAF010", "a", |d| d.tensors(&entry("a", &"F".repeat(1 << 20), "[1]", 0, 1), 1)),
        of("a number", "32"),
        of("null", "null"),
        of("a list", r#"["F32"]"#),
        case("C8", "no dtype", "SAF011", "a", |d| d.tensors(r#""a":{"shape":[1],"data_offsets":[0,1]}"#, 1)),
        case("C8", "an array for an entry", "SAF011", "a", |d| d.tensors(r#""a":["U8",[1],[0,1]]"#, 1)),
        case("C8", "three offsets", "SAF011", "a", |d| {
            d.tensors(r#""a":{"dtype":"U8","shape":[1],"data_offsets":[0,1,2]}"#, 1);
        }),
        case("C8", "negative shape", "SAF011", "a", |d| d.tensors(&entry("a", "U8", "[-1]", 0, 1), 1)),
        case("C8", "fractional shape", "SAF011", "a", |d| d.tensors(&entry("a", "U8", "[1.0]", 0, 1), 1)),
    ]
}

/// C10, C12: the text of the header.
fn text() -> Vec<Case> {
    let around = |name: &str, before: &'static str, after: &'static str| {
        case("C10", name, "SAF005", SHARD, move |d| {
            let header = format!("{before}{}{after}", header(&entry("a", "U8", "[1]", 0, 1)));
            d.shard(file(header, 1));
        })
    };
    let is = |row, name: &str, text: String| case(row, name, "SAF004", SHARD, move |d| d.shard(file(&text, 1)));
    let deep = |name: &str, text: String| is("C12", name, text);
    let inside = |value: &str| header(&format!(r#""a":{{"dtype":"U8","shape":[1],"data_offsets":[0,1],"x":{value}}}"#));
    let many = 100_000;
    vec![
        around("NUL padding", "", "\0\0\0\0"),
        around("byte-order mark", "\u{feff}", ""),
        around("two objects", "", "{}"),
        around("no-break spaces", "", "\u{a0}\u{a0}"),
        around("a comma after it", "", ","),
        case("C10", "not UTF-8", "SAF004", SHARD, |d| d.shard(file(b"{\"\xff\":{}}", 0))),
        is("C10", "a list", "[]".to_owned()),
        is("C10", "half an object", "{\"a\":".to_owned()),
        is("C10", "a comma too many", "{\"__metadata__\":{\"format\":\"pt\"},}".to_owned()),
        is("C10", "NaN in an unused part", inside("NaN")),
        is("C10", "1e999 in an unused part", inside("1e999")),
        is("C10", "half a surrogate in an unused part", inside(r#""\ud800""#)),
        deep("nested in an unused part", inside(&nested("[", "]", many))),
        deep("objects", inside(&nested("{\"a\":", "}", many))),
        deep("nested in the shape", header(&entry("a", "U8", &nested("[", "]", many), 0, 1))),
        deep("nested in __metadata__", format!("{{\"__metadata__\":{}}}", nested("[", "]", many))),
        deep("nothing but brackets", "[".repeat(1_000_000)),
        case("C12", "half a million entries", "SAF004", SHARD, |d| {
            let entries: Vec<_> = (0..510_000).map(|i| entry(&i.to_string(), "U8", "[0]", 0, 0)).collect();
            d.shard(file(header(&entries.join(",")), 0));
        }),
    ]
}

/// C11: `__metadata__`.
fn metadata() -> Vec<Case> {
    let is = |name: &str, codes, value: &'static str| {
        let a = entry("a", "U8", "[1]", 0, 1);
        case("C11", name, codes, SHARD, move |d| d.shard(file(format!("{{\"__metadata__\":{value},{a}}}"), 1)))
    };
    vec![
        is("a number", "SAF007", "7"),
        is("a string", "SAF007", "\"pt\""),
        is("a list", "SAF007", "[]"),
        is("null", "SAF008", "null"),
        is("a number inside", "SAF007", r#"{"format":"pt","epoch":3}"#),
        is("null inside", "SAF007", r#"{"format":"pt","epoch":null}"#),
        is("an object inside", "SAF007", r#"{"format":"pt","config":{"a":1}}"#),
        is("used as a tensor", "SAF007", r#"{"dtype":"U8","shape":[1],"data_offsets":[0,1]}"#),
        is("no format", "SAF009", "{}"),
        is("an unknown format", "SAF009", r#"{"format":"\u001b]0;x\u0007"}"#),
        is("half a surrogate", "SAF007 SAF004", r#"{"format":"pt","x":"\ud800"}"#),
        is("half a surrogate in a key", "SAF004", r#"{"format":"pt","\ud800":"x"}"#),
    ]
}

/// C13: names that cause problems in output or as paths.
fn names() -> Vec<Case> {
    let named = |name: &str, spelling: &str| {
        let entry = entry(spelling, "U8", "[1]", 0, 1);
        case("C13", name, "SAF020", SHARD, move |d| d.tensors(&entry, 1))
    };
    vec![
        named("empty", ""),
        named("NUL", r"a\u0000b"),
        named("a megabyte", &"x".repeat(1 << 20)),
        named("escape codes", r"\u001b[2J\u001b[31mgone"),
        named("window title", r"\u001b]0;pwned\u0007"),
        named("C1 controls", r"\u009b31m"),
        named("line breaks", r"a\nerror[SAF001]: forged\r\n"),
        named("a path", "../../x"),
        named("an absolute path", "/etc/passwd"),
        named("a Windows path", r"C:\\windows\\x"),
        case("C13", "half a surrogate", "SAF004 SAF020", SHARD, |d| d.tensors(&entry(r"\ud800", "U8", "[1]", 0, 1), 1)),
        case("C13", "reordering and invisible", "", "", |d| {
            d.tensors(&entry("a\u{202e}b\u{200b}c\u{e0041}", "U8", "[1]", 0, 1), 1);
        }),
        case("C13", "a hundred thousand escape codes", "SAF020", SHARD, |d| {
            let entries: Vec<_> =
                (0..large(100_000)).map(|i| entry(&format!(r"\u001b[{i}m"), "U8", "[0]", 0, 0)).collect();
            d.tensors(&entries.join(","), 0);
        }),
    ]
}
