//! Tokenizer classes that take the vocabulary of tokenizer.json and build the rest of the tokenizer themselves.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use super::by_version::ByVersion;
use super::sorted::{Lazy, SortedMap};
use super::source::DataError;
use super::statistics::Pattern;

/// A tokenizer class with a constructor of its own. Source: the class opens files that `tools/loader_tokenizers.py` writes.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BuiltTokenizer {
    /// The type of the model that it builds, whatever type tokenizer.json has.
    pub model: String,
    /// Types of models in tokenizer.json with which it raises, and the exception.
    pub raises: BTreeMap<String, String>,
    /// What it writes before and after text: tokens, or attributes such as `cls_token`. `None` when it keeps the
    /// post-processor of tokenizer.json.
    pub around: Option<[Vec<String>; 2]>,
    /// The same for a tokenizer.json without a post-processor.
    pub without: [Vec<String>; 2],
    /// Keys of `tokenizer_config.json` that change what it writes.
    pub settings: Vec<String>,
    /// Special tokens that it has by default, by attribute.
    pub special: BTreeMap<String, String>,
    /// Tokens that it adds although no file has them.
    pub adds: BTreeSet<String>,
}

/// The classes of one version.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields, bound(deserialize = "'de: 'static"))]
pub struct BuiltTokenizers {
    /// By the name without `Fast`.
    classes: SortedMap<Lazy<BuiltTokenizer>>,
    /// Model types whose own class is opened whatever `tokenizer_config.json` names.
    pub overruled: BTreeSet<&'static str>,
    /// Patterns of `_name_or_path`, in lower case, with which tokenizer.json is opened as it is.
    pub as_is: Vec<Pattern>,
    /// Classes of transformers 4 that do not keep the post-processor of tokenizer.json, by the name without `Fast`.
    replaces: BTreeSet<&'static str>,
}

impl BuiltTokenizers {
    /// The class of this name without `Fast`.
    #[must_use]
    pub fn class(&self, name: &str) -> Option<&BuiltTokenizer> {
        self.classes.get(name)?.get()
    }
}

/// `rules/tokenizers.json`, which `tools/loader_tokenizers.py` writes. transformers 4 opens tokenizer.json as it is, so its
/// versions have no classes.
#[derive(Debug, Clone, Default)]
pub struct TokenizerClasses {
    versions: ByVersion<BuiltTokenizers>,
}

impl TokenizerClasses {
    /// The built-in classes.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("tokenizers.json")? })
    }

    /// The classes of a loader's version; `None` for one that opens tokenizer.json as it is.
    #[must_use]
    pub fn of(&self, version: &str) -> Option<&BuiltTokenizers> {
        self.versions.at(version)
    }

    /// Whether a version before the class took the vocabulary alone replaced the post-processor too, so that nothing changed.
    #[must_use]
    pub fn always_replaces(&self, class: &str) -> bool {
        self.versions.values().any(|built| built.replaces.contains(class))
    }
}

#[cfg(test)]
mod tests {
    use super::TokenizerClasses;

    #[test]
    fn every_class_is_well_formed() {
        let classes = TokenizerClasses::embedded().unwrap();
        let all: Vec<_> = classes.versions.values().flat_map(|built| built.classes.iter()).collect();
        let malformed: Vec<_> = all.iter().filter(|(_, class)| class.get().is_none()).map(|(name, _)| name).collect();
        assert!(all.len() > 20 && malformed.is_empty(), "{} classes, {malformed:?}", all.len());
    }
}
