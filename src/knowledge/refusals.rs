//! Values of config.json that classes refuse.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

use super::loader::version_numbers;
use super::source;

/// What one model class refuses, by pointers without the first slash; an unused list is empty.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case", default)]
pub struct ClassRefusals {
    /// Keys of activation functions: an unknown name raises `KeyError`.
    pub activation: Vec<String>,
    /// Counts of attention heads that have to divide a width.
    pub heads: Vec<Heads>,
    /// Keys of padding ids: an id beyond `vocab_size` beside it raises `AssertionError`.
    pub padding: Vec<String>,
    /// Keys of rope parameters: an unknown type raises `KeyError`.
    pub rope_type: Vec<String>,
    /// Keys of rope parameters: a type that needs a factor and has none raises `KeyError`.
    pub rope_factor: Vec<String>,
    /// Keys of rope parameters that nothing fills in: a type that needs `original_max_position_embeddings` raises `KeyError`
    /// without it.
    pub rope_length: Vec<String>,
    /// Numbers that have to be smaller than others.
    pub below: Vec<Below>,
    /// Types of rope that raise with sound parameters.
    pub ropes: Vec<Ropes>,
    /// Keys of which only a few words load.
    pub words: Vec<Words>,
    /// Lists that must have as many elements as others beside them.
    pub lengths: Vec<Lengths>,
    /// Defaults of keys that are compared with others, by pointer.
    pub defaults: BTreeMap<String, u64>,
    /// The exception that a parameter raises that is stored as integers.
    pub integers: Option<String>,
    /// Whether the class can generate: a generation config is made of its config, which refuses [`GENERATES`] as well.
    pub generates: bool,
    /// Kinds of values that raise whatever else the config has.
    values: Option<Values>,
}

/// A count of attention heads, the key beside it that it has to divide, and the exception otherwise.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Heads(pub String, pub String, pub String);

/// A key, the key beside it that has to hold a larger number, and the exception otherwise.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Below(pub String, pub String, pub String);

/// A key of rope parameters, the exception of some types of rope, these types, and a key beside it that they need; empty for none.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Ropes(pub String, pub String, pub Vec<String>, pub String);

/// A key that holds a word, the exception that an unknown word raises, and the words that load.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Words(pub String, pub String, pub Vec<String>);

/// Lists that must have the same length, or a list and the count of its elements, and the exception otherwise.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Lengths(pub Vec<String>, pub String);

#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(untagged)]
enum Values {
    /// Those of this class.
    Of(String),
    Own(Vec<RefusedValues>),
}

/// An exception, the kinds of values that raise it, and the keys.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct RefusedValues {
    /// Name of the class of the exception.
    pub raises: String,
    /// Kinds of values.
    pub kinds: Vec<ValueKind>,
    /// Pointers without the first slash.
    pub keys: Vec<String>,
}

/// A kind of JSON value, as `tools/derive/accepts.py` tries them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(serde::Serialize))]
#[serde(rename_all = "kebab-case")]
pub enum ValueKind {
    /// `null`.
    Null,
    /// Any string.
    Text,
    /// `true`.
    True,
    /// `false`.
    False,
    /// The whole number 0: a field of transformers 5 may take 0.0.
    Zero,
    /// A whole number below 0.
    Negative,
    /// A number that is not whole.
    Fraction,
    /// A number above 1.
    AboveOne,
    /// Any list.
    List,
    /// Any object.
    Object,
}

impl ValueKind {
    /// Whether a value is of this kind.
    #[must_use]
    pub fn has(self, value: &Value) -> bool {
        let (whole, number) = (value.as_i64(), value.as_f64());
        match self {
            Self::Null => value.is_null(),
            Self::Text => value.is_string(),
            Self::True => value == &Value::Bool(true),
            Self::False => value == &Value::Bool(false),
            Self::Zero => whole == Some(0),
            Self::Negative => whole.is_some_and(|n| n < 0),
            Self::Fraction => number.is_some_and(|n| n.fract() != 0.0),
            Self::AboveOne => number.is_some_and(|n| n > 1.0),
            Self::List => value.is_array(),
            Self::Object => value.is_object(),
        }
    }
}

