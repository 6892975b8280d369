//! `merge-manifest.json`: what went into a merged checkpoint, so that it can be made again and compared.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use sha2::{Digest as _, Sha256};

use super::CARD;
use super::donor_tensor::DonorTensor;
use super::hub::HubOrigin;
use super::named::Changeable;
use super::options::Options;
use super::parts::Donor;
use super::run::MergeRun;
use crate::checkpoint::tokenizer::VOCABULARY_FILES;
use crate::checkpoint::{Checkpoint, FileName, HashAlgorithm, hex, parallel};
use crate::knowledge::recipe::Recipe;
use crate::knowledge::source;
use crate::report::model::{ToolInfo, Training};
use crate::surgery::ApplyError;
use crate::surgery::donor::{digest_own, sha256};
use crate::surgery::expr::{TensorExpr, TensorTransform};
use crate::surgery::plan::{Plan, PlannedFile};
use crate::surgery::written::WrittenShard;

/// File name in the merged directory.
pub(super) const NAME: FileName = FileName::constant("merge-manifest.json");

/// What the model card, the report and the manifest describe, apart from the run.
pub(super) struct Recorded<'m> {
    pub(super) recipe: &'m Recipe,
    pub(super) donors: &'m [Donor],
    pub(super) digests: &'m BTreeMap<String, DonorDigests>,
    pub(super) plan: &'m Plan,
    /// What the entries of the recipe may change.
    pub(super) changeable: &'m Changeable,
    /// Algorithm of the digests of the tensors.
    pub(super) hash: HashAlgorithm,
}

/// `merge-manifest.json`: how a merged checkpoint was made.
///
/// Donors are named by their role, their origin on the Hub and the digests of their files, never by a path, so that the
/// same merge made elsewhere has the same manifest.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct Manifest {
    /// Version of this contract: 5.
    pub schema: u32,
    /// The program that made the merge.
    pub tool: ToolInfo,
    /// The recipe.
    pub recipe: RecipeDigest,
    /// Options in effect, defaults included.
    pub options: Options,
    /// The donors, by role.
    pub donors: BTreeMap<String, DonorDigests>,
    /// What the entries of the recipe name, and may change: every other tensor has its donor's bytes, or is cast.
    pub changes: Changeable,
    /// Tensors to train, and to freeze meanwhile.
    pub training: Training,
    /// Every file of the result except the shards and this one, by file name.
    pub files: BTreeMap<String, FileDigest>,
    /// The shards of the result, by file name.
    pub shards: BTreeMap<String, ShardDigest>,
    /// Algorithm of the digests of tensors, here and in their sources.
    pub hash: HashAlgorithm,
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

/// The recipe of a merge.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct RecipeDigest {
    /// Its name.
    pub name: String,
    /// SHA-256 of its file.
    pub sha256: String,
    /// Text of its file; missing for a recipe of the program.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
}

/// A donor, identified by the content of the files that were read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct DonorDigests {
    /// Its origin on the Hugging Face Hub, where the files or the folder tell.
    #[serde(skip_serializing_if = "HubOrigin::is_unknown")]
    pub hub: HubOrigin,
    /// Its documents, modules and tokenizer files, and its model card, by file name.
    pub files: BTreeMap<String, FileDigest>,
    /// The shards, by file name.
    pub shards: BTreeMap<String, DonorShard>,
}

/// A shard of the result. Its header and its tensors are all of its bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct ShardDigest {
    /// Its size.
    pub bytes: u64,
    /// SHA-256 of its header, including the length before it and the spaces after it.
    pub header_sha256: String,
}

/// A shard of a donor.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct DonorShard {
    /// Its size.
    pub bytes: u64,
    /// SHA-256 of its header.
    pub header_sha256: String,
    /// SHA-256 of the whole file; only with `--hash-donors`.
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
    /// Digest of its bytes; missing with the algorithm `none`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub digest: Option<String>,
    /// How it was made, in one word.
    pub transform: TensorTransform,
    /// How it was made of tensors of donors.
    pub source: TensorExpr<DonorTensor>,
}

