//! What keeps a part from standing in another model.

use super::context::Context;
use super::error::MergeError;
use super::explain;
use crate::report::model::Seam;

/// The seams of parts that come to stand in another model: types that its class does not build there, and what else it
/// needs of them.
pub(super) fn seams(context: &Context<'_>) -> Result<Vec<Seam>, MergeError> {
    let mut seams = Vec::new();
    for spec in context.recipe.tensors.iter().filter(|spec| spec.drop.is_none()) {
        let (Some(name), Some(into)) = (&spec.part, &spec.into) else { continue };
        if !context.holds(spec.when.as_ref(), "tensors")? {
            continue;
        }
        let name = name.try_render(&context.scope).map_err(context.at("part"))?;
        let (place, new) = (context.part(into, &name)?, context.part(&spec.from, &name)?);
        if let Some(message) = place.refuses(new).or_else(|| explain::empty(new.donor())) {
            seams.push(Seam { message, ..Seam::default() });
            continue;
        }
        // Without a tokenizer of the part's donor, the model keeps what it has.
        if context.recipe.tokens.is_none() {
            continue;
        }
        let scope = context.of_place(place, new)?;
        for need in &place.part.needs {
            if !need.that.eval_bool(&scope).map_err(context.at(format!("the part {name} of {into}")))? {
                seams.push(Seam { message: need.message.render(&scope), ..Seam::default() });
            }
        }
    }
    Ok(seams)
}