impl ClassRefusals {
    /// Kinds of values that raise whatever else the config has.
    #[must_use]
    pub fn values(&self) -> &[RefusedValues] {
        match &self.values {
            Some(Values::Own(values)) => values,
            _ => &[],
        }
    }

    /// The same for a config whose part under `key` is of another model type than the class was tried with: what the class
    /// of that part refuses, in place of what was found under the key.
    #[must_use]
    pub fn with_part(mut self, key: &str, part: Self) -> Self {
        let under = format!("{key}/");
        let replaced = |mut own: Vec<String>, others: Vec<String>| {
            own.retain(|pointer| !pointer.starts_with(&under));
            own.extend(others.iter().map(|pointer| format!("{under}{pointer}")));
            own
        };
        self.heads.retain(|Heads(pointer, ..)| !pointer.starts_with(&under));
        self.heads.extend(
            part.heads.iter().cloned().map(|Heads(at, width, raises)| Heads(under.clone() + &at, width, raises)),
        );
        self.words.retain(|Words(pointer, ..)| !pointer.starts_with(&under));
        self.words
            .extend(part.words.iter().cloned().map(|Words(at, raises, load)| Words(under.clone() + &at, raises, load)));
        self.below.retain(|Below(pointer, ..)| !pointer.starts_with(&under));
        self.below.extend(part.below.iter().cloned().map(|row| Below(under.clone() + &row.0, row.1, row.2)));
        self.ropes.retain(|Ropes(pointer, ..)| !pointer.starts_with(&under));
        self.ropes.extend(part.ropes.iter().cloned().map(|row| Ropes(under.clone() + &row.0, row.1, row.2, row.3)));
        self.lengths.retain(|Lengths(group, _)| !group.iter().any(|pointer| pointer.starts_with(&under)));
        self.lengths.extend(
            part.lengths.iter().cloned().map(|Lengths(group, raises)| Lengths(replaced(Vec::new(), group), raises)),
        );
        self.defaults.retain(|pointer, _| !pointer.starts_with(&under));
        self.defaults.extend(part.defaults.iter().map(|(pointer, value)| (format!("{under}{pointer}"), *value)));
        let own =
            self.values().iter().cloned().map(|row| RefusedValues { keys: replaced(row.keys, Vec::new()), ..row });
        let others =
            part.values().iter().cloned().map(|row| RefusedValues { keys: replaced(Vec::new(), row.keys), ..row });
        let values = own.chain(others).filter(|row| !row.keys.is_empty()).collect();
        Self {
            activation: replaced(self.activation, part.activation),
            padding: replaced(self.padding, part.padding),
            rope_type: replaced(self.rope_type, part.rope_type),
            rope_factor: replaced(self.rope_factor, part.rope_factor),
            rope_length: replaced(self.rope_length, part.rope_length),
            values: Some(Values::Own(values)),
            ..self
        }
    }

    /// The same for the class of a part whose config stands under `key` of a larger one. Its values of generation are not judged.
    #[must_use]
    pub fn inside(self, key: &str) -> Self {
        Self { integers: self.integers.clone(), ..Self::default() }.with_part(key, self)
    }

