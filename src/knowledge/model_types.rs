//! The model types that versions of transformers know.

use std::collections::{BTreeMap, BTreeSet};

use super::loader::version_numbers;
use super::source::{self, DataError};

/// `rules/model_types.json`: the keys of `CONFIG_MAPPING` by version of transformers; `tools/model_types.py` writes it.
#[derive(Debug, Clone, Default)]
pub struct ModelTypes {
    versions: BTreeMap<Vec<u64>, BTreeSet<String>>,
}

impl ModelTypes {
    /// The built-in lists.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "model_types.json";
        let lists: BTreeMap<String, BTreeSet<String>> = serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))?;
        Ok(Self { versions: lists.into_iter().map(|(version, types)| (version_numbers(&version), types)).collect() })
    }

    /// Whether `version` certainly does not know `model_type`: neither the next newer known version nor the next older
    /// one does. Versions newer than all known ones may know any.
    #[must_use]
    pub fn lacks(&self, version: &str, model_type: &str) -> bool {
        let numbers = version_numbers(version);
        let newer = self.versions.range(numbers.clone()..).next();
        let older = self.versions.range(..=numbers).next_back();
        newer.is_some_and(|(_, types)| !types.contains(model_type))
            && older.is_none_or(|(_, types)| !types.contains(model_type))
    }

    /// Whether any known version knows `model_type`.
    #[must_use]
    pub fn contains(&self, model_type: &str) -> bool {
        self.versions.values().any(|types| types.contains(model_type))
    }

    /// The model type that transformers 4 takes from a directory's name when config.json has none: the longest one in it.
    #[must_use]
    pub fn in_name(&self, version: &str, directory: &str) -> Option<&str> {
        let (_, types) = self.versions.range(version_numbers(version)..).next()?;
        types.iter().filter(|name| directory.contains(name.as_str())).max_by_key(|name| name.len()).map(String::as_str)
    }

    /// The known model type that `model_type` is a misspelling of: another separator or case, or a letter.
    #[must_use]
    pub fn similar(&self, model_type: &str) -> Option<&str> {
        let plain = |name: &str| name.to_ascii_lowercase().replace(['-', '.', ' '], "_");
        let all: BTreeSet<&str> = self.versions.values().flatten().map(String::as_str).collect();
        let likeness = |name: &str| strsim::damerau_levenshtein(&plain(name), &plain(model_type));
        let best = all.into_iter().map(|name| (likeness(name), name)).min()?;
        // Names of versions such as qwen2 and qwen3 differ in one letter.
        let digits = |name: &str| name.chars().filter(char::is_ascii_digit).collect::<String>();
        let is_close = best.0 == 0 || best.0 == 1 && model_type.len() >= 5 && digits(best.1) == digits(model_type);
        is_close.then_some(best.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_lacking_only_where_both_neighbours_lack_it() {
        let types = ModelTypes::embedded().unwrap();
        for (version, model_type, lacks) in [
            ("4.47.0", "llama", false),
            ("4.47.0", "qwen3", true),
            ("4.51.3", "qwen3", false),
            ("4.57.6", "qwen3", false),
            ("4.40.0", "bora_moe", true),
            ("4.51.3", "bora_moe", true),
            ("5.23.0", "bora_moe", true),
            ("5.24.0", "bora_moe", false),
            ("main", "llama", false),
        ] {
            assert_eq!(types.lacks(version, model_type), lacks, "{version} {model_type}");
        }
    }

    #[test]
    fn misspelt_types_have_a_similar_one() {
        let types = ModelTypes::embedded().unwrap();
        assert_eq!(types.similar("llava-onevision"), Some("llava_onevision"));
        assert_eq!(types.similar("Llama"), Some("llama"));
        assert_eq!(types.similar("qwen9"), None);
        assert_eq!(types.similar("bora_moe"), None);
        assert_eq!(types.in_name("4.47.0", "my-roberta-base"), Some("roberta"));
        assert_eq!(types.in_name("4.47.0", "model"), None);
    }
}
