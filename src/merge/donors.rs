//! The donors of a merge: opens, checks and judges them.

use std::sync::Arc;

use super::error::PipelineError;
use super::parts::{Donor, DonorParts};
use super::run::{CheckedCheckpoint, MergeRequest, MergeRun, count};
use crate::check::{Finding, Severity, check};
use crate::checkpoint::journal::StateFolder;
use crate::checkpoint::{Checkpoint, OpenError};
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::Recipe;
use crate::report::model::Role;
use crate::surgery::donor::DonorSnapshot;

/// Opens and checks every donor; the snapshots in the second list detect later changes of their files.
pub(super) fn open(
    request: &MergeRequest,
    knowledge: &Knowledge,
    run: &mut MergeRun,
) -> Result<(Vec<Donor>, Vec<DonorSnapshot>), PipelineError> {
    let mut donors = Vec::new();
    let mut snapshots = Vec::new();
    for (role, dir) in &request.donors {
        let seen = DonorSnapshot::record(dir);
        let open = Checkpoint::open(dir).map_err(|error| PipelineError::Donor { role: role.clone(), error });
        let mut checkpoint = open?.without_pickles();
        checkpoint.recognise_journal(&StateFolder::of_user());
        snapshots.push(seen?);
        for name in checkpoint.shards.keys() {
            // Other errors of a link are findings.
            if let Err(error @ OpenError::Outside { .. }) = checkpoint.source.check_link(name) {
                return Err(PipelineError::Donor { role: role.clone(), error });
            }
        }
        let checkpoint = Arc::new(checkpoint);
        let outcome = check(&checkpoint, knowledge);
        let parts = DonorParts::of(&checkpoint, &outcome, knowledge);
        let config = outcome.config.clone();
        donors.push(Donor { role: role.clone(), checkpoint: Arc::clone(&checkpoint), config, parts: parts.clone() });
        let role = Role::Donor(role.clone());
        run.checked.push(CheckedCheckpoint { role, path: dir.clone(), checkpoint, outcome, parts });
    }
    Ok((donors, snapshots))
}

/// Whether no donor has errors, except those that the recipe tolerates; records the result.
pub(super) fn are_sound(recipe: &Recipe, run: &mut MergeRun) -> bool {
    let (mut judged, mut unsound, mut tolerated, mut unjudged) = (0_usize, Vec::new(), Vec::new(), Vec::new());
    for spec in &recipe.donors {
        let Some(donor) = run.donor(&spec.role) else { continue };
        if !spec.is_checkpoint() {
            unjudged.push(format!("{} only provides files", spec.role));
            continue;
        }
        judged = judged.saturating_add(1);
        let is_error = |f: &&Finding| f.severity == Severity::Error;
        let errors = donor.outcome.findings.iter().filter(is_error);
        let (spared, stopping): (Vec<_>, Vec<_>) = errors.partition(|f| spec.tolerates.contains(&f.code));
        let has = |n: usize| format!("{} has {}", spec.role, count(n, "error", "errors"));
        if !stopping.is_empty() {
            unsound.push(has(stopping.len()));
        } else if !spared.is_empty() {
            tolerated.push(format!("{} that the recipe tolerates", has(spared.len())));
        }
    }
    let sound = unsound.is_empty();
    let clean = judged.saturating_sub(tolerated.len());
    let clean = (clean > 0).then(|| count(clean, "donor has no errors", "donors have no errors"));
    let outcome: Vec<String> =
        if sound { clean.into_iter().chain(tolerated).chain(unjudged).collect() } else { unsound };
    run.note("donors", &outcome.join(", "));
    sound
}
