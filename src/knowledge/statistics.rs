//! Where policies of robots keep their statistics: `rules/statistics.json5`.

use fast_glob::glob_match;
use serde::Deserialize;

use super::source::{self, DataError};

/// `rules/statistics.json5`.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StatisticsPlaces {
    /// Documents with statistics.
    pub documents: Vec<StatisticsDocument>,
    /// Names of shards whose tensors are statistics.
    pub shards: Vec<Pattern>,
    /// Starts of names of tensors that are statistics, in any shard.
    pub buffers: Vec<String>,
}

/// A kind of document with statistics.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StatisticsDocument {
    /// The family of policies.
    #[allow(dead_code, reason = "for readers of the file")]
    of: String,
    /// Pattern for the file.
    pub file: Pattern,
    /// JSON pointer of the sets of statistics, in which the step `*` is any key. A set is an object with a list under `mean`,
    /// `q01` or another name of a statistic.
    pub sets: String,
    /// Code that reads them.
    #[allow(dead_code, reason = "for readers of the file")]
    references: Vec<String>,
}

/// A pattern for file names, in which `*` does not match `/`. Most are used once or not at all, so none is compiled.
#[derive(Debug, Clone, Deserialize)]
#[serde(transparent)]
pub struct Pattern(String);

impl Pattern {
    /// Whether the pattern matches a name.
    #[must_use]
    pub fn is_match(&self, name: &str) -> bool {
        glob_match(&self.0, name)
    }
}

impl StatisticsPlaces {
    /// The built-in places.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "statistics.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }
}
