//! Kinds of directories that are no checkpoint of transformers: `rules/directories.json5`.

use serde::Deserialize;

use super::expression::{Expression, Scope, Template};
use super::source::{self, DataError};
use super::statistics::Pattern;

/// `rules/directories.json5`.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Directories {
    /// Names of files with which some loader opens a model, an adapter or a pipeline. A directory with one of them may also
    /// have the state of a training run, and is opened nevertheless.
    weights: Vec<Pattern>,
    /// The kinds; of those that a directory matches, the first one applies.
    kinds: Vec<DirectoryKind>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    schema: Option<String>,
}

/// One kind of directory.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct DirectoryKind {
    /// A short name, in kebab case.
    pub name: String,
    /// What it is, with its article: `a ZeRO checkpoint of DeepSpeed`.
    pub is: String,
    /// Sets of names of its entries. A directory is of this kind when it has all names of one set; `*` is any run of
    /// characters within a name, and a folder ends with `/`. `check` visits directories with these names.
    #[serde(default)]
    signs: Vec<Vec<Pattern>>,
    /// Names that a directory of this kind does not have beside its signs.
    #[serde(default)]
    without: Vec<Pattern>,
    /// Folders that belong to it and are no checkpoints of their own.
    #[serde(default)]
    parts: Vec<Pattern>,
    /// Condition on documents of the checkpoint, instead of `signs`.
    #[serde(default)]
    when: Option<Expression>,
    /// The program that opens it; missing when none opens it as it is.
    #[serde(default)]
    pub opened_by: Option<String>,
    /// What to do to get a model that transformers opens, as an imperative. `{directory}` is the name of the directory.
    #[serde(default)]
    pub help: Option<Template>,
    /// Documentation or code, or the issue thread, that says so.
    #[allow(dead_code, reason = "for readers of the file")]
    references: Vec<String>,
}

impl DirectoryKind {
    /// The names that match one of the sets of signs; `None` when no set is complete, or when a name is of another kind.
    fn signs_in<'n, S: AsRef<str>>(&self, names: &'n [S]) -> Option<Vec<&'n str>> {
        if names.iter().any(|name| self.without.iter().any(|other| other.is_match(name.as_ref()))) {
            return None;
        }
        let found = |sign: &Pattern| names.iter().map(AsRef::as_ref).find(|name| sign.is_match(name));
        let complete = self.signs.iter().find_map(|set| set.iter().map(found).collect::<Option<Vec<_>>>());
        complete.filter(|signs| !signs.is_empty())
    }
}

/// The kind of a directory, and the names by which it was recognised.
#[derive(Debug, Clone)]
pub struct Recognised<'k> {
    /// The kind.
    pub kind: &'k DirectoryKind,
    /// Names of entries; empty when documents tell the kind.
    pub signs: Vec<String>,
}

impl Directories {
    /// The built-in kinds.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "directories.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// For the search of checkpoints: whether the names in a directory are those of a kind, and the folders among them that
    /// belong to it and are not searched.
    #[must_use]
    pub fn recognise(&self, names: &[String]) -> Option<Vec<String>> {
        let kind = self.kinds.iter().find(|kind| kind.signs_in(names).is_some())?;
        let is_part = |name: &&String| kind.parts.iter().any(|part| part.is_match(name));
        Some(names.iter().filter(is_part).cloned().collect())
    }

    /// The kind of a checkpoint with entries of these names, whose documents `scope` holds.
    #[must_use]
    pub fn kind_of(&self, names: &[String], scope: &Scope<'_>) -> Option<Recognised<'_>> {
        let is_opened = names.iter().any(|name| self.weights.iter().any(|weights| weights.is_match(name)));
        self.kinds.iter().find_map(|kind| {
            let signs = match &kind.when {
                Some(when) => when.eval_bool(scope).unwrap_or(false).then(Vec::new)?,
                None => kind.signs_in(names)?.into_iter().map(str::to_owned).collect(),
            };
            (kind.opened_by.is_some() || !is_opened).then_some(Recognised { kind, signs })
        })
    }

    /// The kinds, in the order of the file.
    pub fn kinds(&self) -> impl Iterator<Item = &DirectoryKind> {
        self.kinds.iter()
    }
}