/// The donors by content. With `all_bytes`, whole shards are hashed, several at a time, otherwise only their headers.
///
/// # Errors
/// When a donor's file cannot be read, or a signal arrived.
pub(super) fn donor_digests(
    donors: &[Donor],
    plan: &Plan,
    all_bytes: bool,
) -> Result<BTreeMap<String, DonorDigests>, ApplyError> {
    let digests = |donor: &Donor| {
        let hub = HubOrigin::find(&donor.checkpoint);
        let shards = donor.checkpoint.shards.iter().map(|(name, shard)| {
            let digest =
                DonorShard { bytes: shard.file_len, header_sha256: shard.header_sha256().to_owned(), sha256: None };
            (name.clone(), digest)
        });
        let files = small_files(&donor.checkpoint, plan)?;
        Ok((donor.role.clone(), DonorDigests { hub, files, shards: shards.collect() }))
    };
    let mut digests: BTreeMap<String, DonorDigests> = donors.iter().map(digests).collect::<Result<_, _>>()?;
    if all_bytes {
        let shards = |donor: &Donor| {
            let names = donor.checkpoint.shards.keys().cloned();
            names.map(|name| (donor.role.clone(), donor.checkpoint.source.path().join(&name), name)).collect::<Vec<_>>()
        };
        let shards: Vec<_> = donors.iter().flat_map(shards).collect();
        let hashes = parallel::map(parallel::threads(), &shards, || (), |(), (_, path, _)| sha256(path));
        for ((role, _, name), hash) in shards.iter().zip(hashes) {
            if let Some(shard) = digests.get_mut(role).and_then(|donor| donor.shards.get_mut(name)) {
                shard.sha256 = Some(hash?);
            }
        }
    }
    Ok(digests)
}

/// The manifest of a merge whose shards are written; `described` are the other files of its record.
pub(super) fn manifest(
    merge: &Recorded<'_>,
    run: &MergeRun,
    written: &[WrittenShard],
    described: &[&PlannedFile],
) -> Manifest {
    let others = merge.plan.files.iter().chain(described.iter().copied());
    let shards = written
        .iter()
        .map(|s| (s.name.to_string(), ShardDigest { bytes: s.bytes, header_sha256: s.header_sha256.clone() }));
    let others = others.map(|f| (f.name.to_string(), FileDigest { bytes: f.bytes.len() as u64, sha256: f.sha256() }));
    let digests = written.iter().flat_map(|shard| &shard.tensors);
    let tensors = merge.plan.tensors().zip(digests).map(|((shard, t), written)| {
        let mut digests = written.source_digests.iter().cloned();
        let source = t.source.map(&mut |from| DonorTensor::new(from, digests.next().flatten()));
        TensorOrigin {
            name: t.name.clone(),
            shard: shard.name.to_string(),
            dtype: t.dtype.name().to_owned(),
            shape: t.shape.clone(),
            digest: written.digest.clone(),
            transform: t.transform(),
            source,
        }
    });
    Manifest {
        schema: 5,
        tool: ToolInfo::this(),
        recipe: recipe_digest(merge.recipe),
        options: run.record.options.clone(),
        donors: merge.digests.clone(),
        changes: merge.changeable.clone(),
        training: run.record.training.clone().unwrap_or_default(),
        files: others.collect(),
        shards: shards.collect(),
        hash: merge.hash,
        tensors: tensors.collect(),
    }
}

fn recipe_digest(recipe: &Recipe) -> RecipeDigest {
    let text = &*recipe.origin.text;
    let is_built_in = source::text(&format!("recipes/{}.json5", recipe.recipe)) == Some(text);
    RecipeDigest {
        name: recipe.recipe.clone(),
        sha256: hex(&Sha256::digest(text)),
        text: (!is_built_in).then(|| text.to_owned()),
    }
}

/// The documents, modules and vocabularies of a donor, its model card, and files with the name of a file of the result.
fn small_files(checkpoint: &Checkpoint, plan: &Plan) -> Result<BTreeMap<String, FileDigest>, ApplyError> {
    let documents = checkpoint.documents.iter().filter(|(_, d)| d.value.is_some()).map(|(name, _)| name.as_str());
    let modules = checkpoint.modules.keys().map(String::as_str);
    let card = CARD;
    let others = VOCABULARY_FILES.into_iter().chain([&*card]).chain(plan.files.iter().map(|file| &*file.name));
    let names: BTreeSet<&str> = documents.chain(modules).chain(others).collect();
    let mut files = BTreeMap::new();
    for name in names.into_iter().filter(|name| checkpoint.has_file(name)) {
        if let Some((bytes, sha256)) = digest_own(&checkpoint.source, name)? {
            files.insert(name.to_owned(), FileDigest { bytes, sha256 });
        }
    }
    Ok(files)
}
