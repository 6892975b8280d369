//! Reads `merge-manifest.json` of versions 1 to 5. It is untrusted, like every file of a checkpoint.

mod former;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::VerifyError;
use crate::checkpoint::open::{JSON_CAP, read_own};
use crate::checkpoint::{HashAlgorithm, is_plain_file_name};
use crate::merge::donor_tensor::DonorTensor;
use crate::merge::manifest;
use crate::merge::named::{Bounds, Changeable, Stray, is_changed};
use crate::surgery::expr::{TensorExpr, TensorTransform};

/// A recorded merge. Keys that not all versions have are optional.
#[derive(Debug, Deserialize)]
pub(super) struct Recorded {
    pub(super) schema: u32,
    /// An object since version 2, a name in version 1.
    recipe: Value,
    #[serde(default)]
    pub(super) donors: BTreeMap<String, RecordedDonor>,
    /// Since version 2: the files of the result. Version 2 has the shards here too.
    #[serde(default)]
    pub(super) files: BTreeMap<String, RecordedFile>,
    /// Since version 3: the shards of the result.
    #[serde(default)]
    pub(super) shards: BTreeMap<String, RecordedShard>,
    /// Since version 4: what the entries of the recipe may change.
    changes: Option<Changeable>,
    /// Since version 3: the algorithm of the digests of tensors. It was SHA-256 before.
    hash: Option<HashAlgorithm>,
    pub(super) tensors: Vec<RecordedTensor>,
}

/// A recorded donor.
#[derive(Debug, Deserialize)]
pub(super) struct RecordedDonor {
    #[serde(default)]
    pub(super) files: BTreeMap<String, RecordedFile>,
    /// Version 1: SHA-256 of documents.
    #[serde(default)]
    documents: BTreeMap<String, String>,
    #[serde(default)]
    pub(super) shards: BTreeMap<String, RecordedShard>,
}

/// A recorded file.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct RecordedFile {
    pub(super) bytes: Option<u64>,
    pub(super) sha256: String,
}

/// A recorded shard of a donor, or of the result.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct RecordedShard {
    pub(super) bytes: u64,
    pub(super) header_sha256: String,
    /// Of donors only, with `--hash-donors`.
    pub(super) sha256: Option<String>,
}

/// A recorded tensor of the result.
#[derive(Debug, Deserialize)]
#[serde(try_from = "former::TensorEntry")]
pub(super) struct RecordedTensor {
    pub(super) name: String,
    pub(super) shard: String,
    pub(super) dtype: String,
    pub(super) shape: Vec<u64>,
    /// Version 1 has none.
    pub(super) digest: Option<String>,
    /// How it was made.
    pub(super) source: TensorExpr<DonorTensor>,
}

impl RecordedTensor {
    /// The donor's tensor that it stands for.
    pub(super) fn main(&self) -> &DonorTensor {
        self.source.main()
    }

    /// Whether it is more than the donor's whole tensor, cast or not.
    pub(super) fn is_changed(&self) -> bool {
        is_changed(&self.source)
    }

    /// Why the merge cannot have been allowed to make it; `None` when it was.
    pub(super) fn stray(&self, bounds: &Bounds<'_>) -> Option<String> {
        let DonorTensor { donor, name, .. } = self.main();
        Some(match bounds.stray(&self.source, &self.dtype)? {
            Stray::Changed => {
                let transform = self.source.transform();
                let is_scaled = self.source.scale().is_some() && transform != TensorTransform::AddProduct;
                let how = if is_scaled { "scaled" } else { transform.name() };
                format!("is recorded as {how}, and nothing that the recipe names has {name} of the {donor} donor")
            }
            Stray::Cast => format!(
                "is recorded as cast to {}, and the recipe announces no such cast of the {donor} donor",
                self.dtype
            ),
        })
    }
}

impl Recorded {
    /// Reads the manifest of the result in `root`.
    ///
    /// # Errors
    /// [`VerifyError::Manifest`] when it is missing, not JSON of a known version, or names something that no merge writes.
    pub(super) fn read(root: &Path) -> Result<Self, VerifyError> {
        let wrong = |reason: String| VerifyError::Manifest { path: root.join(&*manifest::NAME), reason };
        if !root.join(&*manifest::NAME).exists() {
            return Err(wrong(
                "does not exist; `verify` compares a result of build-merged with its manifest".to_owned(),
            ));
        }
        let bytes = read_own(root, &[], &manifest::NAME, JSON_CAP).map_err(|error| wrong(error.to_string()))?;
        let damaged = |reason: String| wrong(format!("{reason}; the manifest is damaged"));
        let value: Value = serde_json::from_slice(&bytes).map_err(|error| damaged(error.to_string()))?;
        let schema = value.get("schema").and_then(Value::as_u64);
        if !matches!(schema, Some(1..=5)) {
            let schema = value.get("schema").map_or_else(|| "missing".to_owned(), Value::to_string);
            return Err(wrong(format!(
                "its schema is {schema}, and this version of ckpt-doctor reads 1 to 5; use a newer version"
            )));
        }
        let mut recorded: Self = serde_json::from_slice(&bytes).map_err(|error| damaged(error.to_string()))?;
        for donor in recorded.donors.values_mut() {
            let documents = std::mem::take(&mut donor.documents).into_iter();
            donor.files.extend(documents.map(|(name, sha256)| (name, RecordedFile { bytes: None, sha256 })));
        }
        if recorded.schema >= 3 && recorded.hash.is_none() {
            return Err(damaged("it has no \"hash\"".to_owned()));
        }
        if recorded.schema >= 4 && recorded.changes.is_none() {
            return Err(damaged("it has no \"changes\"".to_owned()));
        }
        recorded.check().map_err(damaged)?;
        Ok(recorded)
    }

    /// Fails for names that are no file names, and for tensors that are recorded twice.
    fn check(&self) -> Result<(), String> {
        let of_donors = self.donors.values().flat_map(|donor| donor.files.keys().chain(donor.shards.keys()));
        let of_tensors = self.tensors.iter().map(|tensor| &tensor.shard);
        let mut names = self.files.keys().chain(self.shards.keys()).chain(of_donors).chain(of_tensors);
        if let Some(name) = names.find(|name| !is_plain_file_name(name)) {
            return Err(format!("{name:?} is not the name of a file"));
        }
        let mut seen = BTreeSet::new();
        match self.tensors.iter().find(|tensor| !seen.insert(&tensor.name)) {
            Some(tensor) => Err(format!("{:?} is recorded twice", tensor.name)),
            None => Ok(()),
        }
    }

    /// What the merge was allowed to change; `None` before version 4.
    pub(super) fn bounds(&self) -> Option<Result<Bounds<'_>, String>> {
        self.changes.as_ref().map(Bounds::new)
    }

    /// Bytes of the names of tensors in the donors, with some for each tensor: what its bounds are compared with.
    pub(super) fn bytes_of_names(&self) -> u64 {
        let bytes = self
            .tensors
            .iter()
            .fold(0_usize, |sum, t| sum.saturating_add(t.source.main().name.len()).saturating_add(64));
        u64::try_from(bytes).unwrap_or(u64::MAX)
    }

    /// Algorithm of the digests of tensors.
    pub(super) fn hash(&self) -> HashAlgorithm {
        self.hash.unwrap_or(HashAlgorithm::Sha256)
    }

    /// Name of the recipe.
    pub(super) fn recipe(&self) -> &str {
        self.recipe.as_str().or_else(|| self.recipe.get("name")?.as_str()).unwrap_or_default()
    }
}
