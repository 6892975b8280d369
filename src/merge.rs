//! Merges checkpoints: donors and a recipe become one checkpoint, which is checked before and after it is written.
//!
//! check donors → recipe → plan → check the plan → write → open again and check. A run can stop after each stage;
//! nothing is written before the stage `write`. This stage combines checks, plans, writes and reports; it is the only
//! one above `report`.

mod adapter;
mod alike;
mod card;
mod choice;
mod context;
mod documents;
mod donor_tensor;
mod donors;
mod draft;
pub(crate) mod dry_run;
mod dtypes;
mod error;
mod explain;
mod file;
mod files;
mod fit;
mod functions;
mod hub;
pub(crate) mod manifest;
mod named;
mod options;
mod parts;
mod plan;
mod publish;
mod quantised;
mod recipe_file;
mod record;
mod run;
mod seams;
mod switches;
mod taken;
mod tensors;
mod tokenizer;
mod training;
mod usage;
mod validate;
#[cfg(feature = "cli")]
mod verify;
mod word_fit;

use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

pub use error::PipelineError;
pub use file::ResolvedMergeFile;
#[cfg(feature = "cli")]
pub(crate) use recipe_file::{processor_of, read as read_recipe};
pub use run::{MergeRequest, MergeRun};
#[cfg(feature = "internals")]
pub use validate::validate;
#[cfg(feature = "cli")]
pub use verify::verify;

use draft::MergeDraft;
use manifest::Recorded;
use parts::Donor;
use run::count;

use crate::checkpoint::{Checkpoint, FileName};
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::Recipe;
use crate::report::model::{MergeStage, Role};
use crate::surgery::donor::DonorSnapshot;
use crate::surgery::written::{Writing, WrittenShard};
use crate::surgery::{Target, apply, check_target, claim_target};

/// File name of the report in the merged directory.
pub(crate) const REPORT: FileName = FileName::constant("merge-report.md");

/// File name of the model card in the merged directory.
pub(crate) const CARD: FileName = FileName::constant(crate::checkpoint::files::CARD);

/// Runs a merge; `progress` receives the bytes written so far and their total, from several threads.
///
/// A donor with errors, a seam mismatch and a planned checkpoint with errors are not failures of the run:
/// [`MergeReport::stage`](crate::report::model::MergeReport::stage) names the stage at which it stopped.
///
/// # Errors
/// A [`PipelineError`]. Nothing was written then, except with [`PipelineError::Reopen`].
pub fn run(
    request: &MergeRequest,
    knowledge: &Knowledge,
    progress: &(dyn Fn(u64, u64) + Sync),
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
    let mut tolerated = donors::codes(&request.tolerate, knowledge)?;
    if !donors::are_sound(recipe, &donors, &options, &tolerated, &mut run)? {
        return Ok(run.end(MergeStage::Donors));
    }
    run.note("recipe", &format!("{}: {}", recipe.recipe, recipe.summary));

    choice::check_architectures(recipe, &run)?;
    quantised::check(recipe, &donors, &knowledge.schemes)?;
    let draft = plan::plan(recipe, &donors, &options, &request.versions, knowledge)?;
    run.record_draft(&draft);
    if !draft.seams.is_empty() {
        run.note("plan", &count(draft.seams.len(), "seam does not fit", "seams do not fit"));
        return Ok(run.end(MergeStage::Seam));
    }
    let shards = count(draft.plan.shards.len(), "shard", "shards");
    let planned = format!("{} tensors, {} bytes in {shards}", run.record.tensors, run.record.bytes);
    run.note("plan", &planned);

    let preview = draft.preview(&out);
    run.record_preview(&preview, &draft, knowledge);
    tolerated.extend(recipe.tolerates.iter().cloned());
    if !run.check(Role::Planned, &request.out, preview, knowledge, &tolerated) {
        return Ok(run.end(MergeStage::Planned));
    }
    publish::check(recipe, &draft)?;
    if request.dry_run {
        run.record.dry_run = Some(dry_run::facts(&draft, recipe, &donors, &out)?);
        run.plan = Some(dry_run::document(&draft, recipe));
        run.note("write", "skipped (--dry-run)");
        return Ok(run.end(MergeStage::DryRun));
    }

    let cleared = cleared.as_deref();
    ReadyMerge {
        request,
        recipe,
        donors: &donors,
        snapshots: &snapshots,
        draft: &draft,
        out: &out,
        cleared,
        tolerated: &tolerated,
        knowledge,
    }
    .write(run, progress)
}

/// A merge of which everything is decided.
struct ReadyMerge<'m> {
    request: &'m MergeRequest,
    recipe: &'m Recipe,
    donors: &'m [Donor],
    snapshots: &'m [DonorSnapshot],
    draft: &'m MergeDraft,
    /// The directory to create.
    out: &'m Path,
    /// What an ended run had left of it.
    cleared: Option<&'m Path>,
    /// Rules whose errors do not stop the merge.
    tolerated: &'m [String],
    knowledge: &'m Knowledge,
}

impl ReadyMerge<'_> {
    /// Writes the result, opens it, and checks it.
    fn write(&self, mut run: MergeRun, progress: &(dyn Fn(u64, u64) + Sync)) -> Result<MergeRun, PipelineError> {
        let Self { request, recipe, donors, draft, out, .. } = *self;
        let digests = manifest::donor_digests(donors, &draft.plan, request.hash_donors)?;
        let total = draft.plan.len();
        let done = AtomicU64::new(0);
        let (plan, changeable) = (&draft.plan, &draft.changeable);
        let recorded = Recorded { recipe, donors, digests: &digests, plan, hash: request.hash, changeable };
        let sizes = record::sizes(&run, &recorded);
        let mut record = |written: &[WrittenShard]| record::files(&mut run, &recorded, written);
        let leftover = apply(plan, self.snapshots, out, &sizes, &mut record, Writing::new(request.hash), &|bytes| {
            let before = done.fetch_add(bytes, Ordering::Relaxed);
            progress(before.saturating_add(bytes), total);
        })?;
        run.note_files(self.cleared, leftover.as_ref());
        let reopen = |error| PipelineError::Reopen { out: request.out.clone(), error };
        let written = Checkpoint::open(out).map_err(reopen)?;
        run.check(Role::Written, &request.out, written, self.knowledge, self.tolerated);
        Ok(run.end(MergeStage::Written))
    }
}
