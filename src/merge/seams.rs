//! Places in models where parts of others come to stand, and what keeps them from standing there.

use serde_json::{Value, json};

use super::context::Context;
use super::error::MergeError;
use super::explain;
use super::parts::{PartOf, image_processor, value_of};
use crate::checkpoint::files;
use crate::knowledge::Scope;
use crate::report::model::Seam;

impl Context<'_> {
    /// Variables of [`crate::knowledge::parts::Follow`] and [`crate::knowledge::parts::Need`], for a place in a model and the
    /// part `new` that comes to stand there.
    pub(super) fn of_place(&self, place: PartOf<'_>, new: PartOf<'_>) -> Result<Scope<'_>, MergeError> {
        let mut scope = self.scope.child();
        let at = place.stored().map_or("", |(at, _)| at);
        let host = place.donor();
        scope.bind("at", &json!(at));
        scope.bind("part", new.config());
        scope.bind("host", place.host());
        let stored = new.stored().map_or(Value::Null, |(_, stored)| json!(stored));
        scope.bind("part_stored", &stored);
        scope.bind("host_stored", value_of(&host.checkpoint, files::CONFIG).unwrap_or(&Value::Null));
        for (name, donor) in [("host_preprocessor", host), ("part_preprocessor", new.donor())] {
            scope.bind(name, image_processor(&donor.checkpoint).unwrap_or(&json!({})));
        }
        for item in &place.part.lets {
            let value = item.is.eval(&scope).map_err(self.at(format!("{} of the part {}", item.name, place.name)))?;
            scope.bind(&item.name, &value);
        }
        Ok(scope)
    }
}

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
