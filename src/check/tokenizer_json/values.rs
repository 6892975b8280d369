//! Values of tokenizer.json that the `tokenizers` library refuses.
//!
//! Source: tokenizers 0.21.4, 0.22.2 and 0.23.3, tried with values of every kind; all three do the same.

use serde_json::{Map, Value};

use super::MAX_DEPTH;
use super::charsmap::is_charsmap;
use crate::check::model_type::{CAP, short};
use crate::checkpoint::fault::KIND_CAP;
use crate::checkpoint::tokenizer::Vocabulary;
use crate::checkpoint::{Document, Fault, FaultKind, Place, escape, files, pointer};
use crate::knowledge::tokenizer_values::TokenizerValues;
use crate::knowledge::value_outcome::ValueOutcome;

/// Lists of parts, and the part that each element is.
const LISTS: [(&str, &str); 4] = [
    ("normalizers", "normalizer"),
    ("pretokenizers", "pre_tokenizer"),
    ("processors", "post_processor"),
    ("decoders", "decoder"),
];

/// Parts at the top.
pub(in crate::check) const PARTS: [&str; 5] = ["normalizer", "pre_tokenizer", "post_processor", "decoder", "model"];

/// Objects with keys of any name.
const FREE: [&str; 2] = ["vocab", "special_tokens"];

/// Keys whose values the reader of the vocabulary judges.
const OF_VOCABULARY: [&str; 2] = ["vocab", "merges"];

/// Keys with one of a few words: every one of them was tried.
const CHOICES: [&str; 6] = ["behavior", "direction", "prepend_scheme", "strategy", "type", "version"];

/// What a document has that the library refuses, and the first pointer to a value that is not judged.
pub(in crate::check) struct JudgedTokenizer {
    pub(in crate::check) refused: Vec<Fault>,
    pub(in crate::check) unknown: Option<String>,
}

/// Judges every value of a document but the vocabulary.
pub(in crate::check) fn judged(
    document: &Document,
    base: Option<&Vocabulary>,
    values: &TokenizerValues,
) -> JudgedTokenizer {
    let mut judge = Judge { values, base, refused: Vec::new(), unknown: None };
    if let Some(object) = document.value.as_ref().and_then(Value::as_object) {
        judge.object(object, "", "", 0);
    }
    JudgedTokenizer { refused: judge.refused, unknown: judge.unknown }
}

struct Judge<'j> {
    values: &'j TokenizerValues,
    base: Option<&'j Vocabulary>,
    refused: Vec<Fault>,
    unknown: Option<String>,
}

