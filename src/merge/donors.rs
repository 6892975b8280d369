//! The donors of a merge: opens, checks and judges them.

use std::sync::Arc;

use serde_json::Value;

use super::context::option_values;
use super::error::{MergeError, PipelineError};
use super::options::Options;
use super::parts::{Donor, DonorParts, PartOf};
use super::run::{CheckedCheckpoint, MergeRequest, MergeRun, count};
use crate::check::{Finding, Location, Severity, check};
use crate::checkpoint::journal::StateFolder;
use crate::checkpoint::{Checkpoint, OpenError, files};
use crate::knowledge::recipe::{DonorSpec, Recipe};
use crate::knowledge::{Knowledge, Scope, Template};
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

/// The codes of rules that a request names by code or name.
pub(super) fn codes(names: &[String], knowledge: &Knowledge) -> Result<Vec<String>, MergeError> {
    let code = |name: &String| match knowledge.rules.find(name) {
        Ok(rule) => Ok(rule.code.clone()),
        Err(error) => Err(MergeError::Option(format!("tolerate {name}: {error}"))),
    };
    names.iter().map(code).collect()
}

/// Whether no donor has errors, except those that the recipe or `tolerated` tolerates, and those of parts that are not used;
/// records the result.
pub(super) fn are_sound(
    recipe: &Recipe,
    donors: &[Donor],
    options: &Options,
    tolerated: &[String],
    run: &mut MergeRun,
) -> Result<bool, MergeError> {
    let mut scope = Scope::new();
    scope.bind("opt", &Value::Object(option_values(recipe, options)?.0));
    let (mut judged, mut unsound, mut spared, mut unjudged) = (0_usize, Vec::new(), Vec::new(), Vec::new());
    for spec in &recipe.donors {
        let Some(checked) = run.donor(&spec.role) else { continue };
        if !spec.is_checkpoint() {
            unjudged.push(format!("{} only provides files", spec.role));
            continue;
        }
        judged = judged.saturating_add(1);
        let unused =
            donors.iter().find(|donor| donor.role == spec.role).map(|donor| UnusedParts::of(donor, spec, &scope));
        let unused = unused.transpose()?.unwrap_or_default();
        let errors = checked.outcome.findings.iter().filter(|f| f.severity == Severity::Error);
        let (aside, errors): (Vec<_>, Vec<_>) = errors.partition(|finding| unused.has(finding));
        let (let_be, stopping): (Vec<_>, Vec<_>) =
            errors.into_iter().partition(|f| spec.tolerates.contains(&f.code) || tolerated.contains(&f.code));
        let has = |n: usize| format!("{} has {}", spec.role, count(n, "error", "errors"));
        if !stopping.is_empty() {
            unsound.push(has(stopping.len()));
            continue;
        }
        let by = if let_be.iter().any(|f| tolerated.contains(&f.code)) {
            "--tolerate allows"
        } else {
            "the recipe tolerates"
        };
        let let_be = (!let_be.is_empty()).then(|| format!("{} that {by}", has(let_be.len())));
        let aside = (!aside.is_empty()).then(|| format!("{} in parts that are not used", has(aside.len())));
        spared.extend(let_be.into_iter().chain(aside).reduce(|one, other| format!("{one}, {other}")));
    }
    let sound = unsound.is_empty();
    let clean = judged.saturating_sub(spared.len());
    let clean = (clean > 0).then(|| count(clean, "donor has no errors", "donors have no errors"));
    let outcome: Vec<String> = if sound { clean.into_iter().chain(spared).chain(unjudged).collect() } else { unsound };
    run.note("donors", &outcome.join(", "));
    Ok(sound)
}

/// The parts of a donor that the result does not have.
#[derive(Default)]
struct UnusedParts<'d> {
    /// Those that are used.
    used: Vec<PartOf<'d>>,
    unused: Vec<PartOf<'d>>,
}

impl<'d> UnusedParts<'d> {
    /// Those of a donor, by what its entry in the recipe says.
    fn of(donor: &'d Donor, spec: &DonorSpec, scope: &Scope<'_>) -> Result<Self, MergeError> {
        let named = |part: &Option<Template>| {
            let name = part.as_ref().map(|part| part.try_render(scope)).transpose();
            let name = name.map_err(|error| MergeError::Recipe(format!("part of the {} donor: {error}", spec.role)))?;
            Ok::<_, MergeError>(name.and_then(|name| PartOf::find(donor, &name)))
        };
        let (only, without) = (named(&spec.only_part)?, named(&spec.without_part)?);
        let all = || donor.parts.iter().flat_map(DonorParts::names).filter_map(|name| PartOf::find(donor, name));
        let (used, unused): (Vec<_>, Vec<_>) = match (only, without) {
            (None, None) => (Vec::new(), Vec::new()),
            (Some(only), _) => all().partition(|part| part.name == only.name),
            (None, Some(without)) => all().partition(|part| part.name != without.name),
        };
        Ok(Self { used, unused })
    }

    /// Whether every place of a finding is in a part that is not used, as far as places tell.
    fn has(&self, finding: &Finding) -> bool {
        let named = finding.evidence.get("count").and_then(Value::as_u64).unwrap_or_default();
        let lists_all = finding.hidden == 0 && named <= finding.locations.len() as u64;
        let is_in = |parts: &[PartOf<'_>], place: &Location| parts.iter().any(|part| contains(*part, place));
        let is_aside = |place: &Location| is_in(&self.unused, place) && !is_in(&self.used, place);
        lists_all && !finding.locations.is_empty() && finding.locations.iter().all(is_aside)
    }
}

/// Whether a place is a tensor of the part, or in its config.
fn contains(part: PartOf<'_>, place: &Location) -> bool {
    match (&place.tensor, &place.pointer) {
        (Some(tensor), _) => part.inside(tensor).is_some(),
        (None, Some(pointer)) if place.file.as_deref() == Some(files::CONFIG) => {
            let at = part.stored().map(|(at, _)| at).filter(|at| !at.is_empty());
            at.is_some_and(|at| pointer.strip_prefix(at).is_some_and(|rest| rest.is_empty() || rest.starts_with('/')))
        }
        _ => false,
    }
}
