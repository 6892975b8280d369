//! What `GenerationConfig` does with the values of `generation_config.json`.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use serde_json::Value;

use super::by_version::ByVersion;
use super::source::DataError;

/// A kind of value, as `tools/loader_generation.py` tries them. Every value has exactly one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GenerationKind {
    /// `null`.
    Null,
    /// Any string.
    Text,
    /// `true`.
    True,
    /// `false`.
    False,
    /// 0 or 0.0, which are equal in Python.
    Zero,
    /// Any number below 0.
    Negative,
    /// A number between 0 and 1.
    Part,
    /// 1 or 1.0.
    One,
    /// A whole number above 1, written without a point.
    Whole,
    /// Any other number above 1.
    AboveOne,
    /// `[]`.
    EmptyList,
    /// Any other list.
    List,
    /// `{}`.
    EmptyObject,
    /// Any other object.
    Object,
}

impl GenerationKind {
    /// The kind of a value.
    #[must_use]
    pub fn of(value: &Value) -> Self {
        match value {
            Value::Null => Self::Null,
            Value::Bool(true) => Self::True,
            Value::Bool(false) => Self::False,
            Value::String(_) => Self::Text,
            Value::Array(list) if list.is_empty() => Self::EmptyList,
            Value::Array(_) => Self::List,
            Value::Object(object) if object.is_empty() => Self::EmptyObject,
            Value::Object(_) => Self::Object,
            Value::Number(number) => match number.as_f64().unwrap_or(f64::INFINITY) {
                n if n < 0.0 => Self::Negative,
                0.0 => Self::Zero,
                n if n < 1.0 => Self::Part,
                1.0 => Self::One,
                _ if number.is_f64() => Self::AboveOne,
                _ => Self::Whole,
            },
        }
    }
}

/// A rule between keys that a version has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GenerationRelation {
    /// Groups of beams: no sampling, as many in each, and a penalty for alike ones.
    Groups,
    /// Constraints with beams: no sampling and no groups.
    Constraints,
    /// A forced token may not be suppressed.
    Forced,
    /// Several sequences need sampling, or as many beams.
    Sequences,
    /// The same holds for numbers of sequences below one.
    SequencesBelowOne,
    /// `do_sample` counts as unset unless it is true; where a version lacks this relation, only `false` does.
    SequencesWithoutSamplingKey,
    /// `num_beams` may not be null beside several sequences.
    BeamsNotNull,
}

/// What becomes of a value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GivenValue<'k> {
    /// It is accepted, whatever stands beside it.
    Accepted,
    /// It is refused with this exception, whatever stands beside it.
    Refused(&'k str),
    /// It is refused beside some values, or some values of its kind are.
    Depends,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
enum RefusedKinds {
    /// All, with this exception.
    All(String),
    Some(BTreeMap<GenerationKind, String>),
}

/// What one version does.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GenerationKeys {
    keys: BTreeMap<String, RefusedKinds>,
    /// Keys that the class reads; others become attributes, unless the file is made from a model's config.
    own: BTreeSet<String>,
    relations: BTreeSet<GenerationRelation>,
    /// Keys of which only some texts load: the exception, and these texts.
    words: BTreeMap<String, (String, BTreeSet<String>)>,
}

impl GenerationKeys {
    /// What becomes of the value of a key. Called for each key of the file.
    #[must_use]
    pub fn given(&self, key: &str, value: &Value) -> GivenValue<'_> {
        if let Some((raises, texts)) = self.words.get(key)
            && let Some(text) = value.as_str()
        {
            return if texts.contains(text) { GivenValue::Accepted } else { GivenValue::Refused(raises) };
        }
        match self.keys.get(key) {
            None => GivenValue::Accepted,
            Some(RefusedKinds::All(raises)) => GivenValue::Refused(raises),
            Some(RefusedKinds::Some(kinds)) => match kinds.get(&GenerationKind::of(value)).map(String::as_str) {
                None => GivenValue::Accepted,
                Some("depends") => GivenValue::Depends,
                Some(raises) => GivenValue::Refused(raises),
            },
        }
    }

    /// The texts that load, of a key that accepts no others.
    pub fn words(&self, key: &str) -> impl Iterator<Item = &str> {
        self.words.get(key).into_iter().flat_map(|(_, texts)| texts).map(String::as_str)
    }

    /// Whether some value of the key is refused.
    #[must_use]
    pub fn judges(&self, key: &str) -> bool {
        self.keys.contains_key(key) || self.words.contains_key(key)
    }

    /// Whether the class reads the key itself.
    #[must_use]
    pub fn is_read(&self, key: &str) -> bool {
        self.own.contains(key)
    }

    /// Whether the version has a relation.
    #[must_use]
    pub fn has(&self, relation: GenerationRelation) -> bool {
        self.relations.contains(&relation)
    }
}

/// `rules/generation.json`, which `tools/loader_generation.py` writes.
#[derive(Debug, Clone, Default)]
pub struct GenerationTable {
    versions: ByVersion<GenerationKeys>,
}

impl GenerationTable {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint with a generation config parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("generation.json")? })
    }

    /// What a known version does; of another one, what the known versions around it do, one of which it does.
    pub fn around(&self, version: &str) -> impl Iterator<Item = &GenerationKeys> {
        let (newer, older) = self.versions.around(version);
        newer.into_iter().chain(older.filter(|older| newer.is_none_or(|newer| !std::ptr::eq(*older, newer))))
    }
}
