//! Parts of tensor names that wrappers add: `rules/wrappers.json5`.

use std::collections::BTreeSet;

use serde::Deserialize;

use super::source::{self, DataError};

/// `rules/wrappers.json5`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wrappers {
    /// Parts that may stand anywhere in a name.
    parts: Vec<WrapperPart>,
    /// Parts at the start of all names.
    starts: Vec<WrapperPart>,
    /// Parts of the names of an adapter's own tensors.
    adapters: Vec<String>,
}

/// What one wrapper adds.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct WrapperPart {
    /// One part of a name, or several with dots between them.
    part: String,
    /// The wrapper.
    #[allow(dead_code, reason = "for readers of the file")]
    by: String,
    /// The code that adds it.
    #[allow(dead_code, reason = "for readers of the file")]
    source: String,
}

impl Wrappers {
    /// The built-in parts.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; a test parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "wrappers.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// A name without the parts of wrappers, which are added to `removed`. Called for each stored name by the search for
    /// wrappers; `of_class` are the parts that names of the class have, which are no wrapper's.
    #[must_use]
    pub fn bare<'n>(&'n self, name: &'n str, of_class: &BTreeSet<&str>, removed: &mut BTreeSet<&'n str>) -> String {
        let known = |part: &str| self.parts.iter().any(|known| known.part == part) && !of_class.contains(part);
        let (taken, left): (Vec<&str>, Vec<&str>) = name.split('.').partition(|part| known(part));
        removed.extend(taken);
        let mut bare = left.join(".");
        while let Some((start, rest)) = self.started(&bare, of_class) {
            removed.insert(start);
            bare = rest.to_owned();
        }
        bare
    }

    /// The part of a wrapper at the start of a name, and the rest.
    fn started<'n>(&self, name: &'n str, of_class: &BTreeSet<&str>) -> Option<(&str, &'n str)> {
        let is_of_class = |start: &str| start.split('.').next().is_some_and(|first| of_class.contains(first));
        let mut starts = self.starts.iter().map(|start| start.part.as_str()).filter(|start| !is_of_class(start));
        starts.find_map(|start| Some((start, name.strip_prefix(start)?.strip_prefix('.')?)))
    }

    /// Whether a tensor is one of an adapter's own, by its name.
    #[must_use]
    pub fn is_of_adapter(&self, name: &str) -> bool {
        name.split('.').any(|part| self.adapters.iter().any(|adapter| adapter == part))
    }
}
