//! Which values of `tokenizer_config.json` tokenizer classes refuse: `rules/tokenizer-settings.json`.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use serde_json::{Map, Value};

use super::by_version::ByVersion;
use super::sorted::{Lazy, SortedMap};
use super::source::DataError;
use super::tokenizer_values;
use super::value_outcome::ValueOutcome;

/// Keys that no class has, whose letters stand for those of others with the same end.
const OTHERS: [&str; 3] = ["_special_tokens", "_token", ""];

/// What a class does with values: a letter for each kind of [`TokenizerConfigs::kinds`].
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Letters {
    keys: BTreeMap<String, String>,
    /// Keys of which only some texts load; null where all do.
    words: BTreeMap<String, Option<BTreeSet<String>>>,
    entry: BTreeMap<String, String>,
    parts: BTreeMap<String, String>,
}

/// What the classes of one version do. Source: the classes open files that `tools/loader_tokenizer_config.py` writes.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields, bound(deserialize = "'de: 'static"))]
pub struct TokenizerConfigs {
    /// The kinds of values in the order of the letters, and `absent`.
    kinds: Vec<String>,
    /// Other names of classes.
    names: BTreeMap<String, String>,
    keys: BTreeMap<String, String>,
    words: BTreeMap<String, Option<BTreeSet<String>>>,
    entry: BTreeMap<String, String>,
    parts: BTreeMap<String, String>,
    /// Classes, with what differs from the above.
    classes: SortedMap<Lazy<Letters>>,
}

impl TokenizerConfigs {
    /// The class of a name that `AutoTokenizer` opens, if it was tried.
    #[must_use]
    pub fn class(&self, name: &str) -> Option<TokenizerClass<'_>> {
        let name = self.names.get(name).map_or(name, String::as_str);
        Some(TokenizerClass { usual: self, own: self.classes.get(name)?.get()? })
    }

    fn outcome(&self, letters: &str, kind: &str) -> ValueOutcome {
        let at = self.kinds.iter().position(|name| name == kind);
        at.and_then(|at| letters.as_bytes().get(at)).map_or(ValueOutcome::Depends, |letter| (*letter).into())
    }
}

/// A tokenizer class of a version.
#[derive(Debug, Clone, Copy)]
pub struct TokenizerClass<'t> {
    usual: &'t TokenizerConfigs,
    own: &'t Letters,
}

impl TokenizerClass<'_> {
    /// What becomes of the value of a key of `tokenizer_config.json`, or of a missing one. Called for each key of the file.
    #[must_use]
    pub fn given(&self, key: &str, value: Option<&Value>) -> ValueOutcome {
        let known = self.keys(key).or_else(|| {
            let end = OTHERS.into_iter().find(|end| key.ends_with(end))?;
            self.keys(&format!("another{end}"))
        });
        let Some(letters) = known else { return ValueOutcome::Depends };
        let Some(value) = value else { return self.usual.outcome(letters, "absent") };
        if let Some(text) = value.as_str()
            && let Some(words) = self.own.words.get(key).or_else(|| self.usual.words.get(key))
            && words.as_ref().is_some_and(|words| words.contains(text))
        {
            return ValueOutcome::Accepted;
        }
        self.of(letters, value)
    }

    /// The keys that may have to be there.
    pub fn keys_of_class(&self) -> impl Iterator<Item = &str> {
        self.usual.keys.keys().map(String::as_str).filter(|key| !key.starts_with("another"))
    }

    /// What becomes of `added_tokens_decoder`, apart from its entries.
    #[must_use]
    pub fn decoder(&self, value: &Value) -> ValueOutcome {
        self.entry(".").map_or(ValueOutcome::Depends, |letters| self.usual.outcome(letters, kind(value)))
    }

    /// What becomes of an entry of `added_tokens_decoder`.
    #[must_use]
    pub fn token(&self, value: &Value) -> ValueOutcome {
        let Some(letters) = self.entry("") else { return ValueOutcome::Depends };
        match value.as_object() {
            Some(token) => self.fields(token).max(self.usual.outcome(letters, kind(value))),
            None => self.usual.outcome(letters, kind(value)),
        }
    }

    /// What becomes of a tokenizer.json with a part, named by its slot and type: `pre_tokenizer ByteLevel`.
    #[must_use]
    pub fn part(&self, part: &str) -> ValueOutcome {
        let letters = self.own.parts.get(part).or_else(|| self.usual.parts.get(part));
        let letter = letters.and_then(|letters| letters.as_bytes().first());
        letter.map_or(ValueOutcome::Depends, |letter| (*letter).into())
    }

    fn keys(&self, key: &str) -> Option<&str> {
        self.own.keys.get(key).or_else(|| self.usual.keys.get(key)).map(String::as_str)
    }

    fn entry(&self, key: &str) -> Option<&str> {
        self.own.entry.get(key).or_else(|| self.usual.entry.get(key)).map(String::as_str)
    }

    /// The worst of the fields of a token. Others than those of a token are ignored.
    fn fields(&self, token: &Map<String, Value>) -> ValueOutcome {
        let fields = self.usual.entry.keys().filter(|key| !matches!(key.as_str(), "" | "."));
        let outcome = |key: &String| {
            let letters = self.entry(key)?;
            Some(self.usual.outcome(letters, token.get(key).map_or("absent", kind)))
        };
        fields.filter_map(outcome).max().unwrap_or(ValueOutcome::Accepted)
    }

    fn of(&self, letters: &str, value: &Value) -> ValueOutcome {
        let outcome = self.usual.outcome(letters, kind(value));
        let tokens: Vec<&Map<String, Value>> = match value {
            Value::Object(object) if becomes_token(object) => vec![object],
            Value::Object(object) => {
                object.values().filter_map(Value::as_object).filter(|o| becomes_token(o)).collect()
            }
            Value::Array(list) => list.iter().filter_map(Value::as_object).filter(|o| becomes_token(o)).collect(),
            _ => Vec::new(),
        };
        // The fields count where an object becomes a token.
        let fields = tokens.into_iter().map(|token| self.fields(token)).max();
        match (outcome, fields) {
            (ValueOutcome::Accepted, Some(ValueOutcome::Refused | ValueOutcome::Depends)) => {
                if kind(value).starts_with("typed-token") { ValueOutcome::Refused } else { ValueOutcome::Depends }
            }
            _ => outcome,
        }
    }
}

