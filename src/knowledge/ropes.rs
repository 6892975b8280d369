//! Keys of rotary embeddings that config classes read: `rules/ropes.json`.

use std::collections::BTreeMap;

use serde_json::Value;

use super::Loader;
use super::source::{self, DataError};

/// By version of transformers and model type, the keys that the config class reads, with their defaults.
/// `tools/loader_ropes.py` writes them. Versions since 5 read every key in `rope_parameters`, and are not listed.
#[derive(Debug, Clone, Default)]
pub struct RopeKeys {
    versions: BTreeMap<String, BTreeMap<String, BTreeMap<String, Value>>>,
}

impl RopeKeys {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "ropes.json";
        let versions = serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))?;
        Ok(Self { versions })
    }

    /// The keys of a config class; `None` when it has no rotary embeddings, or reads `rope_parameters`.
    #[must_use]
    pub fn of(&self, loader: Loader, model_type: &str) -> Option<&BTreeMap<String, Value>> {
        self.versions.get(loader.version())?.get(model_type)
    }
}
