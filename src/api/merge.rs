//! Merges of checkpoints.

use std::path::{Path, PathBuf};

use super::{Error, knowledge};
use crate::checkpoint::HashAlgorithm;
use crate::merge::{MergeRequest, ResolvedMergeFile, run};
use crate::report::Report;

/// A merge of several checkpoints, the donors, into a new one.
///
/// ```
/// # fn main() -> Result<(), ckpt_doctor::Error> {
/// let merge = ckpt_doctor::Merge::new("merged")
///     .donor("vision", "fixtures/donors/spatialvla-tiny")
///     .donor("language", "fixtures/donors/llava3d-tiny");
/// let report = merge.plan()?;
/// assert_eq!(report.merge.map(|merge| merge.recipe).as_deref(), Some("spatialvla-llava3d"));
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone, Default)]
pub struct Merge {
    parts: ResolvedMergeFile,
    versions: Vec<String>,
    tolerate: Vec<String>,
    hash: HashAlgorithm,
    hash_donors: bool,
}

impl Merge {
    /// A merge into this directory, which must not exist yet or be empty.
    #[must_use]
    pub fn new(out: impl Into<PathBuf>) -> Self {
        Self { parts: ResolvedMergeFile::new(out.into()), ..Self::default() }
    }

    /// The merge that a merge file describes; paths in it are relative to its folder.
    ///
    /// # Errors
    /// [`Error::Data`] when the file cannot be read or is not a merge file.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self, Error> {
        Ok(Self { parts: ResolvedMergeFile::read(path.as_ref())?, ..Self::default() })
    }

    /// Uses the recipe of this name, or the one in this `.json5` file. Without a recipe, the architectures of the donors
    /// choose one.
    #[must_use]
    pub fn recipe(mut self, name: impl Into<String>) -> Self {
        self.parts.recipe = Some(name.into());
        self.parts.base = PathBuf::new();
        self
    }

    /// Uses this directory as the donor for a role of the recipe.
    #[must_use]
    pub fn donor(mut self, role: impl Into<String>, dir: impl Into<PathBuf>) -> Self {
        self.parts.donors.insert(role.into(), dir.into());
        self
    }

    /// Sets an option of the recipe.
    #[must_use]
    pub fn option(mut self, name: impl Into<String>, value: impl Into<String>) -> Self {
        self.parts.options.insert(name.into(), value.into());
        self
    }

    /// Merges into this directory, which must not exist yet or be empty.
    #[must_use]
    pub fn output(mut self, out: impl Into<PathBuf>) -> Self {
        self.parts.out = out.into();
        self
    }

    /// Makes the result for this version of transformers, `4.57` for example. Several calls add several versions.
    ///
    /// The result is checked for it, and options whose default depends on the version follow it.
    ///
    /// # Errors
    /// [`Error::Version`] when the text is not a version number.
    pub fn loader(mut self, version: &str) -> Result<Self, Error> {
        self.versions.push(super::version(version)?);
        Ok(self)
    }

    /// Lets errors of this rule, by its code or name, not stop the merge, in a donor or the result. Several calls add several
    /// rules; an unknown one is an error of [`Self::plan`] and [`Self::run`].
    #[must_use]
    pub fn tolerate(mut self, rule: impl Into<String>) -> Self {
        self.tolerate.push(rule.into());
        self
    }

    /// Sets the algorithm of the digests of tensors in the manifest of the result; BLAKE3 by default.
    #[must_use]
    pub const fn hash(mut self, algorithm: HashAlgorithm) -> Self {
        self.hash = algorithm;
        self
    }

    /// Whether the manifest of the result has a hash of every byte of the donors, not only of documents and headers.
    #[must_use]
    pub const fn hash_donors(mut self, hash: bool) -> Self {
        self.hash_donors = hash;
        self
    }

    /// Checks the donors, plans the merge and checks the planned checkpoint. Writes nothing.
    ///
    /// [`MergeReport::stage`](crate::MergeReport::stage) of the report tells whether [`Self::run`] would write the result:
    /// it is [`MergeStage::DryRun`](crate::MergeStage::DryRun) then.
    ///
    /// # Errors
    /// Any [`Error`] but [`Error::Version`] and [`Error::Reopen`].
    pub fn plan(&self) -> Result<Report, Error> {
        self.start(true)
    }

    /// Runs the merge: the result is written under a temporary name, renamed when it is complete, and checked again.
    ///
    /// Nothing is written if a donor or the planned checkpoint has errors, or if the donors do not fit together;
    /// [`MergeReport::stage`](crate::MergeReport::stage) of the report is
    /// [`MergeStage::Written`](crate::MergeStage::Written) otherwise.
    ///
    /// # Errors
    /// Any [`Error`] but [`Error::Version`].
    pub fn run(&self) -> Result<Report, Error> {
        self.start(false)
    }

    fn start(&self, dry_run: bool) -> Result<Report, Error> {
        let knowledge = knowledge()?;
        let recipe = self.parts.find_recipe(knowledge)?;
        let ResolvedMergeFile { donors, options, out, .. } = self.parts.clone();
        let (versions, hash, hash_donors) = (self.versions.clone(), self.hash, self.hash_donors);
        let tolerate = self.tolerate.clone();
        let request = MergeRequest { recipe, donors, options, versions, tolerate, out, dry_run, hash, hash_donors };
        Ok(run(&request, knowledge, &|_, _| {})?.report())
    }
}
