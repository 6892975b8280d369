//! Rows C and D of the hazards: the container.

use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Fault, Shard};
use serde_json::json;

use super::{Case, hold};

/// A file of this header and `data` zero bytes.
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
    let case = |label, expected: &[&'static str], faults| Case::new(label, expected, faults);
    let raw = |label, expected: &[&'static str], bytes: &[u8]| Case::new(label, expected, read(bytes).faults);
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
        // C14: clean oddities.
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
        raw("empty", &["empty-file"], b""),
        raw("short", &["file-too-short"], b"\x02\0\0"),
        raw("length 0", &["header-length-out-of-range"], &length(0, 20)),
        raw("length beyond the file", &["header-length-out-of-range"], &length(1000, 20)),
        raw("length 2^63", &["header-length-out-of-range"], &length(1 << 63, 20)),
        raw("length 2^64-8", &["header-length-out-of-range"], &length(u64::MAX - 7, 20)),
        raw("big-endian", &["header-length-out-of-range"], &swapped),
        case(
            "length over the format's limit",
            &["header-too-large"],
            Shard::parse("m.safetensors", 1 << 40, &length(100_000_001, 20)).faults,
        ),
        case("header not read", &["unreadable-file"], Shard::parse("m.safetensors", 1 << 40, &length(1000, 20)).faults),
        // C2, C3: arithmetic.
        case("eight of 2^61-1", &["shard-truncated"], of(&huge.join(","), 8)),
        case("product overflows", &["shape-overflow"], of(&entry("a", "U8", "[4294967296,4294967296,2]", 0, 4), 4)),
        case("wraps to the size", &["shape-overflow"], of(&entry("a", "F32", "[4611686018427387905]", 0, 4), 4)),
        case("zero after overflow", &["shape-overflow"], of(&entry("a", "U8", "[9223372036854775808,4,0]", 0, 0), 0)),
        case(
            "offset 2^64",
            &["entry-malformed"],
            of(r#""a":{"dtype":"U8","shape":[0],"data_offsets":[0,18446744073709551616]}"#, 0),
        ),
        case(
            "largest offset",
            &["shape-byte-mismatch", "shard-truncated"],
            of(&entry("a", "U8", "[1]", 0, u64::MAX), 1),
        ),
        // C4: duplicates.
        case("tensor twice", &["duplicate-header-key"], of(&format!("{},{}", f(0, 4), f(0, 4)), 4)),
        case(
            "twice by escape",
            &["duplicate-header-key"],
            of(&format!("{},{}", f(0, 4), entry("\\u0061", "U8", "[4]", 0, 4)), 4),
        ),
        case(
            "field twice",
            &["duplicate-header-key"],
            of(r#""a":{"dtype":"U8","dtype":"U8","shape":[1],"data_offsets":[0,1]}"#, 1),
        ),
        raw(
            "metadata twice",
            &["duplicate-header-key"],
            &file(br#"{"__metadata__":{"format":"pt"},"__metadata__":{"format":"pt"}}"#, 0),
        ),
        case("metadata key twice", &["duplicate-header-key"], meta(r#"{"format":"pt","format":"pt"}"#)),
        // C5, C6: overlap and holes.
        case(
            "overlap",
            &["tensors-overlap", "trailing-bytes"],
            two(&entry("a", "F32", "[1]", 0, 4), &entry("b", "F32", "[1]", 2, 6)),
        ),
        case("the same bytes", &["tensors-overlap"], of(&[f(0, 4), entry("b", "F32", "[1]", 0, 4)].join(","), 4)),
        case("empty inside another", &["tensors-overlap"], of(&[f(0, 4), entry("b", "F32", "[0]", 2, 2)].join(","), 4)),
        case("hole", &["data-hole"], of(&[entry("a", "U8", "[1]", 0, 1), entry("b", "U8", "[1]", 2, 3)].join(","), 3)),
        case("leading gap", &["data-hole"], of(&f(4, 8), 8)),
        case("trailing bytes", &["trailing-bytes"], of(&f(0, 4), 5)),
        // C7, C8, C9: sizes and types.
        case("truncated", &["shard-truncated"], of(&f(0, 4), 3)),
        case("unknown dtype", &["unknown-dtype"], of(&entry("a", "I4", "[2]", 0, 1), 1)),
        case("lower case", &["unknown-dtype"], of(&entry("a", "f32", "[1]", 0, 4), 4)),
        case("half a byte", &["sub-byte-misaligned"], of(&entry("a", "F4", "[3]", 0, 2), 2)),
        case("wrong shape", &["shape-byte-mismatch"], of(&entry("a", "F32", "[2]", 0, 4), 4)),
        case("end before begin", &["offsets-out-of-order"], of(&entry("a", "F32", "[1]", 4, 0), 4)),
        case("negative", &["entry-malformed"], of(r#""a":{"dtype":"U8","shape":[-1],"data_offsets":[0,0]}"#, 0)),
        case("float", &["entry-malformed"], of(r#""a":{"dtype":"U8","shape":[1.0],"data_offsets":[0,1]}"#, 1)),
        case("three offsets", &["entry-malformed"], of(r#""a":{"dtype":"U8","shape":[1],"data_offsets":[0,1,1]}"#, 1)),
        case("no shape", &["entry-malformed"], of(r#""a":{"dtype":"U8","data_offsets":[0,1]}"#, 1)),
        case("not an object", &["entry-malformed"], of(r#""a":7"#, 0)),
        // C10: padding.
        raw("NUL padding", &["header-padding-not-spaces"], &with("", "\0\0\0")),
        raw("byte-order mark", &["header-padding-not-spaces"], &with("\u{feff}", "")),
        raw("two objects", &["header-padding-not-spaces"], &with("", "{}")),
        // C11: metadata.
        case("metadata a number", &["metadata-not-strings", "no-format-metadata"], meta("7")),
        case("metadata value a number", &["metadata-not-strings"], meta(r#"{"format":"pt","n":1}"#)),
        case("metadata null", &["metadata-null", "no-format-metadata"], meta("null")),
        case(
            "metadata a tensor",
            &["metadata-not-strings", "no-format-metadata"],
            meta(r#"{"dtype":"U8","shape":[0],"data_offsets":[0,0]}"#),
        ),
        raw("no metadata", &["no-format-metadata"], &file(b"{}", 0)),
        case("unknown format", &["no-format-metadata"], meta(r#"{"format":"np"}"#)),
        // C12, C13.
        raw("deep", &["header-too-deep"], &file(deep.as_bytes(), 0)),
        raw(
            "half a million entries",
            &["json-too-many-values"],
            &file(format!("{{\"__metadata__\":{{{crowd}\"format\":\"pt\"}}}}").as_bytes(), 0),
        ),
        raw("not UTF-8", &["header-not-utf8"], &file(b"{\"\xff\":1}", 0)),
        raw("not JSON", &["header-not-json"], &file(b"{\"a\":", 0)),
        raw("trailing comma", &["header-not-json"], &file(b"{\"__metadata__\":{\"format\":\"pt\"},}", 0)),
        case(
            "NaN",
            &["entry-malformed", "header-not-json"],
            of(r#""a":{"dtype":"U8","shape":[NaN],"data_offsets":[0,1]}"#, 1),
        ),
        case("no name", &["odd-tensor-name"], name("")),
        case("NUL", &["odd-tensor-name"], name("a\\u0000")),
        case("escape code", &["odd-tensor-name"], name("\\u001b[31m")),
        case("path", &["odd-tensor-name"], name("../../x")),
        case("1 MiB", &["odd-tensor-name"], name(&"x".repeat(1 << 20))),
        case("lone surrogate", &["odd-tensor-name", "header-not-json"], name("\\ud800")),
        // D1, D4: something else.
        raw("pointer", &["lfs-pointer"], pointer),
        raw("web page", &["not-safetensors"], b"<!DOCTYPE html>\n<html><head><title>Sign in</title>"),
        raw("JSON error", &["not-safetensors"], br#"{"error":"Repository not found"}"#),
        raw("text", &["not-safetensors"], b"Invalid username or password."),
        raw("gzip", &["not-safetensors"], b"\x1f\x8b\x08\0\0\0\0\0\0\x03abcdef"),
        raw("zip", &["not-safetensors"], b"PK\x03\x04\x14\0\0\0\0\0\0\0"),
        raw("pickle", &["not-safetensors"], b"\x80\x02}q\0(X\x05\0\0\0a"),
        raw("GGUF", &["not-safetensors"], b"GGUF\x03\0\0\0\x01\0\0\0"),
        raw("NULs", &["not-safetensors"], &[0; 4096]),
    ]
}

#[test]
fn each_fault_of_the_container_is_named() {
    hold(&CASES);
}

#[test]
fn faults_name_file_tensor_and_figures() {
    let entries = [entry("first", "F32", "[1]", 0, 4), entry("second", "BF16", "[2,3]", 4, 14)].join(",");
    let faults = of(&entries, 7);
    let by = |kind| faults.iter().find(|f| f.kind == kind).unwrap();
    let mismatch = by("shape-byte-mismatch");
    assert_eq!(mismatch.places[0].file.as_deref(), Some("model.safetensors"));
    assert_eq!(mismatch.places[0].tensor.as_deref(), Some("second"));
    assert_eq!(mismatch.detail["computed"], json!(12));
    assert_eq!(mismatch.detail["stored"], json!(10));
    assert_eq!(mismatch.detail["shape"], json!([2, 3]));
    let truncated = by("shard-truncated");
    assert_eq!(truncated.places[0].tensor.as_deref(), Some("second"));
    assert_eq!(truncated.detail["missing"], json!(7));
}

#[test]
fn every_fault_of_a_header_is_reported_not_the_first_alone() {
    let entries = [
        entry("a", "F99", "[1]", 0, 4),
        entry("b", "F32", "[2]", 4, 8),
        entry("", "U8", "[1]", 8, 9),
        r#""c":{"dtype":"U8"}"#.to_owned(),
    ];
    let shard = read(&file(format!("{{{}}}", entries.join(",")).as_bytes(), 9));
    let kinds: Vec<_> = shard.faults.iter().map(|f| f.kind).collect();
    for kind in ["unknown-dtype", "shape-byte-mismatch", "odd-tensor-name", "entry-malformed", "no-format-metadata"] {
        assert!(kinds.contains(&kind), "{kind} in {kinds:?}");
    }
    assert_eq!(shard.unreadable, ["a", "c"]);
    assert!(shard.tensor("b").is_some() && !shard.unread);
}

#[test]
fn entries_keep_header_order_and_the_last_of_two_wins() {
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
    assert_eq!(faults.last().unwrap().detail["more"], json!(99_999 - 64));
}

#[test]
fn big_endian_lengths_are_recognised() {
    let mut bytes = file(br#"{"__metadata__":{"format":"pt"}}"#, 0);
    bytes[..8].reverse();
    assert_eq!(read(&bytes).faults[0].detail["big_endian"], json!(true));
    bytes[..8].fill(0xfe);
    assert_eq!(read(&bytes).faults[0].detail["big_endian"], json!(false));
}