/// `rules/tokenizer-settings.json`.
#[derive(Debug, Clone, Default)]
pub struct TokenizerConfigTable {
    versions: ByVersion<TokenizerConfigs>,
}

impl TokenizerConfigTable {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a tokenizer parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("tokenizer-settings.json")? })
    }

    /// The classes of this very version.
    #[must_use]
    pub fn of(&self, version: &str) -> Option<&TokenizerConfigs> {
        self.versions.at(version)
    }
}

fn is_token(object: &Map<String, Value>) -> bool {
    object.get("content").is_some_and(Value::is_string)
}

fn is_typed(object: &Map<String, Value>) -> bool {
    object.get("__type").and_then(Value::as_str) == Some("AddedToken")
}

fn becomes_token(object: &Map<String, Value>) -> bool {
    is_token(object) || is_typed(object)
}

/// The kind of a value: `KINDS` of `tools/loader_tokenizer_config.py`; a mixture has none.
fn kind(value: &Value) -> &'static str {
    let is_of = |is: &dyn Fn(&Map<String, Value>) -> bool, value: &Value| value.as_object().is_some_and(is);
    let is_plain = |object: &Map<String, Value>| is_token(object) && !is_typed(object);
    match value {
        Value::Array(list) if list.iter().all(Value::is_string) && !list.is_empty() => "texts",
        Value::Array(list) if list.iter().all(Value::is_number) && !list.is_empty() => "numbers",
        Value::Array(list) if list.iter().all(|v| is_of(&is_typed, v)) && !list.is_empty() => "typed-tokens",
        Value::Array(list) if list.iter().all(|v| is_of(&is_plain, v)) && !list.is_empty() => "tokens",
        Value::Array(list) if list.iter().all(|v| is_of(&is_template, v)) && !list.is_empty() => "templates",
        Value::Array(list) if list.iter().any(|v| v.is_string() || is_of(&is_token, v)) => "mixed",
        Value::Object(object) if is_typed(object) => "typed-token",
        Value::Object(object) if object.is_empty() => "empty-object",
        Value::Object(object) if object.values().all(Value::is_string) => "object-of-texts",
        Value::Object(object) if is_token(object) => "token",
        Value::Object(object) if object.values().all(|v| is_of(&is_plain, v)) => "object-of-tokens",
        Value::Object(object) if object.values().any(|v| v.is_string() || is_of(&is_token, v)) => "mixed",
        _ => tokenizer_values::kind(value),
    }
}

fn is_template(object: &Map<String, Value>) -> bool {
    ["name", "template"].into_iter().all(|key| object.get(key).is_some_and(Value::is_string))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::{TokenizerConfigTable, TokenizerConfigs, kind};

    fn all(configs: &TokenizerConfigs) -> impl Iterator<Item = &String> {
        let of_classes = configs.classes.iter().filter_map(|(_, class)| class.get());
        let of_classes = of_classes.flat_map(|class| class.keys.values().chain(class.entry.values()));
        configs.keys.values().chain(configs.entry.values()).chain(of_classes)
    }

    #[test]
    fn every_class_has_a_letter_for_each_kind() {
        let table = TokenizerConfigTable::embedded().unwrap();
        for configs in table.versions.values() {
            assert!(configs.classes.iter().count() > 50);
            assert!(configs.classes.iter().all(|(name, class)| class.get().is_some() && configs.class(name).is_some()));
            assert!(all(configs).all(|letters| letters.len() == configs.kinds.len()));
        }
    }

    #[test]
    fn kinds_are_those_of_the_table_but_for_mixtures() {
        let table = TokenizerConfigTable::embedded().unwrap();
        for (value, name) in [
            (json!(["a"]), "texts"),
            (json!([1, 2.5]), "numbers"),
            (json!([{ "content": "a" }]), "tokens"),
            (json!([{ "__type": "AddedToken", "content": "a" }]), "typed-tokens"),
            (json!([{ "name": "default", "template": "a" }]), "templates"),
            (json!([[]]), "list"),
            (json!([]), "empty-list"),
            (json!({}), "empty-object"),
            (json!({ "content": "a" }), "object-of-texts"),
            (json!({ "content": "a", "lstrip": false }), "token"),
            (json!({ "__type": "AddedToken", "content": "a" }), "typed-token"),
            (json!({ "0": { "content": "a" } }), "object-of-tokens"),
            (json!({ "a": 1 }), "object"),
            (json!(7), "whole"),
            (json!(0.5), "fraction"),
            (json!(-1), "negative"),
            (json!("a"), "text"),
            (json!(null), "null"),
        ] {
            assert_eq!(kind(&value), name, "{value}");
            assert!(table.versions.values().all(|configs| configs.kinds.iter().any(|kind| kind == name)), "{name}");
        }
        assert_eq!(kind(&json!(["a", 1])), "mixed");
    }
}
