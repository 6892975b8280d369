//! The names that versions of transformers accept in config.json.

use std::collections::BTreeSet;

use serde::Deserialize;

use super::by_version::ByVersion;
use super::source::DataError;

/// Names in the order of their bytes, as the file has them.
type Sorted = Vec<&'static str>;

/// The names of one version.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, bound(deserialize = "'de: 'static"))]
struct Lists {
    activations: Sorted,
    dtypes: Sorted,
    model_types: Sorted,
    processors: Sorted,
    quantization: Sorted,
    rope_types: Sorted,
}

/// A list of names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NameKind {
    /// `ACT2FN`: activation functions.
    Activation,
    /// Names of `torch.dtype` in torch.
    Dtype,
    /// `CONFIG_MAPPING`: model types.
    ModelType,
    /// Model types of `PROCESSOR_MAPPING` whose processor has an image processor or a feature extractor.
    Processor,
    /// `AUTO_QUANTIZATION_CONFIG_MAPPING`: values of `quant_method`.
    QuantMethod,
    /// `ROPE_INIT_FUNCTIONS`: values of `rope_type`.
    RopeType,
}

impl Lists {
    fn contains(&self, kind: NameKind, name: &str) -> bool {
        self.of(kind).binary_search(&name).is_ok()
    }

    const fn of(&self, kind: NameKind) -> &Sorted {
        match kind {
            NameKind::Activation => &self.activations,
            NameKind::Dtype => &self.dtypes,
            NameKind::ModelType => &self.model_types,
            NameKind::Processor => &self.processors,
            NameKind::QuantMethod => &self.quantization,
            NameKind::RopeType => &self.rope_types,
        }
    }
}

/// `rules/names.json`: the names by version of transformers; `tools/loader_names.py` writes it.
#[derive(Debug, Clone, Default)]
pub struct LoaderNames {
    versions: ByVersion<Lists>,
}

impl LoaderNames {
    /// The built-in lists.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("names.json")? })
    }

    /// Whether `version` certainly does not know the name: neither the next newer known version nor the next older one
    /// does. Versions newer than all known ones may know any name.
    #[must_use]
    pub fn lacks(&self, version: &str, kind: NameKind, name: &str) -> bool {
        let (newer, older) = self.versions.around(version);
        let lacks = |lists: &Lists| !lists.contains(kind, name);
        newer.is_some_and(lacks) && older.is_none_or(lacks)
    }

    /// Whether any known version knows the name.
    #[must_use]
    pub fn contains(&self, kind: NameKind, name: &str) -> bool {
        self.versions.values().any(|lists| lists.contains(kind, name))
    }

    /// The model type that transformers 4 takes from a directory's name when config.json has none: the longest one in it.
    #[must_use]
    pub fn model_type_in(&self, version: &str, directory: &str) -> Option<&str> {
        let (Some(lists), _) = self.versions.around(version) else { return None };
        let found = lists.model_types.iter().filter(|name| directory.contains(**name));
        found.max_by_key(|name| name.len()).copied()
    }

    /// The known name that `name` is a misspelling of: another separator or case, or a letter.
    #[must_use]
    pub fn similar(&self, kind: NameKind, name: &str) -> Option<&str> {
        // No name is this long, and the comparison takes as much memory.
        if name.len() > 64 {
            return None;
        }
        let plain = |name: &str| name.to_ascii_lowercase().replace(['-', '.', ' '], "_");
        let all: BTreeSet<&str> = self.versions.values().flat_map(|lists| lists.of(kind)).copied().collect();
        let likeness = |other: &str| strsim::damerau_levenshtein(&plain(other), &plain(name));
        let best = all.into_iter().map(|other| (likeness(other), other)).min()?;
        // Names of versions such as qwen2 and qwen3 differ in one letter.
        let digits = |name: &str| name.chars().filter(char::is_ascii_digit).collect::<String>();
        let is_close = best.0 == 0 || best.0 == 1 && name.len() >= 5 && digits(best.1) == digits(name);
        is_close.then_some(best.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_is_sorted() {
        for lists in LoaderNames::embedded().unwrap().versions.values() {
            let Lists { activations, dtypes, model_types, processors, quantization, rope_types } = lists;
            for names in [activations, dtypes, model_types, processors, quantization, rope_types] {
                assert!(names.is_sorted() && !names.is_empty(), "{names:?}");
            }
        }
    }

    #[test]
    fn a_name_is_lacking_only_where_both_neighbours_lack_it() {
        let names = LoaderNames::embedded().unwrap();
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
            assert_eq!(names.lacks(version, NameKind::ModelType, model_type), lacks, "{version} {model_type}");
        }
    }

    #[test]
    fn misspelt_types_have_a_similar_one() {
        let names = LoaderNames::embedded().unwrap();
        assert_eq!(names.similar(NameKind::ModelType, "llava-onevision"), Some("llava_onevision"));
        assert_eq!(names.similar(NameKind::ModelType, "Llama"), Some("llama"));
        assert_eq!(names.similar(NameKind::ModelType, "qwen9"), None);
        assert_eq!(names.similar(NameKind::ModelType, "bora_moe"), None);
        assert_eq!(names.model_type_in("4.47.0", "my-roberta-base"), Some("roberta"));
        assert_eq!(names.model_type_in("4.47.0", "model"), None);
    }
}
