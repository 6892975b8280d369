//! Checks of checkpoint directories.

use std::path::Path;
use std::sync::Arc;

use super::{Error, knowledge};
use crate::check::check_for;
use crate::check::options::RunOptions;
use crate::checkpoint::journal::StateFolder;
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, Progress, ReadOptions};
use crate::report::model::CheckpointReport;
use crate::surgery::repair::tried;

/// Checks checkpoint directories with the rules of this crate.
#[derive(Debug, Clone, Default)]
pub struct Checker {
    versions: Vec<String>,
    deep: bool,
    stats: bool,
    hash: bool,
}

impl Checker {
    /// A checker that predicts the load for the version of transformers that wrote the checkpoint and the newest known
    /// one of each major version, and that reads no tensor data.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Predicts the load for this version of transformers instead, `4.57` for example. Several calls add several versions.
    ///
    /// The nearest version whose source was read stands for it; [`LoadReport::loader`](crate::LoadReport::loader) names it.
    ///
    /// # Errors
    /// [`Error::Version`] when the text is not a version number.
    pub fn loader(mut self, version: &str) -> Result<Self, Error> {
        self.versions.push(super::version(version)?);
        Ok(self)
    }

    /// Whether to read all tensor data as well: finds NaN, infinities and shards of zeros, and counts them in
    /// [`CheckpointReport::contents`].
    #[must_use]
    pub const fn deep(mut self, deep: bool) -> Self {
        self.deep = deep;
        self
    }

    /// Whether to add up the numbers of each tensor as well; implies [`Self::deep`].
    #[must_use]
    pub const fn stats(mut self, stats: bool) -> Self {
        self.stats = stats;
        self
    }

    /// Whether to hash the files of which the Hub cache, a download of huggingface_hub or git recorded the hash.
    #[must_use]
    pub const fn hash(mut self, hash: bool) -> Self {
        self.hash = hash;
        self
    }

    /// Checks the checkpoint in this directory. Settings files and baselines are not read.
    ///
    /// # Errors
    /// [`Error::Open`] when the directory cannot be read. Bad content is a finding of the report.
    pub fn check(&self, path: impl AsRef<Path>) -> Result<CheckpointReport, Error> {
        self.check_with(path, &|_| {})
    }

    /// As [`Self::check`]; `progress` is called while tensor data is read, and again while files are hashed, by several
    /// threads and after each read. It must be fast.
    ///
    /// # Errors
    /// As [`Self::check`].
    pub fn check_with(
        &self,
        path: impl AsRef<Path>,
        progress: &(dyn Fn(Progress<'_>) + Sync),
    ) -> Result<CheckpointReport, Error> {
        let path = path.as_ref();
        let knowledge = knowledge()?;
        let mut checkpoint = Checkpoint::open(path)?;
        checkpoint.recognise_journal(&StateFolder::of_user());
        if self.deep || self.stats {
            checkpoint.read_contents(ReadOptions { stats: self.stats, ..ReadOptions::default() }, progress);
        }
        if self.hash {
            checkpoint.check_hashes(progress);
        }
        let checkpoint = Arc::new(checkpoint);
        let options = RunOptions::for_versions(&self.versions);
        let check = |checkpoint: &Arc<Checkpoint>| check_for(checkpoint, knowledge, &options);
        let outcome = tried(&checkpoint, check(&checkpoint), &check);
        Ok(CheckpointReport::new(shown(path), None, &checkpoint, &outcome))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_version_is_a_number() {
        let checker = Checker::new().loader("4.57").and_then(|c| c.loader("5.0.0rc1")).expect("versions");
        assert_eq!(checker.versions, ["4.57", "5.0.0rc1"]);
        for text in ["", "main", "transformers==4.57"] {
            assert!(matches!(Checker::new().loader(text), Err(Error::Version(version)) if version == text));
        }
    }
}
