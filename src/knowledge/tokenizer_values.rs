//! Which values of tokenizer.json the `tokenizers` library refuses: `rules/tokenizer-values.json`.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use serde_json::Value;

use super::source::{self, DataError};
use super::value_outcome::ValueOutcome;

/// The table, which `tools/loader_tokenizer_values.py` writes. A place is a path of keys, as that tool names it.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenizerValues {
    /// The kinds of values in the order of the letters, and `absent`.
    kinds: Vec<String>,
    /// Objects that may have no other key.
    closed: BTreeSet<String>,
    /// A letter for each kind.
    places: BTreeMap<String, String>,
    /// Texts that load where others do not.
    words: BTreeMap<String, BTreeSet<String>>,
}

impl TokenizerValues {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a tokenizer parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "tokenizer-values.json";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// Whether the library reads the place.
    #[must_use]
    pub fn has(&self, place: &str) -> bool {
        self.places.contains_key(place)
    }

    /// What becomes of a value; `None` for one at a place that is not read.
    #[must_use]
    pub fn given(&self, place: &str, value: &Value) -> Option<ValueOutcome> {
        self.outcome(place, kind(value))
    }

    /// The keys that an object may not be without, or perhaps not.
    pub fn needed<'t>(&'t self, object: &'t str) -> impl Iterator<Item = (&'t str, ValueOutcome)> {
        // At the top, a place is a key alone; those of parts begin with their slot and a blank.
        let start = if object.is_empty() { String::new() } else { format!("{object}/") };
        let below = self.places.range(start..).map_while(move |(place, _)| {
            let rest = place.strip_prefix(object)?;
            Some((place, if object.is_empty() { rest } else { rest.strip_prefix('/')? }))
        });
        let own = below.filter(|(_, key)| !key.contains(['/', ' ']) && *key != "*");
        own.filter_map(|(place, key)| Some((key, self.outcome(place, "absent")?)))
            .filter(|(_, outcome)| *outcome != ValueOutcome::Accepted)
    }

    /// Whether the library reads keys of an object at the place, and not elements of a list.
    #[must_use]
    pub fn has_keys(&self, place: &str) -> bool {
        let below =
            self.places.range(format!("{place}/")..).map_while(|(name, _)| name.strip_prefix(place)?.strip_prefix('/'));
        below.into_iter().any(|key| key.starts_with(|c: char| c.is_ascii_alphabetic()))
    }

    /// Whether an object may have no keys but those that are read.
    #[must_use]
    pub fn is_closed(&self, object: &str) -> bool {
        self.closed.contains(object)
    }

    /// The texts that load, of a place that accepts no others of those that were tried.
    #[must_use]
    pub fn words(&self, place: &str) -> Option<&BTreeSet<String>> {
        self.words.get(place)
    }

    fn outcome(&self, place: &str, kind: &str) -> Option<ValueOutcome> {
        let at = self.kinds.iter().position(|name| name == kind)?;
        Some((*self.places.get(place)?.as_bytes().get(at)?).into())
    }
}

/// The kind of a value: `KINDS` of `tools/loader_tokenizer_values.py`.
pub(super) fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(true) => "true",
        Value::Bool(false) => "false",
        Value::String(_) => "text",
        Value::Array(list) if list.is_empty() => "empty-list",
        Value::Array(_) => "list",
        Value::Object(object) if object.is_empty() => "empty-object",
        Value::Object(_) => "object",
        Value::Number(number) => match (number.as_u64(), number.is_i64()) {
            (Some(0), _) => "zero",
            (Some(1), _) => "one",
            (Some(_), _) => "whole",
            (None, true) => "negative",
            (None, false) => "fraction",
        },
    }
}
