//! `merge-manifest.json`: what went into a merged checkpoint, so that it can be made again and compared.

use std::collections::BTreeMap;

use serde::Serialize;

use super::context::{Donor, Options};
use super::draft::MergeDraft;
use crate::checkpoint::{Checkpoint, FileName};
use crate::knowledge::recipe::Recipe;
use crate::report::model::ToolInfo;
use crate::surgery::ApplyError;
use crate::surgery::donor::sha256;
use crate::surgery::plan::TensorTransform;

/// File name in the merged directory.
pub(super) const NAME: FileName = FileName::constant("merge-manifest.json");

/// `merge-manifest.json`: how a merged checkpoint was made.
///
/// Donors are named by their role and hashes, never by a path, so that the same merge made elsewhere has the same
/// manifest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct Manifest {
    /// Version of this contract: 1.
    pub schema: u32,
    /// The program that made the merge.
    pub tool: ToolInfo,
    /// Name of the recipe.
    pub recipe: String,
    /// Options in effect, defaults included.
    pub options: Options,
    /// The files of each donor, by role.
    pub donors: BTreeMap<String, DonorFiles>,
    /// Every tensor of the result, in the order of the shards.
    pub tensors: Vec<TensorOrigin>,
}

/// The files of a donor that were read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct DonorFiles {
    /// SHA-256 of each document, by file name.
    pub documents: BTreeMap<String, String>,
    /// The shards, by file name.
    pub shards: BTreeMap<String, DonorShard>,
}

/// A shard of a donor.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct DonorShard {
    /// Its size.
    pub bytes: u64,
    /// SHA-256 of its header.
    pub header_sha256: String,
    /// SHA-256 of the whole file; only with `--hash`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
}

/// A tensor of the result and its source.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct TensorOrigin {
    /// Name in the result.
    pub name: String,
    /// File name of its shard in the result.
    pub shard: String,
    /// Element type, as safetensors spells it.
    pub dtype: String,
    /// Shape in the result.
    pub shape: Vec<u64>,
    /// How it was made.
    pub transform: TensorTransform,
    /// The donor tensor that it was made from, or that it replaces.
    pub source: DonorTensor,
}

/// A tensor of a donor.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct DonorTensor {
    /// Role of the donor.
    pub donor: String,
    /// Name in the donor.
    pub name: String,
    /// Shape in the donor.
    pub shape: Vec<u64>,
}

/// The manifest of a planned merge. With `all_bytes`, whole shards are hashed, otherwise only their headers.
///
/// # Errors
/// When a donor's file cannot be read, or a signal arrived.
pub(super) fn manifest(
    recipe: &Recipe,
    options: &Options,
    donors: &[Donor],
    draft: &MergeDraft,
    all_bytes: bool,
) -> Result<Manifest, ApplyError> {
    let files = |donor: &Donor| Ok((donor.role.clone(), donor_files(&donor.checkpoint, all_bytes)?));
    let tensors = draft.plan.tensors().map(|(shard, t)| {
        let from = t.source.donor();
        TensorOrigin {
            name: t.name.clone(),
            shard: shard.name.to_string(),
            dtype: t.dtype.name().to_owned(),
            shape: t.shape.clone(),
            transform: t.source.transform(),
            source: DonorTensor { donor: from.donor.clone(), name: from.name.clone(), shape: from.shape.clone() },
        }
    });
    Ok(Manifest {
        schema: 1,
        tool: ToolInfo::this(),
        recipe: recipe.recipe.clone(),
        options: options.clone(),
        donors: donors.iter().map(files).collect::<Result<_, ApplyError>>()?,
        tensors: tensors.collect(),
    })
}

fn donor_files(checkpoint: &Checkpoint, all_bytes: bool) -> Result<DonorFiles, ApplyError> {
    let mut files = DonorFiles { documents: BTreeMap::new(), shards: BTreeMap::new() };
    for (name, document) in &checkpoint.documents {
        if document.value.is_some() {
            files.documents.insert(name.clone(), sha256(&checkpoint.root.join(name))?);
        }
    }
    for (name, shard) in &checkpoint.shards {
        let sha256 = all_bytes.then(|| sha256(&checkpoint.root.join(name))).transpose()?;
        let entry = DonorShard { bytes: shard.file_len, header_sha256: shard.header_sha256.clone(), sha256 };
        files.shards.insert(name.clone(), entry);
    }
    Ok(files)
}
