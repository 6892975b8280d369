//! Modules of transformers, and names in them, that a version lacks and another one has.

use serde::Deserialize;

use super::by_version::ByVersion;
use super::sorted::SortedMap;
use super::source::DataError;

/// What one version lacks.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, bound(deserialize = "'de: 'static"))]
struct Lacking {
    /// Dotted names of modules and packages, sorted; what is in a missing package is not listed.
    modules: Vec<&'static str>,
    /// Names by module, separated by blanks.
    names: SortedMap<&'static str>,
}

impl Lacking {
    fn has_module(&self, module: &str) -> bool {
        let ends = module.match_indices('.').map(|(end, _)| end).chain([module.len()]);
        let mut parents = ends.filter_map(|end| module.get(..end));
        !parents.any(|parent| self.modules.binary_search(&parent).is_ok())
    }

    fn lacks(&self, module: &str, name: &str) -> bool {
        !self.has_module(module) || self.names.get(module).is_some_and(|names| has_word(names, name))
    }
}

/// Whether a text of words with blanks between them has a word.
fn has_word(text: &str, word: &str) -> bool {
    let is_edge = |byte: Option<&u8>| byte.is_none_or(|byte| *byte == b' ');
    let bytes = text.as_bytes();
    let mut found = memchr::memmem::find_iter(bytes, word);
    found.any(|at| {
        is_edge(at.checked_sub(1).and_then(|before| bytes.get(before)))
            && is_edge(at.checked_add(word.len()).and_then(|after| bytes.get(after)))
    })
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

    /// The modules of a version, as far as they are certain.
    #[must_use]
    pub fn of(&self, version: &str) -> VersionModules<'_> {
        let (newer, older) = self.versions.around(version);
        VersionModules(newer.zip(older))
    }
}

/// The modules of a version. It lacks what a known version lacks, or what the two versions around it lack.
#[derive(Debug, Clone, Copy)]
pub struct VersionModules<'k>(Option<(&'k Lacking, &'k Lacking)>);

impl VersionModules<'_> {
    /// Whether it lacks the module.
    #[must_use]
    pub fn lacks_module(&self, module: &str) -> bool {
        self.0.is_some_and(|(newer, older)| !newer.has_module(module) && !older.has_module(module))
    }

    /// Whether it lacks a name of a module, or the module.
    #[must_use]
    pub fn lacks_name(&self, module: &str, name: &str) -> bool {
        self.0.is_some_and(|(newer, older)| newer.lacks(module, name) && older.lacks(module, name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_modules_are_sorted() {
        assert!(LoaderModules::embedded().unwrap().versions.values().all(|lacking| lacking.modules.is_sorted()));
    }

    #[test]
    fn modules_and_names_depend_on_the_version() {
        let modules = LoaderModules::embedded().unwrap();
        let processing = "transformers.models.paligemma.processing_paligemma";
        assert!(modules.of("5.23.0").lacks_name(processing, "make_batched_images"));
        assert!(!modules.of("4.47.0").lacks_name(processing, "make_batched_images"));
        assert!(!modules.of("5.23.0").lacks_name(processing, "PaliGemmaProcessor"));
        assert!(modules.of("4.47.0").lacks_module("transformers.models.gemma3.modeling_gemma3"));
        assert!(!modules.of("5.23.0").lacks_module("transformers.models.gemma3.modeling_gemma3"));
        assert!(
            modules.of("4.47.0").lacks_name("transformers", "Gemma3Config")
                && !modules.of("4.57.6").lacks_name("transformers", "Gemma3Config")
        );
        assert!(has_word("one two", "one") && has_word("one two", "two") && has_word("ones one", "one"));
        assert!(!has_word("ones two", "one") && !has_word("one twos", "two"));
        // Nothing is known of versions outside those of the file.
        assert!(!modules.of("99.0.0").lacks_name(processing, "make_batched_images"));
        assert!(!modules.of("4.20.0").lacks_name("transformers", "Gemma3Config"));
    }
}
