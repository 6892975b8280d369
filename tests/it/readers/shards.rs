//! Rows C and D of the hazards: the container.

use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Fault, FaultKind, Shard};
use serde_json::json;

use super::{Case, hold};

/// A file with this header and `data` zero bytes.
pub fn file(header: &[u8], data: usize) -> Vec<u8> {
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header);
    bytes.resize(bytes.len() + data, 0);
    bytes
}

pub fn read(bytes: &[u8]) -> Shard {
    Shard::parse("model.safetensors", bytes.len() as u64, bytes)
}

fn of(entries: &str, data: usize) -> Vec<Fault> {
    read(&file(format!("{{\"__metadata__\":{{\"format\":\"pt\"}},{entries}}}").as_bytes(), data)).faults
}

fn entry(name: &str, dtype: &str, shape: &str, begin: u64, end: u64) -> String {
    format!(r#""{name}":{{"dtype":"{dtype}","shape":{shape},"data_offsets":[{begin},{end}]}}"#)
}

pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(cases);

fn cases() -> Vec<Case> {
    let case = |label, expected: &[FaultKind], faults| Case::new(label, expected, faults);
    let raw = |label, expected: &[FaultKind], bytes: &[u8]| Case::new(label, expected, read(bytes).faults);
    let f = |begin, end| entry("a", "F32", "[1]", begin, end);
    let good = format!("{{\"__metadata__\":{{\"format\":\"pt\"}},{}}}", f(0, 4));
    let with = |before: &str, after: &str| file(format!("{before}{good}{after}").as_bytes(), 4);
    let mut swapped = file(good.as_bytes(), 4);
    swapped[..8].reverse();
    let length = |n: u64, rest: usize| {
        let mut bytes = n.to_le_bytes().to_vec();
        bytes.extend(vec![0xee; rest]);
        bytes
    };
    let huge: Vec<_> = (0..8)
        .map(|i| {
            let size = (1_u64 << 61) - 1;
            entry(&format!("t{i}"), "U8", &format!("[{size}]"), i * size, (i + 1) * size)
        })
        .collect();
    let deep = format!("{{\"a\":{}{}}}", "[".repeat(100_000), "]".repeat(100_000));
    let crowd = (0..500_000).map(|i| format!("\"{i}\":\"\",")).collect::<Vec<_>>().concat();
    let two = |a: &str, b: &str| of(&format!("{a},{b}"), 8);
    let meta = |text: &str| read(&file(format!("{{\"__metadata__\":{text}}}").as_bytes(), 0)).faults;
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 9\n";
    let name = |name: &str| of(&entry(name, "U8", "[1]", 0, 1), 1);
    vec![
        // C14: unusual but valid.
        raw("plain", &[], &file(good.as_bytes(), 4)),
        raw("leading space", &[], &with(" \n", "")),
        raw("20 MB padding", &[], &with("", &" ".repeat(20_000_000))),
        raw("unaligned header", &[], &with("", " ")),
        case(
            "unaligned tensors",
            &[],
            of(&[entry("a", "U8", "[1]", 0, 1), entry("b", "F32", "[1]", 1, 5)].join(","), 5),
        ),
        case("any order", &[], two(&entry("a", "F32", "[1]", 4, 8), &entry("b", "F32", "[1]", 0, 4))),
        case("no elements", &[], of(&[entry("a", "F32", "[3,0]", 0, 0), entry("b", "U8", "[1]", 0, 1)].join(","), 1)),
        case("no dimensions", &[], of(&entry("a", "F64", "[]", 0, 8), 8)),
        case("sub-byte", &[], of(&[entry("a", "F4", "[2]", 0, 1), entry("b", "F6_E2M3", "[4]", 1, 4)].join(","), 4)),
        case("keys in any order", &[], of(r#""a":{"data_offsets":[0,1],"shape":[1],"dtype":"U8"}"#, 1)),
        raw("no tensors", &[], &file(br#"{"__metadata__":{"format":"pt"}}"#, 0)),
        // C1: the length field.
        raw("empty", &[FaultKind::EmptyFile], b""),
        raw("short", &[FaultKind::FileTooShort], b"\x02\0\0"),
        raw("length 0", &[FaultKind::HeaderLengthOutOfRange], &length(0, 20)),
        raw("length beyond the file", &[FaultKind::HeaderLengthOutOfRange], &length(1000, 20)),
        raw("length 2^63", &[FaultKind::HeaderLengthOutOfRange], &length(1 << 63, 20)),
        raw("length 2^64-8", &[FaultKind::HeaderLengthOutOfRange], &length(u64::MAX - 7, 20)),
        raw("big-endian", &[FaultKind::HeaderLengthOutOfRange], &swapped),
        case(
            "length over the format's limit",
            &[FaultKind::HeaderTooLarge],
            Shard::parse("m.safetensors", 1 << 40, &length(100_000_001, 20)).faults,
        ),
        case(
            "header not read",
            &[FaultKind::UnreadableFile],
            Shard::parse("m.safetensors", 1 << 40, &length(1000, 20)).faults,
        ),
        // C2, C3: arithmetic.
        case("eight of 2^61-1", &[FaultKind::ShardTruncated], of(&huge.join(","), 8)),
        case(
            "product overflows",
            &[FaultKind::ShapeOverflow],
            of(&entry("a", "U8", "[4294967296,4294967296,2]", 0, 4), 4),
        ),
        case(
            "wraps to the size",
            &[FaultKind::ShapeOverflow],
            of(&entry("a", "F32", "[4611686018427387905]", 0, 4), 4),
        ),
        case(
            "zero after overflow",
            &[FaultKind::ShapeOverflow],
            of(&entry("a", "U8", "[9223372036854775808,4,0]", 0, 0), 0),
        ),
        case(
            "offset 2^64",
            &[FaultKind::EntryMalformed],
            of(r#""a":{"dtype":"U8","shape":[0],"data_offsets":[0,18446744073709551616]}"#, 0),
        ),
        case(
            "largest offset",
            &[FaultKind::ShapeByteMismatch, FaultKind::ShardTruncated],
            of(&entry("a", "U8", "[1]", 0, u64::MAX), 1),
        ),
        // C4: duplicates.
        case("tensor twice", &[FaultKind::DuplicateHeaderKey], of(&format!("{},{}", f(0, 4), f(0, 4)), 4)),
        case(
            "twice by escape",
            &[FaultKind::DuplicateHeaderKey],
            of(&format!("{},{}", f(0, 4), entry("\\u0061", "U8", "[4]", 0, 4)), 4),
        ),
        case(
            "field twice",
            &[FaultKind::DuplicateHeaderKey],
            of(r#""a":{"dtype":"U8","dtype":"U8","shape":[1],"data_offsets":[0,1]}"#, 1),
        ),
        raw(
            "metadata twice",
            &[FaultKind::DuplicateHeaderKey],
            &file(br#"{"__metadata__":{"format":"pt"},"__metadata__":{"format":"pt"}}"#, 0),
        ),
        case("metadata key twice", &[FaultKind::DuplicateHeaderKey], meta(r#"{"format":"pt","format":"pt"}"#)),
        // C5, C6: overlap and holes.
        case(
            "overlap",
            &[FaultKind::TensorsOverlap, FaultKind::TrailingBytes],
            two(&entry("a", "F32", "[1]", 0, 4), &entry("b", "F32", "[1]", 2, 6)),
        ),
        case(
            "the same bytes",
            &[FaultKind::TensorsOverlap],
            of(&[f(0, 4), entry("b", "F32", "[1]", 0, 4)].join(","), 4),
        ),
        case(
            "empty inside another",
            &[FaultKind::TensorsOverlap],
            of(&[f(0, 4), entry("b", "F32", "[0]", 2, 2)].join(","), 4),
        ),
        case(
            "hole",
            &[FaultKind::DataHole],
            of(&[entry("a", "U8", "[1]", 0, 1), entry("b", "U8", "[1]", 2, 3)].join(","), 3),
        ),
        case("leading gap", &[FaultKind::DataHole], of(&f(4, 8), 8)),
        case("trailing bytes", &[FaultKind::TrailingBytes], of(&f(0, 4), 5)),
        // C7, C8, C9: sizes and types.
        case("truncated", &[FaultKind::ShardTruncated], of(&f(0, 4), 3)),
        case("unknown dtype", &[FaultKind::UnknownDtype], of(&entry("a", "I4", "[2]", 0, 1), 1)),
        case("lower case", &[FaultKind::UnknownDtype], of(&entry("a", "f32", "[1]", 0, 4), 4)),
        case("half a byte", &[FaultKind::SubByteMisaligned], of(&entry("a", "F4", "[3]", 0, 2), 2)),
        case("wrong shape", &[FaultKind::ShapeByteMismatch], of(&entry("a", "F32", "[2]", 0, 4), 4)),
        case("end before begin", &[FaultKind::OffsetsOutOfOrder], of(&entry("a", "F32", "[1]", 4, 0), 4)),
        case(
            "negative",
            &[FaultKind::EntryMalformed],
            of(r#""a":{"dtype":"U8","shape":[-1],"data_offsets":[0,0]}"#, 0),
        ),
        case("float", &[FaultKind::EntryMalformed], of(r#""a":{"dtype":"U8","shape":[1.0],"data_offsets":[0,1]}"#, 1)),
        case(
            "three offsets",
            &[FaultKind::EntryMalformed],
            of(r#""a":{"dtype":"U8","shape":[1],"data_offsets":[0,1,1]}"#, 1),
        ),
        case("no shape", &[FaultKind::EntryMalformed], of(r#""a":{"dtype":"U8","data_offsets":[0,1]}"#, 1)),
        case("not an object", &[FaultKind::EntryMalformed], of(r#""a":7"#, 0)),
        // C10: padding.
        raw("NUL padding", &[FaultKind::HeaderPaddingNotSpaces], &with("", "\0\0\0")),
        raw("byte-order mark", &[FaultKind::HeaderPaddingNotSpaces], &with("\u{feff}", "")),
        raw("two objects", &[FaultKind::HeaderPaddingNotSpaces], &with("", "{}")),
        // C11: metadata.
        case("metadata a number", &[FaultKind::MetadataNotStrings, FaultKind::NoFormatMetadata], meta("7")),
        case("metadata value a number", &[FaultKind::MetadataNotStrings], meta(r#"{"format":"pt","n":1}"#)),
        case("metadata null", &[FaultKind::MetadataNull, FaultKind::NoFormatMetadata], meta("null")),
        case(
            "metadata a tensor",
            &[FaultKind::MetadataNotStrings, FaultKind::NoFormatMetadata],
            meta(r#"{"dtype":"U8","shape":[0],"data_offsets":[0,0]}"#),
        ),
        raw("no metadata", &[FaultKind::NoFormatMetadata], &file(b"{}", 0)),
        case("unknown format", &[FaultKind::NoFormatMetadata], meta(r#"{"format":"np"}"#)),
        // C12, C13.
        raw("deep", &[FaultKind::HeaderTooDeep], &file(deep.as_bytes(), 0)),
        raw(
            "half a million entries",
            &[FaultKind::JsonTooManyValues],
            &file(format!("{{\"__metadata__\":{{{crowd}\"format\":\"pt\"}}}}").as_bytes(), 0),
        ),
        raw("not UTF-8", &[FaultKind::HeaderNotUtf8], &file(b"{\"\xff\":1}", 0)),
        raw("not JSON", &[FaultKind::HeaderNotJson], &file(b"{\"a\":", 0)),
        raw("trailing comma", &[FaultKind::HeaderNotJson], &file(b"{\"__metadata__\":{\"format\":\"pt\"},}", 0)),
        case(
            "NaN",
            &[FaultKind::EntryMalformed, FaultKind::HeaderNotJson],
            of(r#""a":{"dtype":"U8","shape":[NaN],"data_offsets":[0,1]}"#, 1),
        ),
        case("no name", &[FaultKind::OddTensorName], name("")),
        case("NUL", &[FaultKind::OddTensorName], name("a\\u0000")),
        case("escape code", &[FaultKind::OddTensorName], name("\\u001b[31m")),
        case("path", &[FaultKind::OddTensorName], name("../../x")),
        case("1 MiB", &[FaultKind::OddTensorName], name(&"x".repeat(1 << 20))),
        case("lone surrogate", &[FaultKind::OddTensorName, FaultKind::HeaderNotJson], name("\\ud800")),
        // D1, D4: other formats.
        raw("pointer", &[FaultKind::LfsPointer], pointer),
        raw("web page", &[FaultKind::NotSafetensors], b"<!DOCTYPE html>\n<html><head><title>Sign in</title>"),
        raw("JSON error", &[FaultKind::NotSafetensors], br#"{"error":"Repository not found"}"#),
        raw("text", &[FaultKind::NotSafetensors], b"Invalid username or password."),
        raw("gzip", &[FaultKind::NotSafetensors], b"\x1f\x8b\x08\0\0\0\0\0\0\x03abcdef"),
        raw("zip", &[FaultKind::NotSafetensors], b"PK\x03\x04\x14\0\0\0\0\0\0\0"),
        raw("pickle", &[FaultKind::NotSafetensors], b"\x80\x02}q\0(X\x05\0\0\0a"),
        raw("GGUF", &[FaultKind::NotSafetensors], b"GGUF\x03\0\0\0\x01\0\0\0"),
        raw("NULs", &[FaultKind::NotSafetensors], &[0; 4096]),
    ]
}

#[test]
fn faults_of_the_container() {
    hold(&CASES);
}

#[test]
fn faults_name_file_tensor_and_figures() {
    let entries = [entry("first", "F32", "[1]", 0, 4), entry("second", "BF16", "[2,3]", 4, 14)].join(",");
    let faults = of(&entries, 7);
    let by = |kind| faults.iter().find(|f| f.kind == kind).unwrap();
    let mismatch = by(FaultKind::ShapeByteMismatch);
    assert_eq!(mismatch.places[0].file.as_deref(), Some("model.safetensors"));
    assert_eq!(mismatch.places[0].tensor.as_deref(), Some("second"));
    assert_eq!(mismatch.detail["computed"], json!(12));
    assert_eq!(mismatch.detail["stored"], json!(10));
    assert_eq!(mismatch.detail["shape"], json!([2, 3]));
    let truncated = by(FaultKind::ShardTruncated);
    assert_eq!(truncated.places[0].tensor.as_deref(), Some("second"));
    assert_eq!(truncated.detail["missing"], json!(7));
}

#[test]
fn all_faults_of_a_header_are_reported() {
    let entries = [
        entry("a", "F99", "[1]", 0, 4),
        entry("b", "F32", "[2]", 4, 8),
        entry("", "U8", "[1]", 8, 9),
        r#""c":{"dtype":"U8"}"#.to_owned(),
    ];
    let shard = read(&file(format!("{{{}}}", entries.join(",")).as_bytes(), 9));
    let kinds: Vec<_> = shard.faults.iter().map(|f| f.kind).collect();
    for kind in [
        FaultKind::UnknownDtype,
        FaultKind::ShapeByteMismatch,
        FaultKind::OddTensorName,
        FaultKind::EntryMalformed,
        FaultKind::NoFormatMetadata,
    ] {
        assert!(kinds.contains(&kind), "{kind} in {kinds:?}");
    }
    assert_eq!(shard.unreadable, ["a", "c"]);
    assert!(shard.tensor("b").is_some() && !shard.unread);
}

#[test]
fn entries_keep_header_order_and_the_last_duplicate() {
    let entries =
        [entry("b", "U8", "[4]", 0, 4), entry("a", "U8", "[1]", 4, 5), entry("b", "F32", "[1]", 0, 4)].join(",");
    let shard = read(&file(format!("{{{entries}}}").as_bytes(), 5));
    let names: Vec<_> = shard.tensors.iter().map(|t| (t.name.as_str(), t.dtype.name())).collect();
    assert_eq!(names, [("a", "U8"), ("b", "F32")]);
}

#[test]
fn a_hundred_thousand_faults_are_capped_and_counted() {
    let entries: Vec<_> = (0..100_000).map(|i| entry(&format!("t{i}"), "F32", "[1]", 0, 4)).collect();
    let faults = of(&entries.join(","), 4);
    assert_eq!(faults.len(), 64);
    assert_eq!(faults.last().unwrap().hidden, 99_999 - 64);
}

#[test]
fn big_endian_lengths_are_recognised() {
    let mut bytes = file(br#"{"__metadata__":{"format":"pt"}}"#, 0);
    bytes[..8].reverse();
    assert_eq!(read(&bytes).faults[0].detail["big_endian"], json!(true));
    bytes[..8].fill(0xfe);
    assert_eq!(read(&bytes).faults[0].detail["big_endian"], json!(false));
}

/// What each fault of an entry, and of the layout, says besides its kind.
#[test]
fn faults_state_what_is_wrong() {
    let dup = |key: &str| of(&entry("a", "U8", "[1]", 0, 1).replacen('{', &format!("{{{key},"), 1), 1);
    let reason = |reason: &str| json!({ "reason": reason });
    let u8s = |begin, end| entry("a", "U8", "[4]", begin, end);
    let after =
        |text: &str| read(&file(format!("{{\"__metadata__\":{{\"format\":\"pt\"}}}}{text}").as_bytes(), 0)).faults;
    for (label, faults, kind, detail) in [
        ("hole", of(&u8s(3, 7), 7), FaultKind::DataHole, json!({"begin": 0, "end": 3, "bytes": 3})),
        (
            "overlap",
            of(&[u8s(0, 4), entry("b", "U8", "[4]", 3, 7)].join(","), 7),
            FaultKind::TensorsOverlap,
            json!({"begin": 3, "bytes": 1}),
        ),
        ("rest", of(&u8s(0, 4), 6), FaultKind::TrailingBytes, json!({"count": 2})),
        ("order", of(&u8s(4, 0), 0), FaultKind::OffsetsOutOfOrder, json!({"begin": 4, "end": 0})),
        (
            "size",
            of(&entry("a", "U16", "[4]", 0, 4), 4),
            FaultKind::ShapeByteMismatch,
            json!({"dtype": "U16", "shape": [4], "computed": 8, "stored": 4}),
        ),
        (
            "bits",
            of(&entry("a", "F4", "[3]", 0, 2), 2),
            FaultKind::SubByteMisaligned,
            json!({"dtype": "F4", "shape": [3], "bits": 12}),
        ),
        ("two dtypes", dup(r#""dtype":"U8""#), FaultKind::DuplicateHeaderKey, json!({"key": "dtype"})),
        ("two shapes", dup(r#""shape":[1]"#), FaultKind::DuplicateHeaderKey, json!({"key": "shape"})),
        ("two offsets", dup(r#""data_offsets":[0,1]"#), FaultKind::DuplicateHeaderKey, json!({"key": "data_offsets"})),
        ("NUL", after("\0"), FaultKind::HeaderPaddingNotSpaces, json!({"what": "NUL bytes"})),
        ("object", after("{}"), FaultKind::HeaderPaddingNotSpaces, json!({"what": "a second object"})),
        ("text", after("x"), FaultKind::HeaderPaddingNotSpaces, json!({"what": "other bytes"})),
        ("no object", of(r#""a":1"#, 0), FaultKind::EntryMalformed, reason("it is not an object")),
        (
            "three offsets",
            of(r#""a":{"dtype":"U8","shape":[1],"data_offsets":[0,1,2]}"#, 0),
            FaultKind::EntryMalformed,
            reason("`data_offsets` is not two natural numbers"),
        ),
        (
            "a negative size",
            of(r#""a":{"dtype":"U8","shape":[-1,1],"data_offsets":[0,1]}"#, 1),
            FaultKind::EntryMalformed,
            reason("`shape` is not a list of natural numbers"),
        ),
    ] {
        let [fault] = faults.as_slice() else { panic!("{label}: {faults:?}") };
        assert_eq!((fault.kind, serde_json::Value::from(fault.detail.clone())), (kind, detail), "{label}");
    }
    let lacking = of(r#""a":{}"#, 0);
    let reasons: Vec<_> = lacking.iter().map(|fault| fault.detail["reason"].as_str().unwrap()).collect();
    assert_eq!(reasons, ["it has no `dtype`", "it has no `shape`", "it has no `data_offsets`"]);
}

#[test]
fn numbers_and_truth_values_of_the_metadata_are_kept_as_text() {
    let shard = read(&file(br#"{"__metadata__":{"format":"pt","n":1.50,"b":true,"l":[1],"z":null}}"#, 0));
    let metadata = shard.metadata().unwrap().iter().map(|(key, value)| (key.as_str(), value.as_str()));
    assert_eq!(metadata.collect::<Vec<_>>(), [("b", "true"), ("format", "pt"), ("n", "1.50")]);
    let said: Vec<_> = shard.faults.iter().map(|fault| (fault.kind, fault.detail["key"].as_str().unwrap())).collect();
    assert_eq!(said, ["n", "b", "l", "z"].map(|key| (FaultKind::MetadataNotStrings, key)));
    let scalars: Vec<_> = shard.faults.iter().map(|fault| fault.detail["scalar"].clone()).collect();
    assert_eq!(scalars, [true, true, false, false].map(serde_json::Value::from));
}

/// A header of more bytes than the first read of the file has, and one that is larger than the file.
#[test]
fn a_long_header_is_read_whole() {
    for names in [1, 40, 4000] {
        let entries: Vec<_> = (0..names).map(|n| entry(&format!("layer.{n:04}"), "U8", "[1]", n, n + 1)).collect();
        let header = format!("{{\"__metadata__\":{{\"format\":\"pt\"}},{}}}", entries.join(","));
        let bytes = file(header.as_bytes(), usize::try_from(names).unwrap());
        let found = super::open_with("model.safetensors", &bytes);
        let shard = &found.shards["model.safetensors"];
        assert_eq!((shard.tensors.len() as u64, shard.unread), (names, false), "{:?}", shard.faults);
        let cut = super::open_with("model.safetensors", &bytes[..header.len()]);
        let cut = &cut.shards["model.safetensors"];
        let kinds: Vec<_> = cut.faults.iter().map(|fault| fault.kind).collect();
        assert_eq!((kinds, cut.unread), (vec![FaultKind::HeaderLengthOutOfRange], true));
    }
}

#[test]
fn text_in_place_of_a_header_is_quoted_and_other_bytes_are_not() {
    for (bytes, what) in [
        (&b"[1, 2, 3]\n"[..], Some("a JSON document: [1, 2, 3]")),
        (b"{ \"a\": 1 }", Some("a JSON document: { \"a\": 1 }")),
        (b"Not Found here", Some("a text file: Not Found here")),
        (b"{ \"a\": 1 \xff }", None),
        (b"Not Found \xff here", None),
    ] {
        let fault = &read(bytes).faults[0];
        assert_eq!(fault.detail.get("what").and_then(|what| what.as_str()), what);
        assert_eq!(fault.kind == FaultKind::NotSafetensors, what.is_some(), "{:?}", fault.kind);
    }
}

#[test]
fn a_name_of_more_than_a_kibibyte_is_odd() {
    let kinds =
        |len: usize| of(&entry(&"x".repeat(len), "U8", "[1]", 0, 1), 1).iter().map(|f| f.kind).collect::<Vec<_>>();
    assert_eq!((kinds(1024), kinds(1025)), (vec![], vec![FaultKind::OddTensorName]));
}