impl Judge<'_> {
    /// Adds a fault, up to the number that is listed of a kind.
    fn refuse(&mut self, at: &str, value: Option<&Value>) {
        if self.refused.len() >= KIND_CAP {
            return;
        }
        let key = at.rsplit('/').next().unwrap_or_default();
        let fault = Fault::new(FaultKind::TokenizerValueRefused)
            .at(Place::file(files::TOKENIZER).pointer(at))
            .with("key", escape(key, CAP));
        self.refused.push(value.into_iter().fold(fault, |fault, value| fault.with("value", short(value))));
    }

    fn doubt(&mut self, at: &str) {
        self.unknown.get_or_insert_with(|| at.to_owned());
    }

    /// The keys of an object at a place, and the values below.
    fn object(&mut self, object: &Map<String, Value>, place: &str, at: &str, depth: usize) {
        // Of several forms, an object has one, under its name.
        let is_choice = !place.is_empty() && self.values.is_closed(place);
        let is_lacking = |key: &str| if is_choice { object.is_empty() } else { !object.contains_key(key) };
        let needed: Vec<_> = self.values.needed(place).filter(|(key, _)| is_lacking(key)).collect();
        for (key, outcome) in needed {
            let missing = pointer::join(at, key);
            match outcome {
                ValueOutcome::Refused => self.refuse(&missing, None),
                _ => self.doubt(&missing),
            }
        }
        let is_free = at.rsplit('/').next().is_some_and(|last| FREE.contains(&last));
        for (key, value) in object {
            let under = if is_free { "*" } else { key };
            let here = if place.is_empty() { under.to_owned() } else { format!("{place}/{under}") };
            let slot = PARTS.contains(&key.as_str()).then_some(key.as_str()).filter(|_| at.is_empty());
            self.value(value, &here, &pointer::join(at, key), slot, depth);
        }
    }

    fn value(&mut self, value: &Value, place: &str, at: &str, slot: Option<&str>, depth: usize) {
        let parent = place.rsplit_once('/').map_or("", |(parent, _)| parent);
        if !self.values.has(place) {
            // The library reads past other keys.
            if self.values.is_closed(parent) {
                self.refuse(at, Some(value));
            }
            return;
        }
        let key = at.rsplit('/').next().unwrap_or_default();
        if OF_VOCABULARY.contains(&key) {
            // The value has the containers, and nothing in them.
            let is_held = value.is_array() || value.is_object() && key == "vocab";
            if !is_held {
                self.refuse(at, Some(value));
            }
            return;
        }
        if depth > MAX_DEPTH {
            return self.doubt(at);
        }
        let below = depth.saturating_add(1);
        if let (Some(slot), Value::Object(part)) = (slot, value) {
            return match part.get("type").and_then(Value::as_str) {
                Some(name) if self.values.has(&format!("{slot} {name}/type")) => {
                    self.object(part, &format!("{slot} {name}"), at, below);
                }
                // A type that no version has is another fault.
                Some(_) => {}
                None => self.doubt(at),
            };
        }
        match self.values.given(place, value) {
            // Its only key decides.
            Some(ValueOutcome::Depends) if value.is_object() && self.values.is_closed(place) => {}
            Some(ValueOutcome::Refused) if !self.is_container(place, value) => return self.refuse(at, Some(value)),
            Some(ValueOutcome::Depends) => match self.decided(place, at, value) {
                Some(true) => {}
                Some(false) => return self.refuse(at, Some(value)),
                None => return self.doubt(at),
            },
            _ => {}
        }
        match value {
            Value::Object(object) => self.object(object, place, at, below),
            Value::Array(list) => {
                let slot = LISTS.iter().find(|(name, _)| *name == key).map(|(_, slot)| *slot);
                for (i, inner) in list.iter().enumerate() {
                    let by_index = format!("{place}/{i}");
                    let here = if self.values.has(&by_index) { by_index } else { format!("{place}/*") };
                    self.value(inner, &here, &format!("{at}/{i}"), slot, below);
                }
            }
            _ => {}
        }
    }

    /// Whether a value is of the kind that the library reads there, and its contents decide: those that were tried did not fit.
    fn is_container(&self, place: &str, value: &Value) -> bool {
        let is_free = FREE.contains(&place.rsplit('/').next().unwrap_or_default());
        let is_list = self.values.has(&format!("{place}/0")) || self.values.has(&format!("{place}/*")) && !is_free;
        match value {
            Value::Object(object) => !object.is_empty() && (is_free || self.values.has_keys(place)),
            Value::Array(list) => !list.is_empty() && is_list,
            _ => false,
        }
    }

    /// Whether a value loads whose kind does not decide; `None` where that is not known.
    fn decided(&self, place: &str, at: &str, value: &Value) -> Option<bool> {
        let key = at.rsplit('/').next().unwrap_or_default();
        let words = self.values.words(place);
        match value {
            Value::String(text) if words.is_some_and(|words| words.contains(text)) => Some(true),
            // The merges decide.
            Value::String(_) if place == "model BPE/continuing_subword_prefix" => Some(true),
            // One character.
            Value::String(text) if words.is_some_and(|words| words.iter().all(|word| word.chars().count() == 1)) => {
                Some(text.chars().count() == 1).filter(|is_one| *is_one || place.ends_with("/replacement"))
            }
            Value::String(_) if CHOICES.contains(&key) || place.ends_with("Sequence/id") => Some(false),
            Value::String(text) if key == "precompiled_charsmap" => Some(is_charsmap(text)),
            Value::Object(object) if key == "strategy" => {
                Some(object.len() == 1 && object.get("Fixed").is_some_and(Value::is_u64))
            }
            Value::Array(_) if matches!(key, "ids" | "tokens") => Some(true),
            Value::Number(number) if key == "dropout" => number.as_f64().map(|share| (0.0..=1.0).contains(&share)),
            Value::Number(number) if key == "unk_id" => {
                number.as_u64().zip(self.base).map(|(id, base)| id < base.len())
            }
            _ => None,
        }
    }
}
