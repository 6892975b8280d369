//! What programs write in pickles beside the weights: `rules/pickles/written.json5`.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use crate::checkpoint::PickleGlobal;
use crate::knowledge::statistics::Pattern;

/// `rules/pickles/written.json5`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Written {
    /// Imports by the library that writes them.
    groups: BTreeMap<String, ImportGroup>,
    /// Kinds of files; the first that fits decides.
    files: Vec<FileKind>,
}

/// Imports of one library.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct ImportGroup {
    /// Modules with attributes, joined.
    imports: BTreeSet<String>,
    /// Classes that may be imported with their members.
    enums: BTreeSet<String>,
    /// Patterns for modules of which every class may be imported.
    classes: Vec<Pattern>,
}

/// Files with the same content.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileKind {
    /// Patterns for names.
    names: Vec<Pattern>,
    /// The content, as a message calls it.
    what: String,
    /// The groups of imports.
    groups: Vec<String>,
}

impl Written {
    fn kind(&self, file: &str) -> Option<&FileKind> {
        self.files.iter().find(|kind| kind.names.iter().any(|pattern| pattern.is_match(file)))
    }

    /// What a file of this name contains.
    pub(super) fn content(&self, file: &str) -> &str {
        self.kind(file).map_or("such a file", |kind| &kind.what)
    }

    /// Whether programs write this import in a file of this name.
    pub(super) fn has(&self, file: &str, global: &PickleGlobal) -> bool {
        let groups = self.kind(file).into_iter().flat_map(|kind| &kind.groups).filter_map(|name| self.groups.get(name));
        groups.into_iter().any(|group| group.has(global))
    }

    /// The groups that a kind of file names and that do not exist.
    #[cfg(test)]
    pub(super) fn unknown_groups(&self) -> Vec<&String> {
        self.files.iter().flat_map(|kind| &kind.groups).filter(|name| !self.groups.contains_key(*name)).collect()
    }
}

impl ImportGroup {
    fn has(&self, PickleGlobal { module, name, .. }: &PickleGlobal) -> bool {
        let path = format!("{module}.{name}");
        let is_member = || {
            path.rsplit_once('.').is_some_and(|(class, member)| self.enums.contains(class) && !member.starts_with('_'))
        };
        let is_class =
            !name.contains('.') && name.trim_start_matches('_').starts_with(|c: char| c.is_ascii_uppercase());
        self.imports.contains(&path)
            || self.enums.contains(&path)
            || is_member()
            || is_class && self.classes.iter().any(|pattern| pattern.is_match(module))
    }
}
