//! Where policies of robots keep their statistics: `rules/statistics.json5`.

use std::borrow::Cow;

use globset::GlobSet;
use serde::{Deserialize, Deserializer};

use super::source::{self, DataError};
use crate::checkpoint::glob::glob;

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

/// A pattern for file names, in which `*` does not match `/`.
#[derive(Debug, Clone)]
pub struct Pattern(GlobSet);

impl Pattern {
    /// Whether the pattern matches a name.
    #[must_use]
    pub fn is_match(&self, name: &str) -> bool {
        self.0.is_match(name)
    }
}

impl<'de> Deserialize<'de> for Pattern {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = Cow::<str>::deserialize(deserializer)?;
        glob(&text).map(Self).map_err(|reason| serde::de::Error::custom(format!("not a pattern: {reason}")))
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
