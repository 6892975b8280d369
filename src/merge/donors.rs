//! The donors of a merge: opens and checks them, and matches them with the recipe.

use std::sync::Arc;

use super::context::Donor;
use super::error::{MergeError, PipelineError};
use super::run::{CheckedCheckpoint, MergeRequest, MergeRun, count};
use crate::check::{Finding, Severity, check};
use crate::checkpoint::Checkpoint;
use crate::checkpoint::open::{OpenError, real_target};
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::{DonorSpec, Recipe};
use crate::knowledge::source::hint;
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
        let checkpoint = Checkpoint::open(dir).map_err(|error| PipelineError::Donor { role: role.clone(), error })?;
        snapshots.push(seen?);
        for name in checkpoint.shards.keys() {
            // Other errors of a link are findings.
            if let Err(error @ OpenError::Outside { .. }) = real_target(dir, &dir.join(name)) {
                return Err(PipelineError::Donor { role: role.clone(), error });
            }
        }
        let checkpoint = Arc::new(checkpoint);
        let outcome = check(&checkpoint, knowledge);
        donors.push(Donor { role: role.clone(), checkpoint: Arc::clone(&checkpoint), config: outcome.config.clone() });
        run.checked.push(CheckedCheckpoint { role: Role::Donor(role.clone()), path: dir.clone(), checkpoint, outcome });
    }
    Ok((donors, snapshots))
}

/// Selects the only recipe whose roles match the donors' architectures.
pub(super) fn choose_recipe<'k>(recipes: &'k [Recipe], run: &MergeRun) -> Result<&'k Recipe, MergeError> {
    let plays = |spec: &DonorSpec| {
        run.donor(&spec.role).map_or(spec.optional, |donor| {
            spec.architectures.is_empty()
                || donor.outcome.architecture.as_ref().is_some_and(|a| spec.architectures.contains(a))
        })
    };
    let fitting: Vec<&Recipe> = recipes.iter().filter(|recipe| recipe.donors.iter().all(plays)).collect();
    match fitting.as_slice() {
        [one] => Ok(one),
        [] => {
            let is = |donor: &CheckedCheckpoint| {
                let architecture = donor.outcome.architecture.as_deref();
                format!("{} is {}", donor.role, architecture.unwrap_or("of an unknown architecture"))
            };
            let donors: Vec<String> = run.checked.iter().map(is).collect();
            let donors = donors.join(", ");
            Err(MergeError::Donor(format!("no recipe fits these donors: {donors}; select one with --recipe")))
        }
        several => {
            let names: Vec<&str> = several.iter().map(|r| r.recipe.as_str()).collect();
            let names = names.join(", ");
            Err(MergeError::Donor(format!("several recipes fit these donors: {names}; select one with --recipe")))
        }
    }
}

/// Fails unless the donors match the roles of the recipe.
pub(super) fn check_roles(recipe: &Recipe, request: &MergeRequest) -> Result<(), MergeError> {
    for role in request.donors.keys() {
        if !recipe.donors.iter().any(|d| d.role == *role) {
            let known: Vec<&str> = recipe.donors.iter().map(|d| d.role.as_str()).collect();
            let hint = hint(role, &known);
            return Err(MergeError::Option(format!("recipe {} has no donor {role}; {hint}", recipe.recipe)));
        }
    }
    for spec in recipe.donors.iter().filter(|d| !d.optional) {
        if !request.donors.contains_key(&spec.role) {
            return Err(MergeError::Option(format!(
                "recipe {} needs a {} donor, {}: --donor {}=DIR",
                recipe.recipe, spec.role, spec.what, spec.role
            )));
        }
    }
    Ok(())
}

/// Fails unless the architecture of each donor is allowed for its role.
pub(super) fn check_architectures(recipe: &Recipe, run: &MergeRun) -> Result<(), MergeError> {
    for spec in recipe.donors.iter().filter(|s| !s.architectures.is_empty()) {
        let Some(donor) = run.donor(&spec.role) else { continue };
        let is = donor.outcome.architecture.as_deref();
        if !is.is_some_and(|a| spec.architectures.iter().any(|s| s == a)) {
            return Err(MergeError::Donor(format!(
                "{}: the {} donor must be {} ({}), but this is {}",
                donor.path.display(),
                spec.role,
                spec.architectures.join(" or "),
                spec.what,
                is.unwrap_or("of an unknown architecture")
            )));
        }
    }
    Ok(())
}

/// Whether no donor has errors, except those that the recipe tolerates; records the result.
pub(super) fn are_sound(recipe: &Recipe, run: &mut MergeRun) -> bool {
    let mut unsound = Vec::new();
    for spec in &recipe.donors {
        // A directory that only provides Python modules is not checked as a checkpoint.
        let Some(donor) = run.donor(&spec.role).filter(|_| !spec.architectures.is_empty()) else { continue };
        let stops = |f: &&Finding| f.severity == Severity::Error && !spec.tolerates.contains(&f.code);
        let errors = donor.outcome.findings.iter().filter(stops).count();
        if errors > 0 {
            unsound.push(format!("{} has {}", donor.role, count(errors, "error", "errors")));
        }
    }
    let sound = unsound.is_empty();
    let outcome = if sound {
        count(run.checked.len(), "donor has no errors", "donors have no errors")
    } else {
        unsound.join(", ")
    };
    run.note("donors", &outcome);
    sound
}
