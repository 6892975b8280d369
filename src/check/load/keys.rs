//! How the loader spells names: textual renames, and the class's prefix put on or taken off.

use std::collections::BTreeSet;

use crate::knowledge::Expected;

/// A file key as the loader reads it: the first of four textual renames, wherever its text stands in the key.
pub(super) fn renamed(key: &str) -> String {
    const RENAMES: [(&str, &str); 4] = [
        ("beta", "bias"),
        ("gamma", "weight"),
        ("weight_g", "parametrizations.weight.original0"),
        ("weight_v", "parametrizations.weight.original1"),
    ];
    RENAMES
        .iter()
        .find(|(from, _)| key.contains(from))
        .map_or_else(|| key.to_owned(), |(from, to)| key.replace(from, to))
}

/// How names of the file and of the class differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Prefix {
    /// They do not.
    Same,
    /// The file holds a base model: the class's names lose the prefix.
    Removed,
    /// The file holds a larger model: the class's names gain the prefix.
    Added,
}

/// The spelling the loader chose for one file and one class.
pub(super) struct Spelling<'e> {
    name: &'e str,
    prefix: Prefix,
}

impl<'e> Spelling<'e> {
    /// By whether any key of each side starts with the prefix; the loader does not ask for a dot after it.
    pub(super) fn of(expected: &'e Expected, file: &BTreeSet<String>) -> Self {
        let name = expected.base_model_prefix.as_str();
        let file = file.iter().any(|key| key.starts_with(name));
        let model = expected.tensors.keys().any(|key| key.starts_with(name));
        let prefix = match (file, model) {
            (false, true) if !name.is_empty() => Prefix::Removed,
            (true, false) if !name.is_empty() => Prefix::Added,
            _ => Prefix::Same,
        };
        Self { name, prefix }
    }

    /// A name of the class as the file would spell it.
    pub(super) fn in_file(&self, model_name: &str) -> String {
        match self.prefix {
            Prefix::Same => model_name.to_owned(),
            Prefix::Removed => self.bare(model_name).unwrap_or(model_name).to_owned(),
            Prefix::Added => format!("{}.{model_name}", self.name),
        }
    }

    /// A key of the file as the class would spell it. The loader takes off the first segment, whatever it is.
    pub(super) fn in_model(&self, key: &str) -> String {
        match self.prefix {
            Prefix::Same => key.to_owned(),
            Prefix::Removed => format!("{}.{key}", self.name),
            Prefix::Added => key.split_once('.').map_or("", |(_, rest)| rest).to_owned(),
        }
    }

    /// Whether the loader raises because a file of a base model has keys of the head too.
    pub(super) fn is_corrupted(&self, expected: &Expected, file: &BTreeSet<String>) -> bool {
        expected.has_head
            && self.prefix == Prefix::Removed
            && file.iter().any(|key| {
                expected.tensors.contains_key(key)
                    && self.bare(key).is_none()
                    && !expected.tensors.contains_key(&format!("{}.{key}", self.name))
            })
    }

    fn bare<'n>(&self, name: &'n str) -> Option<&'n str> {
        name.strip_prefix(self.name)?.strip_prefix('.')
    }
}

/// Keys but for which more of the file would be recognised: they start with the prefix, and so decide for all others.
///
/// `recognised` counts the tensors of the class that a file with these names has, up to a number.
pub(super) fn hijackers<'f>(
    expected: &Expected,
    file: &'f BTreeSet<String>,
    recognised: impl Fn(&BTreeSet<String>, usize) -> usize,
) -> Vec<&'f str> {
    if expected.base_model_prefix.is_empty() {
        return Vec::new();
    }
    let is_stray = |key: &&String| key.starts_with(&expected.base_model_prefix);
    let others: BTreeSet<String> = file.iter().filter(|key| !is_stray(key)).cloned().collect();
    if others.is_empty() || others.len() == file.len() {
        return Vec::new();
    }
    // The others are few in most files: a head.
    let of_others = recognised(&others, usize::MAX);
    if of_others > recognised(file, of_others) {
        file.iter().filter(is_stray).map(String::as_str).collect()
    } else {
        Vec::new()
    }
}

/// Tensors of the class that a file with these names has, as transformers 4.47 spells them; counted up to `most`.
pub(super) fn recognised(expected: &Expected, file: &BTreeSet<String>, most: usize) -> usize {
    let spelling = Spelling::of(expected, file);
    expected.tensors.keys().filter(|name| file.contains(&spelling.in_file(name))).take(most).count()
}
