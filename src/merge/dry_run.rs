//! What a dry run says in addition: space, shards, the change of the config, and the plan itself.

use crate::checkpoint::files;
use std::path::Path;

use serde::Serialize;

use super::donor_tensor::DonorTensor;
use super::draft::MergeDraft;
use super::error::PipelineError;
use super::parts::Donor;
use crate::knowledge::recipe::Recipe;
use crate::report::model::{ConfigChange, DryRun, MergedFile, PlannedShardSize, ToolInfo};
use crate::surgery::expr::{TensorExpr, TensorTransform};
use crate::surgery::free_space;

/// A plan as JSON: every tensor of the result with its shard and its source.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct PlanDocument {
    /// Version of this contract: 2.
    pub schema: u32,
    /// The program that made the plan.
    pub tool: ToolInfo,
    /// Name of the recipe.
    pub recipe: String,
    /// Tensors in the order of the shards.
    pub tensors: Vec<TensorPlan>,
    /// Files other than shards and the merge's own, with their origin.
    pub files: Vec<PlannedFileOrigin>,
}

/// A planned tensor.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct TensorPlan {
    /// Name in the result.
    pub name: String,
    /// File name of its shard.
    pub shard: String,
    /// Element type, as safetensors spells it.
    pub dtype: String,
    /// Shape in the result.
    pub shape: Vec<u64>,
    /// How it is made, in one word.
    pub transform: TensorTransform,
    /// How it is made of tensors of donors.
    pub source: TensorExpr<DonorTensor>,
}

/// A planned file.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct PlannedFileOrigin {
    /// File name.
    pub name: String,
    /// Its origin.
    pub origin: String,
}

/// The facts of a dry run into `out`.
///
/// # Errors
/// When the file system of `out` cannot be queried.
pub(super) fn facts(
    draft: &MergeDraft,
    recipe: &Recipe,
    donors: &[Donor],
    out: &Path,
) -> Result<DryRun, PipelineError> {
    let shard = |shard: &crate::surgery::plan::PlannedShard| PlannedShardSize {
        name: shard.name.to_string(),
        tensors: shard.tensors.len(),
        bytes: shard.file_len(),
    };
    let free = free_space(out.parent().unwrap_or_else(|| Path::new("/")))?;
    Ok(DryRun {
        needed: draft.plan.len(),
        free,
        shards: draft.plan.shards.iter().map(shard).collect(),
        config: config_change(draft, recipe, donors),
    })
}

/// config.json of the result, and of the donor that the recipe takes it from.
fn config_change(draft: &MergeDraft, recipe: &Recipe, donors: &[Donor]) -> Option<ConfigChange> {
    let config = |name: &str| name == files::CONFIG;
    let role = recipe.documents.iter().find(|spec| config(&spec.name))?.from.as_ref()?;
    let host = donors.iter().find(|donor| donor.role == *role)?.checkpoint.document(files::CONFIG)?;
    let new = draft.documents.iter().find(|document| config(&document.name))?;
    Some(ConfigChange { donor: role.clone(), old: host.text.clone()?, new: new.text.clone()? })
}

/// The plan as JSON.
pub(super) fn document(draft: &MergeDraft, recipe: &Recipe) -> PlanDocument {
    let tensors = draft.plan.tensors().map(|(shard, t)| TensorPlan {
        name: t.name.clone(),
        shard: shard.name.to_string(),
        dtype: t.dtype.name().to_owned(),
        shape: t.shape.clone(),
        transform: t.transform(),
        source: t.source.map(&mut |from| DonorTensor::new(from, None)),
    });
    let file = |file: &MergedFile| PlannedFileOrigin { name: file.name.clone(), origin: file.origin.clone() };
    PlanDocument {
        schema: 2,
        tool: ToolInfo::this(),
        recipe: recipe.recipe.clone(),
        tensors: tensors.collect(),
        files: draft.files.iter().map(file).collect(),
    }
}
