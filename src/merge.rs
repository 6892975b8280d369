//! Merges: donors and a recipe become one checkpoint that was checked before and after it was written.
//!
//! check donors → recipe → plan → check the plan → write → open again and check. Each stage can be the last; before
//! the write nothing exists. This stage checks, plans, writes and reports; it is the only one above `report`.

mod context;
mod documents;
mod donors;
mod draft;
mod error;
mod files;
pub(crate) mod manifest;
mod options;
mod plan;
mod run;
mod tensors;

use std::path::Path;

pub use error::{MergeError, PipelineError};
pub use run::{CheckedCheckpoint, MergeRequest, MergeRun};

use context::{Donor, Options};
use draft::MergeDraft;
use run::count;

use crate::checkpoint::Checkpoint;
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::Recipe;
use crate::report::model::{MergeStage, MergedFile, Role};
use crate::report::{Format, Style, render};
use crate::surgery::plan::PlannedFile;
use crate::surgery::{apply, check_target};

/// File name of the report in the merged directory.
pub const REPORT: &str = "merge-report.md";

/// Runs a merge as far as it goes; `progress` gets the bytes written so far and their total.
///
/// A donor with errors, a seam that does not fit and a planned checkpoint with errors are not failures of the run:
/// [`MergeReport::stage`](crate::report::model::MergeReport::stage) tells where it stopped.
///
/// # Errors
/// A [`PipelineError`]. Nothing was written then, but for [`PipelineError::Reopen`].
pub fn run(
    request: &MergeRequest,
    knowledge: &Knowledge,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<MergeRun, PipelineError> {
    let mut run = MergeRun::new(request);
    let dirs: Vec<&Path> = request.donors.values().map(AsRef::as_ref).collect();
    let out = check_target(&request.out, &dirs)?;

    let (donors, at_rest) = donors::open(request, knowledge, &mut run)?;
    let recipe = match &request.recipe {
        Some(recipe) => recipe,
        None => donors::choose_recipe(&knowledge.recipes, &run)?,
    };
    run.record.recipe.clone_from(&recipe.recipe);
    donors::check_roles(recipe, request)?;
    let options = options::resolve(recipe, &request.options)?;
    run.record.options.clone_from(&options);
    if !donors::are_sound(recipe, &mut run) {
        return Ok(run.end(MergeStage::Donors));
    }
    run.note("recipe", &format!("{}: {}", recipe.recipe, recipe.summary));

    donors::check_architectures(recipe, &run)?;
    let mut draft = plan::plan(recipe, &donors, &options, knowledge)?;
    run.record_draft(&draft);
    if !draft.seams.is_empty() {
        run.note("plan", &count(draft.seams.len(), "seam does not fit", "seams do not fit"));
        return Ok(run.end(MergeStage::Seam));
    }
    let shards = count(draft.plan.shards.len(), "shard", "shards");
    let planned = format!("{} tensors, {} bytes in {shards}", run.record.tensors, run.record.bytes);
    run.note("plan", &planned);

    if !run.check(Role::Planned, &request.out, draft.preview(&out), knowledge) {
        return Ok(run.end(MergeStage::Planned));
    }
    if request.dry_run {
        run.note("write", "not asked for (--dry-run)");
        return Ok(run.end(MergeStage::DryRun));
    }

    add_manifest(&mut draft, &mut run, recipe, &options, &donors, request.hash)?;
    let total = draft.plan.len();
    let mut done = 0_u64;
    apply(&draft.plan, &at_rest, &out, &mut |bytes| {
        done = done.saturating_add(bytes);
        progress(done, total);
    })?;
    run.note("write", &format!("{total} bytes, published as one rename"));

    let reopen = |error| PipelineError::Reopen { out: request.out.clone(), error };
    let written = Checkpoint::open(&out).map_err(reopen)?;
    run.check(Role::Written, &request.out, written, knowledge);
    Ok(run.end(MergeStage::Written))
}

/// Adds the manifest and the report to the plan.
fn add_manifest(
    draft: &mut MergeDraft,
    run: &mut MergeRun,
    recipe: &Recipe,
    options: &Options,
    donors: &[Donor],
    hash_all: bool,
) -> Result<(), PipelineError> {
    let value = manifest::manifest(recipe, options, donors, draft, hash_all)?;
    let mut text = serde_json::to_string_pretty(&value).unwrap_or_default();
    text.push('\n');
    let origin = "made by the merge".to_owned();
    for name in [manifest::NAME, REPORT] {
        run.record.files.push(MergedFile { name: name.to_owned(), origin: origin.clone() });
    }
    let report = render(&run.portable_report(), Format::Markdown, Style { cap: 1000, ..Style::default() });
    for (name, text) in [(manifest::NAME, text), (REPORT, report)] {
        let file = PlannedFile { name: name.to_owned(), bytes: text.into_bytes().into(), origin: origin.clone() };
        draft.plan.files.insert(0, file);
    }
    Ok(())
}
