//! Edits of real documents: all other bytes stay unchanged.

use std::fs;
use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Document, FaultKind, spliced};
use proptest::prelude::*;
use proptest::sample::Index;
use serde_json::{Value, json};

use crate::support;

/// Every JSON document of the fixtures that is small enough for many edits.
fn documents() -> &'static [Document] {
    static ALL: LazyLock<Vec<Document>> = LazyLock::new(read);
    &ALL
}

fn read() -> Vec<Document> {
    let files = support::files(&support::project().join("fixtures"), ".json");
    let read = |path: &std::path::PathBuf| {
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        Document::parse(name, &fs::read(path).expect("a file"))
    };
    let all: Vec<Document> = files.iter().map(read).collect();
    all.into_iter().filter(|d| d.left_out.is_empty() && d.text.as_ref().is_some_and(|t| t.len() < 12_000)).collect()
}

/// JSON pointers of every value, starting with the document itself.
fn pointers(value: &Value, at: &str, out: &mut Vec<String>) {
    out.push(at.to_owned());
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                pointers(value, &format!("{at}/{}", key.replace('~', "~0").replace('/', "~1")), out);
            }
        }
        Value::Array(items) => {
            for (i, value) in items.iter().enumerate() {
                pointers(value, &format!("{at}/{i}"), out);
            }
        }
        _ => {}
    }
}

/// The same document in other layouts: unchanged, with CRLF, on one line as Python or as Rust writes it.
fn laid_out(document: &Document, layout: usize) -> Document {
    let text = document.text.as_deref().expect("text");
    let value = document.value.as_ref().expect("a value");
    let text = match layout {
        0 => text.to_owned(),
        1 => text.replace('\n', "\r\n"),
        2 => value.to_string(),
        _ => value.to_string().replace("\":", "\": ").replace(",\"", ", \""),
    };
    Document::parse(&*document.name, text.as_bytes())
}

fn edited(document: &Document, splice: &ckpt_doctor::checkpoint::Splice) -> Document {
    let text = document.text.as_deref().expect("text");
    let new = spliced(text, std::slice::from_ref(splice)).expect("inside the text");
    assert_eq!(&new[..splice.range.start], &text[..splice.range.start]);
    assert_eq!(&new[splice.range.start + splice.text.len()..], &text[splice.range.end..]);
    let new = Document::parse(&*document.name, new.as_bytes());
    let known = |kind: FaultKind| kind == FaultKind::NotAnObject || document.faults.iter().any(|old| old.kind == kind);
    assert!(new.faults.iter().all(|fault| known(fault.kind)), "{:?}", new.faults);
    new
}

fn values() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(json!(null)),
        any::<bool>().prop_map(Value::from),
        any::<i64>().prop_map(Value::from),
        "[ -~äß\"\\\\]{0,12}".prop_map(Value::from),
    ];
    leaf.prop_recursive(2, 8, 3, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..3).prop_map(Value::from),
            prop::collection::btree_map("[a-z/~]{1,6}", inner, 0..3)
                .prop_map(|m| Value::Object(m.into_iter().collect())),
        ]
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn setting_a_value_changes_that_value_alone(which: Index, place: Index, layout in 0..4_usize, value in values()) {
        let documents = documents();
        let document = laid_out(which.get(documents), layout);
        let mut all = Vec::new();
        pointers(document.value.as_ref().expect("a value"), "", &mut all);
        let pointer = place.get(&all);
        let splice = document.set(pointer, &value).expect("there");
        let mut expected = document.value.clone().expect("a value");
        *expected.pointer_mut(pointer).expect("there") = value;
        prop_assert_eq!(edited(&document, &splice).value, Some(expected));
        // Only the bytes of the value are removed.
        prop_assert_eq!(Some(splice.range), document.locate(pointer));
    }

    #[test]
    fn a_new_member_changes_no_other(which: Index, place: Index, layout in 0..4_usize, value in values(), deep: bool) {
        let documents = documents();
        let document = laid_out(which.get(documents), layout);
        let mut all = Vec::new();
        pointers(document.value.as_ref().expect("a value"), "", &mut all);
        all.retain(|p| document.get(p).is_some_and(Value::is_object));
        let parent = place.get(&all);
        let name = if deep { "new key/inner" } else { "new key" };
        let splice = document.set(&format!("{parent}/{name}"), &value).expect("an object");
        let mut expected = document.value.clone().expect("a value");
        let member = if deep { json!({ "inner": value }) } else { value };
        expected.pointer_mut(parent).and_then(Value::as_object_mut).expect("there").insert("new key".to_owned(), member);
        prop_assert_eq!(edited(&document, &splice).value, Some(expected));
        // If the container has members, nothing is removed.
        let empty = document.get(parent).and_then(Value::as_object).is_some_and(serde_json::Map::is_empty);
        prop_assert!(empty || splice.range.is_empty());
    }

    #[test]
    fn removing_a_member_changes_no_other(which: Index, place: Index, layout in 0..4_usize) {
        let documents = documents();
        let document = laid_out(which.get(documents), layout);
        let mut all = Vec::new();
        pointers(document.value.as_ref().expect("a value"), "", &mut all);
        let pointer = place.get(&all);
        prop_assume!(!pointer.is_empty());
        let splice = document.remove(pointer).expect("there");
        let mut expected = document.value.clone().expect("a value");
        let (parent, step) = pointer.rsplit_once('/').expect("a step");
        match expected.pointer_mut(parent).expect("there") {
            Value::Object(map) => drop(map.shift_remove(&step.replace("~1", "/").replace("~0", "~"))),
            Value::Array(items) => drop(items.remove(step.parse().expect("an index"))),
            _ => unreachable!("only containers have members"),
        }
        prop_assert_eq!(edited(&document, &splice).value, Some(expected));
    }
}

#[test]
fn new_members_look_like_their_neighbours() {
    let after = |text: &str, pointer: &str, value: Value| {
        let document = Document::parse("config.json", text.as_bytes());
        let splice = document.set(pointer, &value).expect("there");
        spliced(text, &[splice]).expect("inside the text")
    };
    for (text, pointer, value, new) in [
        ("{\n    \"eps\": 1e-06\n}\n", "/tie", json!(false), "{\n    \"eps\": 1e-06,\n    \"tie\": false\n}\n"),
        ("{\r\n\t\"a\": 1\r\n}", "/b/c", json!(2), "{\r\n\t\"a\": 1,\r\n\t\"b\": {\r\n\t\t\"c\": 2\r\n\t}\r\n}"),
        ("{\"a\":1,\"b\":2}", "/c", json!([1, 2]), "{\"a\":1,\"b\":2,\"c\":[1,2]}"),
        ("{\"a\": 1}", "/c", json!([1, 2]), "{\"a\": 1, \"c\": [1, 2]}"),
        (
            "{\n  \"auto_map\": {}\n}",
            "/auto_map/AutoConfig",
            json!("m.C"),
            "{\n  \"auto_map\": {\n    \"AutoConfig\": \"m.C\"\n  }\n}",
        ),
        ("{}", "/a", json!(1), "{\"a\": 1}"),
        ("{\n  \"a\": [1, 2]\n}", "/a/-", json!(3), "{\n  \"a\": [1, 2, 3]\n}"),
        ("{\"a\": null}", "/a/b", json!(1), "{\"a\": {\"b\": 1}}"),
    ] {
        assert_eq!(after(text, pointer, value), new);
    }
    let document = Document::parse("config.json", b"{\"a\": 1}");
    assert!(document.set("/a/b", &json!(1)).is_none(), "a number has no members");
    assert!(document.remove("/b").is_none());
}
