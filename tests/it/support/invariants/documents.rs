//! JSON documents, the index and the tokenizer, with `serde_json` as a second opinion.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ckpt_doctor::checkpoint::{Document, FaultKind, INDEX_NAME, Index, Tokenizer, Vocabulary, is_plain_file_name};
use serde_json::Value;

/// Faults of documents that are strict JSON all the same, and why they are faults.
pub const STRICT_ALL_THE_SAME: &[(FaultKind, &str)] = &[
    (FaultKind::DuplicateJsonKey, "JSON leaves open what equal keys mean; serde_json keeps the last"),
    (FaultKind::HugeNumber, "the grammar has no largest number; Python's integers and doubles do"),
    (FaultKind::NotAnObject, "any value is JSON; a config is an object"),
    (FaultKind::JsonTooManyValues, "a value takes far more room than its text"),
];

/// The laws for a document of this name.
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
            // With `arbitrary_precision` an object with a key of the crate's own becomes a number there.
            let private = text.is_some_and(|text| text.contains("$serde_json::private"));
            let unlike = [FaultKind::HugeNumber, FaultKind::JsonTooManyValues]
                .iter()
                .any(|kind| super::has(&document.faults, *kind));
            let same = document.left_out.is_empty() && !private && !unlike;
            if same {
                assert_eq!(document.value.as_ref(), Some(&strict));
            }
        }
        Err(error) => assert!(grave.is_some(), "nothing found, and serde_json says {error}"),
    }
    places_are_found_again(&document);
    document
}

/// A pointer leads back to the value that the span of the same place covers.
fn places_are_found_again(document: &Document) {
    // Without the markers of a merge the text has a value; with them, as it stands, it has none.
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

/// The laws for an index.
pub fn index(bytes: &[u8]) {
    let document = hold(INDEX_NAME, bytes);
    let index = Index::from_document(&document);
    super::faults_are_placed(&index.faults, INDEX_NAME, document.text.as_deref());
    assert_eq!(index.unread, !document.value.as_ref().is_some_and(Value::is_object));
    let stated = document.get("/weight_map").and_then(Value::as_object);
    for (tensor, file) in &index.weight_map {
        assert!(is_plain_file_name(file), "{file:?} would be opened");
        assert_eq!(stated.and_then(|map| map.get(tensor)).and_then(Value::as_str), Some(file.as_str()));
    }
    // An entry that is not taken is told of.
    let left = stated.map_or(0, |map| map.len() - index.weight_map.len());
    let told =
        [FaultKind::IndexUnsafePath, FaultKind::WeightMapMalformed].iter().any(|kind| super::has(&index.faults, *kind));
    assert!(left == 0 || told);
    if let Some(total) = index.total_bytes() {
        let float = index.total_size.as_ref().and_then(Value::as_f64).expect("a number");
        #[allow(clippy::cast_precision_loss, reason = "the float is no more precise")]
        let close = (float - total as f64).abs() <= float * 1e-9;
        assert!(close, "{float} and {total}");
    }
}

/// The laws for a vocabulary that is no document.
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

/// The laws for a tokenizer made of these files.
pub fn tokenizer(files: &[(&str, &[u8])]) {
    let mut documents = BTreeMap::new();
    let mut vocabularies = BTreeMap::new();
    let mut names = BTreeSet::new();
    for (name, bytes) in files {
        names.insert((*name).to_owned());
        if name.ends_with(".json") {
            documents.insert((*name).to_owned(), hold(name, bytes));
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
