//! Values of config.json that classes refuse.

use std::collections::BTreeMap;

use memchr::memmem;
use serde::Deserialize;

use super::loader::version_numbers;
use super::source;

/// What one model class refuses, by pointers without the first slash; an unused list is empty.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case", default)]
pub struct ClassRefusals {
    /// Keys of activation functions: an unknown name raises `KeyError`.
    pub activation: Vec<String>,
    /// Keys of attention heads: a count that does not divide `hidden_size` beside it raises
    /// `StrictDataclassClassValidationError`.
    pub heads: Vec<String>,
    /// Keys of padding ids: an id beyond `vocab_size` beside it raises `AssertionError`.
    pub padding: Vec<String>,
    /// Keys of rope parameters: an unknown type raises `KeyError`.
    pub rope_type: Vec<String>,
    /// Keys of rope parameters: a type that needs a factor and has none raises `KeyError`.
    pub rope_factor: Vec<String>,
}

impl ClassRefusals {
    /// What both refuse; the key of rope parameters has another name since transformers 5.
    fn and(self, other: &Self) -> Self {
        let old = |key: &String| key.replace("rope_parameters", "rope_scaling");
        let both = |mine: Vec<String>, other: &[String]| -> Vec<String> {
            mine.into_iter().filter(|key| other.iter().any(|o| old(o) == old(key))).collect()
        };
        Self {
            activation: both(self.activation, &other.activation),
            heads: both(self.heads, &other.heads),
            padding: both(self.padding, &other.padding),
            rope_type: both(self.rope_type, &other.rope_type),
            rope_factor: both(self.rope_factor, &other.rope_factor),
        }
    }
}

/// `rules/refused/<version>.json`, which `tools/derive_architectures.py accepts` writes by trying every class. An entry is
/// one line, and only the lines that a check needs are parsed.
#[derive(Debug, Clone, Default)]
pub struct Refusals {
    versions: BTreeMap<&'static str, &'static str>,
}

impl Refusals {
    /// The built-in files.
    #[must_use]
    pub fn embedded() -> Self {
        let files = source::files("refused");
        Self { versions: files.filter_map(|(name, text)| Some((name.strip_suffix(".json")?, text))).collect() }
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

    fn entry(&self, version: &str, class: &str) -> Option<ClassRefusals> {
        let text = self.versions.get(version)?;
        let start = format!("\n{}: ", serde_json::Value::from(class));
        let at = memmem::find(text.as_bytes(), start.as_bytes())?.checked_add(start.len())?;
        let line = text.get(at..)?.lines().next()?;
        serde_json::from_str(line.strip_suffix(',').unwrap_or(line)).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_is_read_as_the_document_has_it() {
        let refusals = Refusals::embedded();
        assert!(refusals.versions.len() >= 3);
        for (version, text) in &refusals.versions {
            let document: serde_json::Value = serde_json::from_str(text).unwrap();
            for (class, entry) in document.as_object().unwrap() {
                let expected: ClassRefusals = serde_json::from_value(entry.clone()).unwrap();
                assert_eq!(refusals.of_class(version, class), Some(expected), "{version} {class}");
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
