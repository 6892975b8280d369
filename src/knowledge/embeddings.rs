//! The tensor that embeds token ids, by its name.

use serde::Deserialize;

use super::source::{self, DataError};

/// `rules/embeddings.json5`: the names of token embeddings.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenEmbedding {
    /// Endings of the name.
    endings: Vec<String>,
    /// Parts of names of other embeddings.
    except: Vec<String>,
}

impl TokenEmbedding {
    /// The built-in names.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "embeddings.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// Whether a tensor of this name and shape embeds token ids.
    #[must_use]
    pub fn matches(&self, name: &str, shape: &[u64]) -> bool {
        shape.len() == 2
            && self.endings.iter().any(|ending| name.ends_with(ending))
            && !self.except.iter().any(|part| name.contains(part))
    }
}
