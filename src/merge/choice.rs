//! Matches donors with the roles of recipes: chooses a recipe, and says why donors do not fit.

use super::error::MergeError;
use super::run::{CheckedCheckpoint, MergeRequest, MergeRun};
use crate::knowledge::recipe::{DonorSpec, Recipe};
use crate::knowledge::source::{hint, nearest};
use crate::report::model::Role;

/// Selects the recipe whose roles the donors can take; a recipe that names their architectures goes before one that takes
/// any.
pub(super) fn choose_recipe<'k>(recipes: &'k [Recipe], run: &MergeRun) -> Result<&'k Recipe, MergeError> {
    let fitting: Vec<&Recipe> = recipes.iter().filter(|recipe| misfits(recipe, run).is_empty()).collect();
    let (unspecific, named): (Vec<&Recipe>, Vec<&Recipe>) = fitting
        .into_iter()
        .partition(|recipe| recipe.donors.iter().any(|spec| spec.takes_any() || !spec.parts.is_empty()));
    let fitting = if named.is_empty() { unspecific } else { named };
    match fitting.as_slice() {
        [one] => Ok(one),
        [] => Err(MergeError::Donor(nothing_fits(recipes, run))),
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

/// Fails unless each donor can take its role.
pub(super) fn check_architectures(recipe: &Recipe, run: &MergeRun) -> Result<(), MergeError> {
    if let Some(exchange) = exchange(recipe, run) {
        return Err(MergeError::Donor(format!("recipe {}: {exchange}", recipe.recipe)));
    }
    for spec in &recipe.donors {
        let Some(donor) = run.donor(&spec.role) else { continue };
        if let Some(reason) = misfit(spec, donor) {
            return Err(MergeError::Donor(format!("{}: {reason} ({})", donor.path.display(), spec.what)));
        }
    }
    Ok(())
}

/// Why a donor cannot take a role; `None` when it can.
fn misfit(spec: &DonorSpec, donor: &CheckedCheckpoint) -> Option<String> {
    let has = |name: &&String| donor.parts.as_ref().is_some_and(|parts| parts.part(name).is_some());
    if let Some(part) = spec.parts.iter().find(|part| !has(part)) {
        return Some(format!(
            "the {} donor must have a {part} part, but none is known of {}",
            spec.role,
            architecture(donor)
        ));
    }
    if let Some(part) = spec.no_parts.iter().find(has) {
        return Some(format!("the {} donor, {}, has a {part} part", spec.role, architecture(donor)));
    }
    let is = donor.outcome.architecture.as_deref();
    let named = || is.is_some_and(|name| spec.architectures.iter().any(|one| one == name));
    if spec.architectures.is_empty() || spec.takes_any() || named() {
        return None;
    }
    let wanted = spec.architectures.join(" or ");
    Some(format!("the {} donor must be {wanted}, but this is {}", spec.role, architecture(donor)))
}

fn architecture(donor: &CheckedCheckpoint) -> &str {
    donor.outcome.architecture.as_deref().unwrap_or("of an unknown architecture")
}

/// Every reason why the donors do not fit a recipe; empty when they do.
fn misfits(recipe: &Recipe, run: &MergeRun) -> Vec<String> {
    let mut reasons = Vec::new();
    for donor in &run.checked {
        if let Role::Donor(role) = &donor.role
            && !recipe.donors.iter().any(|spec| spec.role == *role)
        {
            let near = nearest(role, recipe.donors.iter().map(|spec| spec.role.as_str()));
            let hint = near.map(|near| format!(" (did you mean {near}?)")).unwrap_or_default();
            reasons.push(format!("it has no {role} donor{hint}"));
        }
    }
    for spec in &recipe.donors {
        match run.donor(&spec.role) {
            Some(donor) => reasons.extend(misfit(spec, donor)),
            None if spec.optional => {}
            None => reasons.push(format!(
                "the {role} donor is missing: --donor {role}=DIR, {}",
                spec.what,
                role = spec.role
            )),
        }
    }
    reasons
}

/// Two donors that fit the recipe only in each other's role, as a sentence.
fn exchange(recipe: &Recipe, run: &MergeRun) -> Option<String> {
    let given: Vec<(&DonorSpec, &CheckedCheckpoint)> =
        recipe.donors.iter().filter_map(|spec| Some((spec, run.donor(&spec.role)?))).collect();
    for (at, (one, donor)) in given.iter().enumerate() {
        for (other, partner) in given.iter().skip(at.saturating_add(1)) {
            let now = misfit(one, donor).or_else(|| misfit(other, partner));
            let swapped = misfit(one, partner).or_else(|| misfit(other, donor));
            if now.is_some() && swapped.is_none() {
                return Some(format!(
                    "the {} donor is {} and the {} donor {}: exchange them",
                    one.role,
                    architecture(donor),
                    other.role,
                    architecture(partner)
                ));
            }
        }
    }
    None
}

/// Why no recipe fits: donors in each other's role, or else what the nearest recipe lacks.
fn nothing_fits(recipes: &[Recipe], run: &MergeRun) -> String {
    let has_all = |recipe: &&Recipe| {
        run.checked.iter().all(
            |donor| matches!(&donor.role, Role::Donor(role) if recipe.donors.iter().any(|spec| spec.role == *role)),
        )
    };
    let swapped = recipes.iter().filter(has_all).find_map(|recipe| Some((recipe, exchange(recipe, run)?)));
    if let Some((recipe, exchange)) = swapped {
        return format!("{exchange} (recipe {})", recipe.recipe);
    }
    let is = |donor: &CheckedCheckpoint| format!("{} is {}", donor.role, architecture(donor));
    let donors: Vec<String> = run.checked.iter().map(is).collect();
    // Recipes for donors of other roles are near only if no recipe is for these.
    let is_near = |recipe: &&Recipe| has_all(recipe) || !recipes.iter().any(|recipe| has_all(&recipe));
    let near = recipes.iter().filter(is_near).map(|recipe| (recipe, misfits(recipe, run)));
    let nearest = near.min_by_key(|(_, reasons)| reasons.len());
    let nearest = nearest.map_or_else(String::new, |(recipe, reasons)| {
        format!("; for the nearest, {}, {}", recipe.recipe, reasons.join(", and "))
    });
    format!("no recipe fits these donors: {}{nearest}; `ckpt-doctor recipes` lists all", donors.join(", "))
}
