//! Parts of configs that are of one class, whatever model type they name: `rules/fixed-parts.json`.

use std::collections::BTreeMap;

use super::Loader;
use super::source::{self, DataError};

/// By version of transformers and model type, the keys of the parts whose class the config class has fixed. Other parts are of
/// the class that their `model_type` names. `tools/loader_parts.py` tries every config class.
#[derive(Debug, Clone, Default)]
pub(super) struct FixedParts {
    versions: BTreeMap<String, BTreeMap<String, Vec<String>>>,
}

impl FixedParts {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; a test parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "fixed-parts.json";
        let versions = serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))?;
        Ok(Self { versions })
    }

    /// Whether the config class of this model type opens the part under `key` as a class of its own choice.
    pub fn has(&self, loader: Loader, model_type: &str, key: &str) -> bool {
        let keys = self.versions.get(loader.version()).and_then(|types| types.get(model_type));
        keys.is_some_and(|keys| keys.iter().any(|own| own == key))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_vision_config_of_qwen2_vl_is_fixed_and_that_of_llava_is_not() {
        let parts = FixedParts::embedded().unwrap();
        for loader in Loader::ALL {
            assert!(parts.has(loader, "qwen2_vl", "vision_config"), "{loader}");
            assert!(!parts.has(loader, "llava", "vision_config"), "{loader}");
        }
        assert_eq!(parts.versions.len(), Loader::ALL.len());
    }
}
