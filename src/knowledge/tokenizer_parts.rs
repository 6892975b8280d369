//! What the `tokenizers` library builds tokenizer.json from: `rules/tokenizer-parts.json5`.

use std::collections::BTreeSet;

use serde::Deserialize;

use super::source::{self, DataError};

/// A part of tokenizer.json, such as the normaliser.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenizerPart {
    /// JSON pointer of the part.
    pub pointer: String,
    /// The key of the list in a part of type `Sequence`; `None` where the library has no sequences.
    pub list: Option<String>,
    /// The types that the library builds.
    pub types: BTreeSet<String>,
}

impl TokenizerPart {
    /// The built-in parts.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        let file = "tokenizer-parts.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }
}
