//! Modules of transformers, and names in them, that a version lacks and another one has.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use super::by_version::ByVersion;
use super::source::DataError;

/// What one version lacks.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Lacking {
    /// Dotted names of modules and packages; what is in a missing package is not listed.
    modules: BTreeSet<String>,
    /// Names by module, separated by blanks.
    names: BTreeMap<String, String>,
}

impl Lacking {
    fn has_module(&self, module: &str) -> bool {
        let ends = module.match_indices('.').map(|(end, _)| end).chain([module.len()]);
        let mut parents = ends.filter_map(|end| module.get(..end));
        !parents.any(|parent| self.modules.contains(parent))
    }

    fn lacks(&self, module: &str, name: &str) -> bool {
        !self.has_module(module)
            || self.names.get(module).is_some_and(|names| names.split(' ').any(|other| other == name))
    }
}

/// `rules/modules.json`: what each version of transformers lacks; `tools/loader_modules.py` writes it.
#[derive(Debug, Clone, Default)]
pub struct LoaderModules {
    versions: ByVersion<Lacking>,
}

impl LoaderModules {
    /// The built-in lists. They are large, and read for checkpoints with Python modules alone.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; a test parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("modules.json")? })
    }

    /// Whether `version` certainly lacks a name of a module, or with an empty name the module: it is a known version that
    /// does, or is between two that do.
    #[must_use]
    pub fn lacks(&self, version: &str, module: &str, name: &str) -> bool {
        let (newer, older) = self.versions.around(version);
        [newer, older].into_iter().all(|around| around.is_some_and(|lists| lists.lacks(module, name)))
    }

    /// Whether `version` certainly lacks the module.
    #[must_use]
    pub fn lacks_module(&self, version: &str, module: &str) -> bool {
        self.lacks(version, module, "")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modules_and_names_depend_on_the_version() {
        let modules = LoaderModules::embedded().unwrap();
        let processing = "transformers.models.paligemma.processing_paligemma";
        assert!(modules.lacks("5.23.0", processing, "make_batched_images"));
        assert!(!modules.lacks("4.47.0", processing, "make_batched_images"));
        assert!(!modules.lacks("5.23.0", processing, "PaliGemmaProcessor"));
        assert!(modules.lacks_module("4.47.0", "transformers.models.gemma3.modeling_gemma3"));
        assert!(!modules.lacks_module("5.23.0", "transformers.models.gemma3.modeling_gemma3"));
        assert!(
            modules.lacks("4.47.0", "transformers", "Gemma3Config")
                && !modules.lacks("4.57.6", "transformers", "Gemma3Config")
        );
        // Nothing is known of versions outside those of the file.
        assert!(!modules.lacks("99.0.0", processing, "make_batched_images"));
        assert!(!modules.lacks("4.20.0", "transformers", "Gemma3Config"));
    }
}
