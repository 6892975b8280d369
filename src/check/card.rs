//! What a model card says of the base model.

use super::model_type::CAP;
use crate::checkpoint::files;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, escape};

/// Faults of the model card. Called by the engine.
pub(super) fn faults(checkpoint: &Checkpoint) -> Vec<Fault> {
    let Some(card) = &checkpoint.card else { return Vec::new() };
    let first = card.base_models.iter().find(|(name, _)| is_path(name) && !name.contains("://"));
    let fault = |(name, span): &(String, std::ops::Range<usize>)| {
        let fault = Fault::new(FaultKind::CardBaseIsAPath).at(Place::file(files::CARD).span(span.clone()));
        fault.with("base", escape(name, CAP))
    };
    first.map(fault).into_iter().collect()
}

/// The only base model that the card names, if that is the id of a repository, `ORG/NAME`. An adapter without a usable base
/// takes its fix from it.
pub(super) fn base_on_hub(checkpoint: &Checkpoint) -> Option<&str> {
    let [(name, _)] = checkpoint.card.as_ref()?.base_models.as_slice() else { return None };
    (!is_path(name) && name.split('/').filter(|part| !part.is_empty()).count() == 2).then_some(name)
}

/// Whether a base model is named by a path of the machine that trained: a Hub id has at most one slash, inside.
pub(super) fn is_path(base: &str) -> bool {
    let drive = base.get(1..3).is_some_and(|s| s == ":\\" || s == ":/");
    drive || base.starts_with(['/', '.', '~']) || base.contains('\\') || base.matches('/').count() > 1
}
