//! Merges checkpoints: donors and a recipe become one checkpoint, which is checked before and after it is written.
//!
//! check donors → recipe → plan → check the plan → write → open again and check. A run can stop after each stage;
//! nothing is written before the stage `write`. This stage combines checks, plans, writes and reports; it is the only
//! one above `report`.

mod choice;
mod context;
mod documents;
mod donors;
mod draft;
mod dtypes;
mod error;
mod explain;
mod file;
mod files;
pub(crate) mod manifest;
mod options;
mod plan;
mod publish;
mod recipe_file;
mod run;
mod switches;
mod tensors;
mod validate;

use std::collections::BTreeMap;
use std::path::Path;

pub use error::PipelineError;
pub use file::ResolvedMergeFile;
#[cfg(feature = "cli")]
pub(crate) use recipe_file::read as read_recipe;
pub use run::{MergeRequest, MergeRun};
#[cfg(feature = "internals")]
pub use validate::validate;

use manifest::DonorFiles;
use run::count;

use crate::checkpoint::{Checkpoint, FileName};
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::Recipe;
use crate::report::markdown;
use crate::report::model::{MergeStage, MergedFile, Role};
use crate::surgery::plan::{Plan, PlannedFile};
use crate::surgery::written::WrittenShard;
use crate::surgery::{Target, apply, check_target, claim_target};

/// File name of the report in the merged directory.
pub(crate) const REPORT: FileName = FileName::constant("merge-report.md");

/// Runs a merge; `progress` receives the bytes written so far and their total.
///
/// A donor with errors, a seam mismatch and a planned checkpoint with errors are not failures of the run:
/// [`MergeReport::stage`](crate::report::model::MergeReport::stage) names the stage at which it stopped.
///
/// # Errors
/// A [`PipelineError`]. Nothing was written then, except with [`PipelineError::Reopen`].
pub fn run(
    request: &MergeRequest,
    knowledge: &Knowledge,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<MergeRun, PipelineError> {
    let mut run = MergeRun::new(request);
    let dirs: Vec<&Path> = request.donors.values().map(AsRef::as_ref).collect();
    let target = if request.dry_run { check_target } else { claim_target };
    let Target { path: out, cleared } = target(&request.out, &dirs)?;
    if let Some(recipe) = &request.recipe {
        // A request that does not fit is refused before a donor is read.
        choice::check_roles(recipe, request)?;
        options::resolve(recipe, &request.options)?;
    }

    let (donors, snapshots) = donors::open(request, knowledge, &mut run)?;
    let recipe = match &request.recipe {
        Some(recipe) => recipe,
        None => choice::choose_recipe(&knowledge.recipes, &run)?,
    };
    run.record.recipe.clone_from(&recipe.recipe);
    choice::check_roles(recipe, request)?;
    let options = options::resolve(recipe, &request.options)?;
    run.record.options.clone_from(&options);
    if !donors::are_sound(recipe, &mut run) {
        return Ok(run.end(MergeStage::Donors));
    }
    run.note("recipe", &format!("{}: {}", recipe.recipe, recipe.summary));

    choice::check_architectures(recipe, &run)?;
    let draft = plan::plan(recipe, &donors, &options, knowledge)?;
    run.record_draft(&draft);
    if !draft.seams.is_empty() {
        run.note("plan", &count(draft.seams.len(), "seam does not fit", "seams do not fit"));
        return Ok(run.end(MergeStage::Seam));
    }
    let shards = count(draft.plan.shards.len(), "shard", "shards");
    let planned = format!("{} tensors, {} bytes in {shards}", run.record.tensors, run.record.bytes);
    run.note("plan", &planned);

    if !run.check(Role::Planned, &request.out, draft.preview(&out), knowledge, &recipe.tolerates) {
        return Ok(run.end(MergeStage::Planned));
    }
    publish::check(recipe, &draft)?;
    if request.dry_run {
        run.note("write", "skipped (--dry-run)");
        return Ok(run.end(MergeStage::DryRun));
    }

    let digests = manifest::donor_digests(&donors, request.hash)?;
    let total = draft.plan.len();
    let mut done = 0_u64;
    let mut record = |written: &[WrittenShard]| record(&draft.plan, &mut run, recipe, &digests, written);
    let leftover = apply(&draft.plan, &snapshots, &out, &mut record, &mut |bytes| {
        done = done.saturating_add(bytes);
        progress(done, total);
    })?;
    run.note_files(cleared.as_deref(), leftover.as_ref());

    let reopen = |error| PipelineError::Reopen { out: request.out.clone(), error };
    let written = Checkpoint::open(&out).map_err(reopen)?;
    run.check(Role::Written, &request.out, written, knowledge, &recipe.tolerates);
    Ok(run.end(MergeStage::Written))
}

/// The files that describe the result: its report, and the manifest with the digests of all others.
///
/// [`apply`] calls it when the shards are written.
fn record(
    plan: &Plan,
    run: &mut MergeRun,
    recipe: &Recipe,
    donors: &BTreeMap<String, DonorFiles>,
    written: &[WrittenShard],
) -> Vec<PlannedFile> {
    run.record_losses(plan, written);
    let origin = "generated by the merge".to_owned();
    for name in [manifest::NAME, REPORT] {
        run.record.files.push(MergedFile { name: name.to_string(), origin: origin.clone() });
    }
    let shards = count(written.len(), "shard", "shards");
    let files = count(run.record.files.len(), "other file", "other files");
    run.note("write", &format!("{shards} and {files}, published by one rename"));
    let file = |name, text: String| PlannedFile { name, bytes: text.into_bytes().into(), origin: origin.clone() };
    let report = file(REPORT, markdown::render(&run.portable_report(), 1000));
    let others = plan.files.iter().chain([&report]);
    let value = manifest::manifest(recipe, &run.record.options, donors, plan, written, others);
    let text = serde_json::to_string_pretty(&value).unwrap_or_default();
    vec![report, file(manifest::NAME, format!("{text}\n"))]
}
