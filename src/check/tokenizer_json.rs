//! tokenizer.json as the `tokenizers` library reads it.
//!
//! Source: tokenizers 0.19 to 0.22, with the Python packages of transformers 4.47.0, 4.57.6 and 5.23.0.

mod charsmap;
pub(super) mod values;

use crate::checkpoint::files;
use std::collections::BTreeMap;

use serde_json::Value;

use super::model_type::CAP;
use super::view::Asked;
use crate::checkpoint::{Checkpoint, Document, Fault, FaultKind, Place, Tokenizer, escape, has_paired_merges};
use crate::knowledge::loader::version_numbers;
use crate::knowledge::tokenizer_parts::TokenizerPart;

/// Version of transformers whose `tokenizers`, 0.20, is the first that reads merges as pairs.
const READS_PAIRS: [u64; 2] = [4, 45];

/// Depth of sequences in sequences that is read; each takes two levels of a document, which has at most 127.
const MAX_DEPTH: usize = 64;

/// The file, unless the tokenizer is built from another one.
pub(super) fn document(checkpoint: &Checkpoint) -> Option<&Document> {
    checkpoint.document(files::TOKENIZER).filter(|_| checkpoint.tokenizer.source.as_deref() == Some(files::TOKENIZER))
}

/// The fault of merges that older versions do not read. Called by the engine with the targets of the run.
pub(super) fn paired_merges(checkpoint: &Checkpoint, asked: &Asked<'_>) -> Option<Fault> {
    let document = document(checkpoint)?;
    let old =
        asked.targets.iter().filter(|target| version_numbers(target.version()).as_slice() < READS_PAIRS.as_slice());
    let old: Vec<&'static str> = old.map(|target| target.loader.version()).collect();
    let is_fault = !old.is_empty() && has_paired_merges(document);
    let fault = Fault::new(FaultKind::MergesArePairs).at(Place::file(files::TOKENIZER).pointer("/model/merges"));
    is_fault.then(|| fault.under_all(old))
}

/// Faults of tokenizer.json under every version. Called by the engine once for a run.
pub(super) fn faults(checkpoint: &Checkpoint, parts: &[TokenizerPart]) -> Vec<Fault> {
    let mut faults = Vec::new();
    let Some(document) = document(checkpoint) else { return faults };
    for part in parts {
        if let Some(value) = document.get(&part.pointer) {
            unknown_types(value, part, &part.pointer, 0, &mut faults);
        }
    }
    let added = document.get("/added_tokens").and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
    if let Some(given) = given_ids(&checkpoint.tokenizer, added) {
        faults.extend(moved(added, &given));
        if let Some(part) = document.get("/post_processor") {
            let id_of = |token: &str| {
                given.get(token).copied().or_else(|| checkpoint.tokenizer.base().and_then(|base| base.id_of(token)))
            };
            wrong_ids(part, "/post_processor", &id_of, 0, &mut faults);
        }
    }
    faults
}

/// Adds faults of types that no version of the library has, in a part and in the parts of a sequence.
fn unknown_types(value: &Value, part: &TokenizerPart, pointer: &str, depth: usize, faults: &mut Vec<Fault>) {
    if let Some(name) = value.get("type").and_then(Value::as_str).filter(|name| !part.types.contains(*name)) {
        let fault = Fault::new(FaultKind::TokenizerPartUnknown).at(Place::file(files::TOKENIZER).pointer(pointer));
        faults.push(fault.with("part", part.pointer.trim_start_matches('/')).with("type", escape(name, CAP)));
    }
    let Some(list) = part.list.as_deref().filter(|_| depth < MAX_DEPTH) else { return };
    for (i, inner) in value.get(list).and_then(Value::as_array).into_iter().flatten().enumerate() {
        unknown_types(inner, part, &format!("{pointer}/{list}/{i}"), depth.saturating_add(1), faults);
    }
}

/// The ids that the library gives the added tokens: that of the vocabulary, or else the next one after the vocabulary and
/// the tokens before it, whatever id the file states. `None` without a vocabulary.
fn given_ids<'a>(tokenizer: &Tokenizer, added: &'a [Value]) -> Option<BTreeMap<&'a str, u64>> {
    let base = tokenizer.base()?;
    // A list of pieces counts those that occur twice.
    let length = base.max_id().map_or(0, |max| max.saturating_add(1));
    let length = if tokenizer.has_list_of_pieces() { length } else { base.len() };
    let mut given: BTreeMap<&str, u64> = BTreeMap::new();
    let mut highest: Option<u64> = None;
    for content in added.iter().filter_map(|token| token.get("content")?.as_str()).filter(|content| !content.is_empty())
    {
        if given.contains_key(content) {
            continue;
        }
        let next = highest.map_or(length, |max| if max >= length { max.saturating_add(1) } else { length });
        let id = base.id_of(content).unwrap_or(next);
        highest = highest.max(Some(id));
        given.insert(content, id);
    }
    Some(given)
}

/// The fault of added tokens that get other ids than the file states.
fn moved(added: &[Value], given: &BTreeMap<&str, u64>) -> Option<Fault> {
    let differs = |(i, token): (usize, &Value)| {
        let (content, stated) = (token.get("content")?.as_str()?.to_owned(), token.get("id")?.as_u64()?);
        let id = given.get(content.as_str()).copied().filter(|id| *id != stated)?;
        Some((i, content, stated, id))
    };
    let all: Vec<(usize, String, u64, u64)> = added.iter().enumerate().filter_map(differs).collect();
    let (i, content, stated, id) = all.first()?;
    let fault = Fault::new(FaultKind::AddedTokenMoved)
        .at(Place::file(files::TOKENIZER).pointer(format!("/added_tokens/{i}/id")));
    Some(fault.with("token", escape(content, CAP)).with("stated", *stated).with("given", *id).with("count", all.len()))
}

/// Adds faults of ids that a post-processor writes and that are not those of its tokens.
fn wrong_ids(part: &Value, pointer: &str, id_of: &dyn Fn(&str) -> Option<u64>, depth: usize, faults: &mut Vec<Fault>) {
    let mut compare = |token: &Value, id: &Value, at: String| {
        let (Some(token), Some(written)) = (token.as_str(), id.as_u64()) else { return };
        if let Some(own) = id_of(token).filter(|own| *own != written) {
            let fault = Fault::new(FaultKind::PostProcessorIdWrong).at(Place::file(files::TOKENIZER).pointer(at));
            faults.push(fault.with("token", escape(token, CAP)).with("written", written).with("own", own));
        }
    };
    for key in ["sep", "cls"] {
        if let Some([token, id]) = part.get(key).and_then(Value::as_array).map(Vec::as_slice) {
            compare(token, id, format!("{pointer}/{key}/1"));
        }
    }
    for (name, special) in part.get("special_tokens").and_then(Value::as_object).into_iter().flatten() {
        let list = |key: &str| special.get(key).and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
        let name = crate::checkpoint::pointer::join(&format!("{pointer}/special_tokens"), name);
        for (i, (token, id)) in list("tokens").iter().zip(list("ids")).enumerate() {
            compare(token, id, format!("{name}/ids/{i}"));
        }
    }
    for (i, inner) in part.get("processors").and_then(Value::as_array).into_iter().flatten().enumerate() {
        if depth < MAX_DEPTH {
            wrong_ids(inner, &format!("{pointer}/processors/{i}"), id_of, depth.saturating_add(1), faults);
        }
    }
}
