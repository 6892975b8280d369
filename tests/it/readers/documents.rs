//! Rows J and D of the hazards: documents.

use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Document, Fault, FaultKind, Index, line_column};
use serde_json::json;

use super::{Case, hold};

fn faults(text: impl AsRef<[u8]>) -> Vec<Fault> {
    Document::parse("config.json", text.as_ref()).faults
}

fn index_faults(text: &str) -> Vec<Fault> {
    let document = Document::parse("model.safetensors.index.json", text.as_bytes());
    Index::from_document(&document).faults
}

fn utf16(text: &str, little: bool) -> Vec<u8> {
    text.encode_utf16().flat_map(|u| if little { u.to_le_bytes() } else { u.to_be_bytes() }).collect()
}

const POINTER: &str = "version https://git-lfs.github.com/spec/v1\noid sha256:\
    4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n";

pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(cases);

fn cases() -> Vec<Case> {
    let one = |label, kind, text: &[u8]| Case::new(label, &[kind], faults(text));
    let clean = |label, text: &[u8]| Case::new(label, &[], faults(text));
    let index = |label, expected: &[FaultKind], text: &str| Case::new(label, expected, index_faults(text));
    let deep = |n: usize| format!("{{\"a\":{}{}}}", "[".repeat(n), "]".repeat(n));
    let objects = format!("{}1{}", "{\"a\":".repeat(100_000), "}".repeat(100_000));
    let digits = format!("{{\"a\": {}}}", "7".repeat(1_000_000));
    let googol4 = format!("{{\"a\": 1{}}}", "0".repeat(400));
    let many = format!("{{\"a\":[{}0]}}", "0,".repeat(2_100_000));
    let meta = r#""metadata":{"total_size":8}"#;
    let mut bom16 = vec![0xff, 0xfe];
    bom16.extend(utf16(r#"{"a": 1}"#, true));
    let utf32: Vec<u8> = r#"{"a": 1}"#.chars().flat_map(|c| u32::from(c).to_le_bytes()).collect();
    let rows = vec![
        clean("plain", b"{\"a\": [1, -2.5e-06, true, null, \"\\u00e9\"]}\n"),
        clean("empty object", b"{}"),
        clean("31-digit sentinel", b"{\"model_max_length\": 1000000000000000019884624838656}"),
        clean("127 levels", deep(126).as_bytes()),
        clean("escaped pair", br#"{"a": "\ud83d\ude00"}"#),
        clean("carriage returns", b"{\r\n\t\"a\": 1\r\n}\r\n"),
        one("128 levels", FaultKind::JsonTooDeep, deep(127).as_bytes()),
        one("100 000 arrays", FaultKind::JsonTooDeep, deep(100_000).as_bytes()),
        one("100 000 objects", FaultKind::JsonTooDeep, objects.as_bytes()),
        one("NaN", FaultKind::NonFiniteNumber, br#"{"a": NaN}"#),
        one("Infinity", FaultKind::NonFiniteNumber, br#"{"a": [Infinity, -Infinity]}"#),
        one("duplicate key", FaultKind::DuplicateJsonKey, br#"{"a": 1, "b": {}, "a": 2}"#),
        one("duplicate by escape", FaultKind::DuplicateJsonKey, br#"{"a": 1, "\u0061": 1}"#),
        one("nested duplicate", FaultKind::DuplicateJsonKey, br#"{"x": [{"a": 1, "a": 2}]}"#),
        one("trailing comma", FaultKind::TrailingComma, br#"{"a": [1, 2,], "b": 1}"#),
        one("missing comma", FaultKind::MissingComma, b"{\"a\": 1\n \"b\": [1 2]}"),
        one("comment", FaultKind::CommentInJson, b"{\"a\": 1 // one\n, /* two */ \"b\": 2}"),
        one("single quotes", FaultKind::SingleQuotedString, br"{'a': 'it\'s'}"),
        one("byte-order mark", FaultKind::ByteOrderMark, b"\xef\xbb\xbf{\"a\": 1}"),
        one("UTF-16 with mark", FaultKind::WrongEncoding, &bom16),
        one("UTF-16 without", FaultKind::WrongEncoding, &utf16(r#"{"a": 1}"#, false)),
        one("UTF-32", FaultKind::WrongEncoding, &utf32),
        one("Latin-1", FaultKind::InvalidUtf8, b"{\"a\": \"caf\xe9\"}"),
        one("NUL padding", FaultKind::NulBytes, b"{\"a\": 1}\0\0\0\0"),
        one("only NULs", FaultKind::NulBytes, &[0; 4096]),
        one("10^400", FaultKind::HugeNumber, br#"{"a": 1e400}"#),
        one("10^400 in digits", FaultKind::HugeNumber, googol4.as_bytes()),
        one("a million digits", FaultKind::HugeNumber, digits.as_bytes()),
        one("empty", FaultKind::EmptyDocument, b""),
        one("blank", FaultKind::EmptyDocument, b" \n\t\n"),
        one("list", FaultKind::NotAnObject, b"[1, 2]"),
        one("string", FaultKind::NotAnObject, b"\"Entry not found\""),
        one("second value", FaultKind::TrailingContent, b"{\"a\": 1}\n{\"b\": 2}\n"),
        one("bracket too many", FaultKind::TrailingContent, b"{\"a\": 1}}\n"),
        one("appended section", FaultKind::AppendedSection, b"{\"a\": 1}\n[http]\n\tpostBuffer = 524288000\n"),
        one(
            "conflict",
            FaultKind::MergeConflictMarker,
            b"{\n<<<<<<< HEAD\n\"a\": 1\n=======\n\"a\": 2\n>>>>>>> b\n}\n",
        ),
        one("half a conflict", FaultKind::MergeConflictMarker, b"{\n\"a\": 1,\n=======\n\"b\": 2\n}\n"),
        one("pointer", FaultKind::LfsPointer, POINTER.as_bytes()),
        one("pointer, CRLF", FaultKind::LfsPointer, POINTER.replace('\n', "\r\n").as_bytes()),
        one("pointer, hawser", FaultKind::LfsPointer, POINTER.replace("git-lfs.github", "hawser.github").as_bytes()),
        one("pointer, ext", FaultKind::LfsPointer, POINTER.replace("oid", "ext-0-foo sha256:ab\noid").as_bytes()),
        one("login page", FaultKind::HtmlInstead, b"\n<!DOCTYPE html><html><body>Sign in</body></html>"),
        one("gzip", FaultKind::HtmlInstead, b"\x1f\x8b\x08\0\0\0\0\0\0\x03"),
        one("lone surrogate", FaultKind::LoneSurrogate, br#"{"a": "\ud83d"}"#),
        one("cut off", FaultKind::JsonSyntax, br#"{"a": {"b": 1"#),
        one("Python literal", FaultKind::JsonSyntax, br#"{"a": True}"#),
        one("bare word", FaultKind::JsonSyntax, br"{a: 1}"),
        one("leading zero", FaultKind::JsonSyntax, br#"{"a": 012}"#),
        one("tab in a string", FaultKind::JsonSyntax, b"{\"a\": \"x\ty\"}"),
        one("two commas", FaultKind::JsonSyntax, br#"{"a": 1,, "b": 2}"#),
        one("comma only", FaultKind::JsonSyntax, br"{,}"),
        one("two million zeros", FaultKind::JsonTooManyValues, many.as_bytes()),
        Case::new(
            "slips together",
            &[FaultKind::MissingComma, FaultKind::TrailingComma],
            faults("{\"a\": 1\n\"b\": 2,\n}"),
        ),
        index("index", &[], &format!(r#"{{{meta},"weight_map":{{"a":"model-00001-of-00002.safetensors"}}}}"#)),
        index("float size", &[], r#"{"metadata":{"total_size":16582751232.0},"weight_map":{}}"#),
        index("no size, more keys", &[], r#"{"metadata":{"total_parameters":5},"weight_map":{}}"#),
        index("no metadata", &[FaultKind::IndexMetadataMissing], r#"{"weight_map":{}}"#),
        index("metadata null", &[FaultKind::IndexMetadataMissing], r#"{"metadata":null,"weight_map":{}}"#),
        index("no map", &[FaultKind::WeightMapMissing], &format!("{{{meta}}}")),
        index("map a list", &[FaultKind::WeightMapMalformed], &format!(r#"{{{meta},"weight_map":[]}}"#)),
        index("file a number", &[FaultKind::WeightMapMalformed], &format!(r#"{{{meta},"weight_map":{{"a":1}}}}"#)),
        index(
            "two maps",
            &[FaultKind::DuplicateIndexKey],
            &format!(r#"{{{meta},"weight_map":{{}},"weight_map":{{}}}}"#),
        ),
        index(
            "tensor twice",
            &[FaultKind::DuplicateIndexKey],
            &format!(r#"{{{meta},"weight_map":{{"a":"x","a":"y"}}}}"#),
        ),
    ];
    let unsafe_paths = [
        "../x.safetensors",
        "/dev/zero",
        "/etc/passwd",
        "a/b.safetensors",
        "a\\\\b",
        "C:x",
        ".",
        "..",
        "",
        "a\\u0000b",
        "/proc/self/environ",
    ];
    let unsafe_paths = unsafe_paths.map(str::to_owned).into_iter().chain([format!("{}.safetensors", "x".repeat(5000))]);
    let paths = unsafe_paths.map(|path| {
        index("unsafe path", &[FaultKind::IndexUnsafePath], &format!(r#"{{{meta},"weight_map":{{"a":"{path}"}}}}"#))
    });
    let sizes = ["\"8\"", "NaN", "-1", "1e40", "0.5", "null", &format!("1{}", "0".repeat(40))].map(|size| {
        let text = format!(r#"{{"metadata":{{"total_size":{size}}},"weight_map":{{}}}}"#);
        index("size", &[FaultKind::TotalSizeMalformed], &text)
    });
    rows.into_iter().chain(paths).chain(sizes).collect()
}

#[test]
fn faults_of_documents() {
    hold(&CASES);
}

#[test]
fn slips_and_non_finite_numbers_have_exact_spans() {
    let text = "{\n  \"é\": {\"x/y~z\": [0, Infinity]}\n  \"b\": 'c',\n}\n";
    let document = Document::parse("config.json", text.as_bytes());
    let place = |kind| document.faults.iter().find(|f| f.kind == kind).unwrap().places.first().unwrap().clone();
    let infinity = place(FaultKind::NonFiniteNumber);
    assert_eq!(infinity.pointer.as_deref(), Some("/é/x~1y~0z/1"));
    assert_eq!(&text[infinity.span.clone().unwrap()], "Infinity");
    assert_eq!(line_column(text, infinity.span.unwrap().start), (2, 22));
    assert_eq!(line_column(text, place(FaultKind::MissingComma).span.unwrap().start), (2, 32));
    assert_eq!(&text[place(FaultKind::SingleQuotedString).span.unwrap()], "'c'");
    assert_eq!(line_column(text, place(FaultKind::TrailingComma).span.unwrap().start), (3, 11));
    assert_eq!(document.value, Some(json!({"é": {"x/y~z": [0, null]}, "b": "c"})));
}

#[test]
fn values_and_keys_can_be_found_in_the_text() {
    let text = r#"{"a": {"b": [1, {"c": "x"}]}, "a": {"b": [2, {"c": "y"}]}}"#;
    let document = Document::parse("config.json", text.as_bytes());
    assert_eq!(document.get("/a/b/1/c"), Some(&json!("y")));
    // Of duplicate keys the last counts, and its position is returned.
    assert_eq!(document.locate("/a/b/1/c").map(|s| s.start), text.find("\"y\""));
    assert_eq!(document.locate_key("/a/b/1/c").map(|s| &text[s]), Some("\"c\""));
    assert_eq!(document.locate(""), Some(0..text.len()));
    assert_eq!(document.locate_key("/a/b/1"), None);
    assert_eq!(document.locate("/a/z"), None);
    assert_eq!(document.locate("a"), None);
}

#[test]
fn numbers_are_integers_or_doubles() {
    let text = "{\"eps\": 1e-06, \"n\": 1000000000000000019884624838656, \"f\": 10.0}";
    let document = Document::parse("config.json", text.as_bytes());
    assert_eq!(document.value, Some(json!({ "eps": 1e-6, "n": 1e30, "f": 10.0 })));
    // The text of a number stays in the document; what is copied from it is spelled the same (`spelling`).
    assert_eq!(document.text.as_deref(), Some(text));
}

#[test]
fn duplicates_state_whether_their_values_differ() {
    let document = Document::parse("config.json", br#"{"a": {"x": 1}, "b": 1, "a": {"x" : 1}, "b": 2}"#);
    let equal: Vec<_> = document.faults.iter().map(|f| (f.detail["key"].clone(), f.detail["equal"].clone())).collect();
    assert_eq!(equal, [(json!("a"), json!(true)), (json!("b"), json!(false))]);
    assert_eq!(document.get("/b"), Some(&json!(2)));
}

#[test]
fn only_documents_that_parse_have_a_value() {
    let value = |text: &[u8]| Document::parse("config.json", text).value;
    assert_eq!(value(b"{\"a\": 1}\n[http]\n\tx = 1\n"), Some(json!({"a": 1})));
    assert_eq!(value(b"{\"a\": 1,\n=======\n\"b\": 2}"), Some(json!({"a": 1, "b": 2})));
    assert_eq!(value(&utf16("{\"a\": 1}", true)), Some(json!({"a": 1})));
    assert_eq!(value(b"{\"a\": 1}\0\0"), Some(json!({"a": 1})));
    // A key that is missing here may be in the unread part.
    assert_eq!(value(b"{\"a\": 1, \"b\""), None);
    assert_eq!(value("[".repeat(100_000).as_bytes()), None);
}

#[test]
fn a_crafted_object_does_not_become_a_number() {
    let document = Document::parse("config.json", br#"{"a": {"$serde_json::private::Number": "1e999"}}"#);
    assert!(document.get("/a").unwrap().is_object());
}

#[test]
fn faults_of_one_kind_are_capped_and_counted() {
    let text = format!("{{\"a\": [{}1]}}", "1 ".repeat(1000));
    let faults = faults(text);
    assert_eq!(faults.len(), 64);
    assert_eq!(faults.last().unwrap().hidden, 1000 - 64);
}

#[test]
fn planned_documents_are_formatted_as_by_hugging_face() {
    let document = Document::from_value("config.json", json!({"b": 1, "a": [2]}));
    assert_eq!(document.text.as_deref(), Some("{\n  \"b\": 1,\n  \"a\": [\n    2\n  ]\n}\n"));
    assert_eq!(document.locate("/a/0").map(|s| s.len()), Some(1));
}
