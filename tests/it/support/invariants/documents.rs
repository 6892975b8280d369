//! JSON documents, the index and the tokenizer, compared with `serde_json`.

use ckpt_doctor::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ckpt_doctor::checkpoint::document::Locator;
use ckpt_doctor::checkpoint::{Document, FaultKind, Index, Tokenizer, Vocabulary, is_plain_file_name};
use serde_json::Value;

/// Faults of valid strict JSON, each with its reason.
pub const STRICT_ALL_THE_SAME: &[(FaultKind, &str)] = &[
    (FaultKind::DuplicateJsonKey, "JSON leaves open what equal keys mean; serde_json keeps the last"),
    (FaultKind::HugeNumber, "the grammar has no largest number; Python's integers and doubles do"),
    (FaultKind::NotAnObject, "any value is JSON; a config is an object"),
    (FaultKind::JsonTooManyValues, "a value takes far more room than its text"),
];

/// The invariants of a document with this name.
pub fn hold(name: &str, bytes: &[u8]) -> Document {
    let document = Document::parse(name, bytes);
    let text = document.text.as_deref();
    super::faults_are_placed(&document.faults, name, text);
    if let Some(text) = text {
        assert_eq!(text.as_bytes(), bytes);
    }
    let grave = document.faults.iter().find(|f| !STRICT_ALL_THE_SAME.iter().any(|(kind, _)| *kind == f.kind));
    match serde_json::from_slice::<Value>(bytes) {
        Ok(strict) => {
            assert!(grave.is_none(), "serde_json reads it: {grave:?}");
            let unlike = [FaultKind::HugeNumber, FaultKind::JsonTooManyValues]
                .iter()
                .any(|kind| super::has(&document.faults, *kind));
            let same = document.left_out.is_empty() && !unlike;
            if same {
                assert!(document.value.as_ref().is_some_and(|value| is_same(value, &strict)), "{document:?} {strict}");
            }
        }
        Err(error) => {
            let huge = super::has(&document.faults, FaultKind::HugeNumber);
            assert!(grave.is_some() || huge, "nothing found, and serde_json says {error}");
        }
    }
    places_are_found_again(&document);
    omitted_parts_are_skipped(&document);
    document
}

/// A locator that jumps over omitted parts finds the same places as one that scans them.
fn omitted_parts_are_skipped(document: &Document) {
    let (Some(text), Some(mut jumps)) = (&document.text, Locator::of(document)) else { return };
    // The parts are those of the text without conflict markers.
    if super::has(&document.faults, FaultKind::MergeConflictMarker) {
        return;
    }
    let mut scans = Locator::new(text);
    for pointer in ["", "/model", "/model/vocab", "/model/merges", "/added_tokens", "/version"] {
        assert_eq!(jumps.value(pointer), scans.value(pointer), "{pointer} {document:?}");
    }
}

/// Whether two values are equal, but for an integer of zero with a sign, which `serde_json` reads as a double.
fn is_same(ours: &Value, theirs: &Value) -> bool {
    match (ours, theirs) {
        (Value::Number(a), Value::Number(b)) => {
            let (x, y) = (a.as_f64().unwrap_or(f64::NAN), b.as_f64().unwrap_or(f64::NAN));
            a == b || x == 0.0 && y == 0.0
        }
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| is_same(a, b)),
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len() && a.iter().all(|(key, a)| b.get(key).is_some_and(|b| is_same(a, b)))
        }
        _ => ours == theirs,
    }
}

/// The pointer of a place gives the value that its span covers.
fn places_are_found_again(document: &Document) {
    // The text without conflict markers has a value; the original text has none.
    let unclear = [FaultKind::DuplicateJsonKey, FaultKind::MergeConflictMarker];
    if unclear.iter().any(|kind| super::has(&document.faults, *kind)) || document.value.is_none() {
        return;
    }
    for place in document.faults.iter().filter(|f| f.kind == FaultKind::NonFiniteNumber).flat_map(|f| &f.places).take(4)
    {
        let (Some(pointer), Some(span)) = (&place.pointer, &place.span) else { continue };
        assert_eq!(document.locate(pointer).as_ref(), Some(span), "{pointer}");
    }
}

/// The invariants of an index.
pub fn index(bytes: &[u8]) {
    let document = hold(files::INDEX, bytes);
    let index = Index::from_document(&document);
    super::faults_are_placed(&index.faults, files::INDEX, document.text.as_deref());
    assert_eq!(index.unread, !document.value.as_ref().is_some_and(Value::is_object));
    let stated = document.get("/weight_map").and_then(Value::as_object);
    for (tensor, file) in &index.weight_map {
        assert!(is_plain_file_name(file), "{file:?} would be opened");
        assert_eq!(stated.and_then(|map| map.get(tensor)).and_then(Value::as_str), Some(&**file));
    }
    // Ignored entries are reported.
    let left = stated.map_or(0, |map| map.len() - index.weight_map.len());
    let reported =
        [FaultKind::IndexUnsafePath, FaultKind::WeightMapMalformed].iter().any(|kind| super::has(&index.faults, *kind));
    assert!(left == 0 || reported);
    if let Some(total) = index.total_bytes() {
        let float = index.total_size.as_ref().and_then(Value::as_f64).expect("a number");
        #[allow(clippy::cast_precision_loss, reason = "the float is not more precise")]
        let close = (float - total as f64).abs() <= float * 1e-9;
        assert!(close, "{float} and {total}");
    }
}

/// The invariants of a vocabulary outside JSON documents.
pub fn vocabulary(name: &str, bytes: &[u8]) -> Option<Vocabulary> {
    let vocabulary = Vocabulary::parse(name, bytes).ok()?;
    let mut last = None;
    let mut count = 0;
    for (token, id) in vocabulary.iter() {
        assert!(last < Some(token), "sorted, and each once");
        assert_eq!(vocabulary.id_of(token), Some(id));
        assert!(Some(id) <= vocabulary.max_id());
        last = Some(token);
        count += 1;
    }
    assert_eq!(vocabulary.len(), count);
    Some(vocabulary)
}

/// The invariants of a tokenizer made of these files.
pub fn tokenizer(files: &[(&str, &[u8])]) {
    let mut documents = BTreeMap::new();
    let mut vocabularies = BTreeMap::new();
    let mut names = BTreeSet::new();
    for (name, bytes) in files {
        names.insert((*name).to_owned());
        if name.ends_with(".json") {
            documents.insert((*name).to_owned(), Arc::new(hold(name, bytes)));
        } else if let Some(vocabulary) = vocabulary(name, bytes) {
            vocabularies.insert((*name).to_owned(), Arc::new(vocabulary));
        }
    }
    let tokenizer = Tokenizer::new(&documents, vocabularies, names);
    for (token, id) in tokenizer.added() {
        assert_eq!(tokenizer.id_of(token), Some(*id));
    }
    if let (Some(length), Some(base)) = (tokenizer.length(), tokenizer.base()) {
        assert!(length >= base.len());
    }
    assert!(tokenizer.source.as_ref().is_none_or(|source| tokenizer.files.contains(source)));
}
