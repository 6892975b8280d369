//! What a directory is, when it is no checkpoint of transformers.

use crate::checkpoint::files;
use serde_json::Value;

use super::model_type::is_of_transformers;
use super::view::{ExplainingFacts, Observation, VersionsView};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::Scope;
use crate::knowledge::directories::Directories;

/// The fault that tells the kind of the directory, which explains others.
pub(super) fn observe(view: &VersionsView<'_>) -> Observation {
    let directory = fault(view.checkpoint, &view.knowledge.directories, view.scope);
    let facts = ExplainingFacts { directory: directory.clone(), ..ExplainingFacts::default() };
    Observation { faults: directory.into_iter().collect(), facts, ..Observation::default() }
}

/// The fault that tells the kind of a directory; `None` for a checkpoint of transformers and for an unknown kind.
fn fault(checkpoint: &Checkpoint, directories: &Directories, scope: &Scope<'_>) -> Option<Fault> {
    let names: Vec<String> = checkpoint.names().map(String::from).filter(|name| is_own(name)).collect();
    let recognised = directories.kind_of(&names, scope)?;
    let kind = recognised.kind;
    let fault = Fault::new(FaultKind::DirectoryRecognised).with("is", kind.is.as_str());
    let fault = recognised.signs.iter().fold(fault, |fault, sign| fault.at(Place::file(sign)));
    let fault = fault.with("signs", recognised.signs);
    let fault = kind.help.iter().fold(fault, |fault, help| fault.with("command", help.render(scope)));
    Some(match &kind.opened_by {
        Some(program) => fault.with("program", program.as_str()),
        None => fault.with("has_config", checkpoint.has_file(files::CONFIG)),
    })
}

/// The program that opens the directory; empty when none does.
pub(super) fn program(directory: &Fault) -> &str {
    directory.detail.get("program").and_then(Value::as_str).unwrap_or_default()
}

/// Removes a fault that a directory has because of its kind: its weights are missing, or are files of the training run;
/// for another library, that transformers knows neither its class nor its files.
pub(super) fn explain(checkpoint: &Checkpoint, facts: &ExplainingFacts, fault: Fault) -> Option<Fault> {
    let Some(directory) = &facts.directory else { return Some(fault) };
    let is_sign = |file: &str| directory.places.iter().any(|place| place.file.as_deref() == Some(file));
    let is_explained = match (fault.kind, program(directory)) {
        (FaultKind::NoWeights, "") => true,
        (FaultKind::PickleWeights, "") => fault.places.iter().filter_map(|p| p.file.as_deref()).any(is_sign),
        (_, "") => false,
        (FaultKind::NoWeights | FaultKind::UnknownArchitecture, _) => !is_of_transformers(checkpoint),
        _ => false,
    };
    (!is_explained).then_some(fault)
}

/// Whether an entry lies in the directory itself.
fn is_own(name: &str) -> bool {
    !name.trim_end_matches('/').contains('/')
}