    /// What both refuse; the key of rope parameters has another name since transformers 5.
    fn and(self, other: &Self) -> Self {
        let old = |key: &String| key.replace("rope_parameters", "rope_scaling");
        let both = |mine: Vec<String>, other: &[String]| -> Vec<String> {
            mine.into_iter().filter(|key| other.iter().any(|o| old(o) == old(key))).collect()
        };
        let refused = |key: &str, kind: ValueKind| {
            other.values().iter().any(|v| v.kinds.contains(&kind) && v.keys.iter().any(|k| k == key))
        };
        let of_key = |raises: &str, kinds: &[ValueKind], key: String| RefusedValues {
            raises: raises.to_owned(),
            kinds: kinds.iter().copied().filter(|kind| refused(&key, *kind)).collect(),
            keys: vec![key],
        };
        let values =
            self.values().iter().flat_map(|v| v.keys.iter().map(|key| of_key(&v.raises, &v.kinds, key.clone())));
        let values = Some(Values::Own(values.filter(|v| !v.kinds.is_empty()).collect()));
        let words = |Words(key, raises, load): Words| {
            let Words(.., others) = other.words.iter().find(|o| o.0 == key)?;
            Some(Words(key, raises, load.iter().chain(others).cloned().collect()))
        };
        Self {
            words: self.words.into_iter().filter_map(words).collect(),
            below: self
                .below
                .into_iter()
                .filter(|row| other.below.iter().any(|o| (&o.0, &o.1) == (&row.0, &row.1)))
                .collect(),
            ropes: self
                .ropes
                .into_iter()
                .filter(|row| other.ropes.iter().any(|o| o.2 == row.2 && o.3 == row.3))
                .collect(),
            lengths: self.lengths.into_iter().filter(|row| other.lengths.iter().any(|o| o.0 == row.0)).collect(),
            activation: both(self.activation, &other.activation),
            heads: self.heads.into_iter().filter(|Heads(key, ..)| other.heads.iter().any(|o| o.0 == *key)).collect(),
            padding: both(self.padding, &other.padding),
            rope_type: both(self.rope_type, &other.rope_type),
            rope_factor: both(self.rope_factor, &other.rope_factor),
            rope_length: both(self.rope_length, &other.rope_length),
            defaults: self.defaults,
            integers: self.integers.filter(|_| other.integers.is_some()),
            generates: self.generates && other.generates,
            values,
        }
    }
}

/// The entry with what every class refuses.
pub const EVERY_CLASS: &str = "*";

/// The entry with what the config class of nearly every part refuses of that.
pub const OF_PARTS: &str = "*parts";

/// The entry with what every class refuses that can generate.
pub const GENERATES: &str = "*generates";

/// `rules/refused/<version>.json`, which `tools/derive_architectures.py accepts` writes by trying every class. An entry is
/// one line, and only the lines that a check needs are parsed.
#[derive(Debug, Clone, Default)]
pub struct Refusals {
    versions: BTreeMap<&'static str, &'static [u8]>,
}

impl Refusals {
    /// The built-in files.
    #[must_use]
    pub fn embedded() -> Self {
        Self { versions: source::embedded_bytes("refused", ".json").collect() }
    }

    /// What the model class refuses under this version. Where it was not tried there, what both the next older and the
    /// next newer version refuse.
    #[must_use]
    pub fn of_class(&self, version: &str, class: &str) -> Option<ClassRefusals> {
        let numbers = version_numbers(version);
        let entry = |version: &&'static str| self.entry(version, class);
        let between = || {
            let older = self.versions.keys().filter(|v| version_numbers(v) < numbers).rev().find_map(entry)?;
            let newer = self.versions.keys().filter(|v| version_numbers(v) > numbers).find_map(entry)?;
            Some(older.and(&newer))
        };
        self.entry(version, class).or_else(between)
    }

    /// Whether the class was built with values of every kind under some version, so that what it refuses is in its entry.
    #[must_use]
    pub fn is_tried(&self, class: &str) -> bool {
        self.versions.keys().any(|version| self.line(version, class).is_some())
    }

    fn entry(&self, version: &str, class: &str) -> Option<ClassRefusals> {
        let mut entry = self.line(version, class)?;
        if let Some(Values::Of(other)) = &entry.values {
            entry.values = self.line(version, other)?.values;
        }
        Some(entry)
    }

