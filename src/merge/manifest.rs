//! `merge-manifest.json`: what went into a merged checkpoint, so that it can be made again and compared.

use std::collections::BTreeMap;

use serde::Serialize;

use super::context::{Donor, Options};
use crate::checkpoint::{Checkpoint, FileName};
use crate::knowledge::recipe::Recipe;
use crate::report::model::ToolInfo;
use crate::surgery::ApplyError;
use crate::surgery::donor::sha256;
use crate::surgery::plan::{Plan, PlannedFile, RowSlice, TensorTransform};
use crate::surgery::written::WrittenShard;

/// File name in the merged directory.
pub(super) const NAME: FileName = FileName::constant("merge-manifest.json");

/// `merge-manifest.json`: how a merged checkpoint was made.
///
/// Donors are named by their role and hashes, never by a path, so that the same merge made elsewhere has the same
/// manifest.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct Manifest {
    /// Version of this contract: 2.
    pub schema: u32,
    /// The program that made the merge.
    pub tool: ToolInfo,
    /// Name of the recipe.
    pub recipe: String,
    /// Options in effect, defaults included.
    pub options: Options,
    /// The files of each donor, by role.
    pub donors: BTreeMap<String, DonorFiles>,
    /// Every file of the result except this one, by file name.
    pub files: BTreeMap<String, FileDigest>,
    /// Every tensor of the result, in the order of the shards.
    pub tensors: Vec<TensorOrigin>,
}

/// A file of the result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct FileDigest {
    /// Its size.
    pub bytes: u64,
    /// SHA-256 of the file.
    pub sha256: String,
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
#[derive(Debug, Clone, PartialEq, Serialize)]
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
    /// SHA-256 of its bytes.
    pub sha256: String,
    /// How it was made.
    pub transform: TensorTransform,
    /// Factor on all values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
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
    /// Element type in the donor; the values were cast if it differs from that of the result.
    pub dtype: String,
    /// Shape of the part that was used.
    pub shape: Vec<u64>,
    /// The rows that were used, if not all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub slice: Option<RowSlice>,
}

/// The files of each donor, by role. With `all_bytes`, whole shards are hashed, otherwise only their headers.
///
/// # Errors
/// When a donor's file cannot be read, or a signal arrived.
pub(super) fn donor_digests(donors: &[Donor], all_bytes: bool) -> Result<BTreeMap<String, DonorFiles>, ApplyError> {
    donors.iter().map(|donor| Ok((donor.role.clone(), donor_files(&donor.checkpoint, all_bytes)?))).collect()
}

/// The manifest of a merge whose shards are written; `others` are its other files.
pub(super) fn manifest<'f>(
    recipe: &Recipe,
    options: &Options,
    donors: &BTreeMap<String, DonorFiles>,
    plan: &Plan,
    written: &[WrittenShard],
    others: impl Iterator<Item = &'f PlannedFile>,
) -> Manifest {
    let shards = written.iter().map(|s| (s.name.to_string(), FileDigest { bytes: s.bytes, sha256: s.sha256.clone() }));
    let others = others.map(|f| (f.name.to_string(), FileDigest { bytes: f.bytes.len() as u64, sha256: f.sha256() }));
    let digests = written.iter().flat_map(|shard| &shard.tensors);
    let tensors = plan.tensors().zip(digests).map(|((shard, t), written)| {
        let from = &t.source.from;
        TensorOrigin {
            name: t.name.clone(),
            shard: shard.name.to_string(),
            dtype: t.dtype.name().to_owned(),
            shape: t.shape.clone(),
            sha256: written.sha256.clone(),
            transform: t.transform(),
            scale: t.source.scale,
            source: DonorTensor {
                donor: from.donor.clone(),
                name: from.name.clone(),
                dtype: from.dtype.name().to_owned(),
                shape: from.shape.clone(),
                slice: from.slice,
            },
        }
    });
    Manifest {
        schema: 2,
        tool: ToolInfo::this(),
        recipe: recipe.recipe.clone(),
        options: options.clone(),
        donors: donors.clone(),
        files: shards.chain(others).collect(),
        tensors: tensors.collect(),
    }
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
