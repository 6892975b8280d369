//! Turns a recipe and its donors into a draft: the plan, and the seams with a mismatch.
//!
//! Nothing is written or checked here: [`super::run`] checks the donors and the preview.

use std::collections::BTreeMap;

use serde_json::Value;

use super::context::Context;
use super::draft::MergeDraft;
use super::error::MergeError;
use super::options::{self, Options};
use super::parts::Donor;
use super::{alike, documents, files, seams, tensors};
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::Recipe;
use crate::report::model::Seam;

/// Turns a recipe into a draft for these versions of transformers, or any: seams, documents, tensors, files, notes.
///
/// An expression that cannot be evaluated with these donors is a seam. So is any error after another seam, which may be its
/// cause.
///
/// # Errors
/// A [`MergeError`] when the recipe cannot be applied to these donors and options.
pub(super) fn plan(
    recipe: &Recipe,
    donors: &[Donor],
    options: &Options,
    versions: &[String],
    knowledge: &Knowledge,
) -> Result<MergeDraft, MergeError> {
    let mut draft = plan_once(recipe, donors, options, versions, knowledge)?;
    offer_what_helps(&mut draft.seams, options, |options| plan_once(recipe, donors, options, versions, knowledge));
    Ok(draft)
}

/// [`plan`] with all of the options that seams offer.
fn plan_once(
    recipe: &Recipe,
    donors: &[Donor],
    options: &Options,
    versions: &[String],
    knowledge: &Knowledge,
) -> Result<MergeDraft, MergeError> {
    let mut draft = MergeDraft::default();
    match fill(&mut draft, recipe, donors, options, versions, knowledge) {
        Err(error) if matches!(error, MergeError::Expression { .. }) || !draft.seams.is_empty() => {
            draft.seams.push(Seam { message: error.to_string(), ..Seam::default() });
            Ok(draft)
        }
        filled => filled.map(|()| draft),
    }
}

/// Leaves out of seams the options with which a plan still has the seam, so that help does not go in circles. `plan` plans the
/// merge with other options.
fn offer_what_helps(seams: &mut [Seam], options: &Options, plan: impl Fn(&Options) -> Result<MergeDraft, MergeError>) {
    let mut plans: BTreeMap<String, Option<Vec<Seam>>> = BTreeMap::new();
    for seam in seams {
        let mut offered = std::mem::take(&mut seam.options);
        let place = |seam: &Seam| seam.tensor.as_ref().map(|tensor| (tensor.donor.clone(), tensor.name.clone()));
        let is_same = |other: &Seam| match (place(seam), place(other)) {
            (Some(one), Some(other)) => one == other,
            _ => seam.message == other.message,
        };
        offered.retain(|offer| {
            let Some((name, value)) = offer.strip_prefix("--set ").and_then(|set| set.split_once('=')) else {
                return true;
            };
            let with = || {
                let mut options = options.clone();
                options.insert(name.to_owned(), value.to_owned());
                plan(&options).ok().map(|draft| draft.seams)
            };
            let there = plans.entry(offer.clone()).or_insert_with(with);
            there.as_ref().is_some_and(|seams| !seams.iter().any(is_same))
        });
        seam.options = offered;
    }
}

/// Adds to the draft what the recipe makes of the donors; stops at parts that cannot stand in their place.
fn fill(
    draft: &mut MergeDraft,
    recipe: &Recipe,
    donors: &[Donor],
    options: &Options,
    versions: &[String],
    knowledge: &Knowledge,
) -> Result<(), MergeError> {
    let context = Context::new(recipe, donors, options, versions, knowledge)?;
    draft.notes.extend(alike::check(&context)?);
    for (i, seam) in recipe.seams.iter().enumerate() {
        let place = format!("seam {}", i.saturating_add(1));
        if seam.that.eval_bool(&context.scope).map_err(context.at(place.as_str()))? {
            continue;
        }
        let needed = seam.needed.as_ref().and_then(|e| e.eval(&context.scope).ok()).and_then(|v| shape_of(&v));
        draft.seams.push(Seam {
            message: seam.message.render(&context.scope),
            tensor: seam.tensor.as_ref().and_then(|t| context.shaped(t)),
            meets: seam.meets.as_ref().and_then(|t| context.shaped(t)),
            needed,
            options: seam.options.iter().map(|o| format!("--set {o}")).collect(),
        });
    }
    let refused = seams::seams(&context)?;
    if !refused.is_empty() {
        draft.seams.extend(refused);
        return Ok(());
    }
    let documents = documents::plan(&context, draft)?;
    let limit =
        options.get("shard-size").map_or(Ok(options::DEFAULT_SHARD), |s| options::parse_size("shard-size", s))?;
    tensors::plan(&context, &documents, knowledge, limit, draft)?;
    files::plan(&context, documents, draft)?;
    draft.opened.clone_from(&context.tokens);
    draft.tokenizer_of = recipe.tokens.as_ref().map(|tokens| tokens.base.clone());
    for note in &recipe.notes {
        if context.holds(Some(&note.when), "a note")? {
            draft.notes.push(note.say.render(&context.scope));
        }
    }
    Ok(())
}

fn shape_of(value: &Value) -> Option<Vec<u64>> {
    value.as_array()?.iter().map(Value::as_u64).collect()
}