    fn line(&self, version: &str, class: &str) -> Option<ClassRefusals> {
        // The first line and the last one are the braces of the file.
        let lines = self.versions.get(version)?.strip_prefix(b"{\n")?.strip_suffix(b"\n}\n")?;
        let entry = source::bisect(lines, class, "\"", "\": ")?;
        serde_json::from_str(entry.strip_suffix(',').unwrap_or(entry)).ok()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use serde_json::{Map, json};

    use super::*;
    use crate::knowledge::{Library, Loader};

    #[test]
    fn kinds_of_values() {
        use ValueKind::*;
        let all = [Null, Text, True, False, Zero, Negative, Fraction, AboveOne, List, Object];
        for (value, kinds) in [
            (json!(null), vec![Null]),
            (json!("x"), vec![Text]),
            (json!(true), vec![True]),
            (json!(false), vec![False]),
            (json!(0), vec![Zero]),
            (json!(0.0), vec![]),
            (json!(-1), vec![Negative]),
            (json!(0.5), vec![Fraction]),
            (json!(1.5), vec![Fraction, AboveOne]),
            (json!(7), vec![AboveOne]),
            (json!([]), vec![List]),
            (json!({}), vec![Object]),
        ] {
            let found: Vec<ValueKind> = all.into_iter().filter(|kind| kind.has(&value)).collect();
            assert_eq!(found, kinds, "{value}");
        }
    }

    /// (version, class, key, kind) of each refused kind of value that the declared type of its key has. The types are those of
    /// transformers 5.23.0. Zero, negative numbers, fractions and large numbers are ranges, which a type says nothing of.
    fn contradictions(refusals: &Refusals) -> BTreeSet<(String, String, String, String)> {
        let library = Library::embedded();
        let mut found = BTreeSet::new();
        for (version, text) in &refusals.versions {
            let document: Map<String, Value> = serde_json::from_slice(text).unwrap();
            for class in document.keys() {
                let Some(architecture) = library.class(class, Loader::NEWEST) else { continue };
                for row in refusals.of_class(version, class).unwrap().values() {
                    for key in &row.keys {
                        let Some(declared) = architecture.declared_type(key) else { continue };
                        let kinds = row.kinds.iter().filter(|kind| declared.has_kind(**kind));
                        let row = |kind: &ValueKind| serde_json::to_value(kind).unwrap().as_str().unwrap().to_owned();
                        let of_key = |kind| ((*version).to_owned(), class.clone(), key.clone(), row(kind));
                        found.extend(kinds.map(of_key));
                    }
                }
            }
        }
        found
    }

    /// A value that the declared type has may be refused for its content alone. `tests/data/refused-kinds.json` has the
    /// proof of each such kind: the values that the real class raised on, of the right element type and length.
    #[test]
    #[allow(clippy::disallowed_methods, reason = "reads a file of this repository")]
    fn no_declared_kind_of_value_is_refused_without_proof() {
        let proofs = std::fs::read_to_string("tests/data/refused-kinds.json").unwrap();
        let proofs: BTreeMap<String, BTreeMap<String, BTreeMap<String, String>>> =
            serde_json::from_str(&proofs).unwrap();
        let proven: BTreeSet<(&String, &String, &String)> = proofs
            .iter()
            .flat_map(|(version, classes)| {
                classes.iter().flat_map(move |(class, kinds)| kinds.keys().map(move |kind| (version, class, kind)))
            })
            .collect();
        let found = contradictions(&Refusals::embedded());
        let of_key: BTreeSet<_> =
            found.iter().map(|(version, class, key, kind)| (version, class, format!("{key} {kind}"))).collect();
        let unproven: Vec<_> =
            found.iter().filter(|(v, c, key, kind)| !proven.contains(&(v, c, &format!("{key} {kind}")))).collect();
        let rows: Vec<_> = unproven.iter().map(|row| serde_json::to_string(row).unwrap()).collect();
        assert!(unproven.is_empty(), "{} kinds have no proof:\n{}", unproven.len(), rows.join("\n"));
        let stale: Vec<_> = proven.iter().filter(|(v, c, kind)| !of_key.contains(&(*v, *c, (*kind).clone()))).collect();
        assert!(stale.is_empty(), "{stale:?}");
    }

    #[test]
    fn every_line_is_read_as_the_document_has_it() {
        let refusals = Refusals::embedded();
        assert!(refusals.versions.len() >= 3);
        for (version, text) in &refusals.versions {
            let document: Value = serde_json::from_slice(text).unwrap();
            for (class, entry) in document.as_object().unwrap() {
                let expected: ClassRefusals = serde_json::from_value(entry.clone()).unwrap();
                assert_eq!(refusals.line(version, class), Some(expected), "{version} {class}");
                let whole = refusals.of_class(version, class).unwrap();
                assert!(!matches!(whole.values, Some(Values::Of(_))), "{version} {class}");
            }
        }
        assert_eq!(refusals.of_class("4.47.0", "llama"), None);
        // A version between two known ones.
        let llama = refusals.of_class("4.51.3", "LlamaForCausalLM").unwrap();
        assert_eq!(
            (llama.activation, llama.rope_type),
            (vec!["hidden_act".to_owned()], vec!["rope_scaling".to_owned()])
        );
    }
}
