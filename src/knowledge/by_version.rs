//! Tables with one entry for each known version of transformers.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::loader::version_numbers;
use super::source::{self, DataError};

/// A file of `rules/` whose keys are versions.
#[derive(Debug, Clone, Default)]
pub(super) struct ByVersion<T> {
    entries: BTreeMap<Vec<u64>, T>,
}

impl<T: Deserialize<'static>> ByVersion<T> {
    /// The built-in file of this name.
    ///
    /// # Errors
    /// [`DataError`] when it is malformed.
    pub(super) fn embedded(file: &str) -> Result<Self, DataError> {
        let entries: BTreeMap<&str, T> = serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))?;
        Ok(Self { entries: entries.into_iter().map(|(version, entry)| (version_numbers(version), entry)).collect() })
    }
}

impl<T> ByVersion<T> {
    /// The entries of the next newer known version, and of the next older one; both are that of a known version. Between two
    /// versions either may hold.
    pub(super) fn around(&self, version: &str) -> (Option<&T>, Option<&T>) {
        let numbers = version_numbers(version);
        let newer = self.entries.range(numbers.clone()..).next();
        let older = self.entries.range(..=numbers).next_back();
        (newer.map(|(_, entry)| entry), older.map(|(_, entry)| entry))
    }

    /// The entry of this very version.
    pub(super) fn at(&self, version: &str) -> Option<&T> {
        self.entries.get(&version_numbers(version))
    }

    /// The entries, the oldest version first.
    pub(super) fn values(&self) -> impl DoubleEndedIterator<Item = &T> {
        self.entries.values()
    }
}
