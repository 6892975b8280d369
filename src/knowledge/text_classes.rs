//! Model types of language models inside other models.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::by_version::ByVersion;
use super::source::DataError;

/// The classes of a language model, and of the models that contain it.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TextClasses {
    /// The class that `AutoModelForCausalLM` builds for the model type of the language model alone.
    pub own: String,
    /// Classes of the whole models.
    pub whole: Vec<String>,
}

/// `rules/text-classes.json`: classes by the model type of the language model; `tools/loader_text_classes.py` writes it.
#[derive(Debug, Clone, Default)]
pub struct TextTypes {
    versions: ByVersion<BTreeMap<String, TextClasses>>,
}

impl TextTypes {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("text-classes.json")? })
    }

    /// The classes of this model type, by the newest version that has it.
    #[must_use]
    pub fn of(&self, model_type: &str) -> Option<&TextClasses> {
        self.versions.values().rev().find_map(|types| types.get(model_type))
    }
}
