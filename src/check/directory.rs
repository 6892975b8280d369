//! What a directory is, when it is no checkpoint of transformers.

use serde_json::{Value, json};

use super::model_type::is_of_transformers;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::Scope;
use crate::knowledge::directories::Directories;

/// Adds the fault that tells the kind of the directory, removes those that the kind explains, and binds `program`: the program
/// that opens it. Called by the engine with the scope of the checkpoint and all its faults.
pub(super) fn recognise(
    checkpoint: &Checkpoint,
    directories: &Directories,
    scope: &mut Scope<'_>,
    faults: &mut Vec<Fault>,
) {
    let fault = fault(checkpoint, directories, scope);
    scope.bind("program", &json!(fault.as_ref().map_or("", program)));
    if let Some(fault) = fault {
        explain(checkpoint, faults, &fault);
        faults.push(fault);
    }
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
        None => fault.with("has_config", checkpoint.has_file("config.json")),
    })
}

/// The program that opens the directory; empty when none does.
fn program(directory: &Fault) -> &str {
    directory.detail.get("program").and_then(Value::as_str).unwrap_or_default()
}

/// Removes the faults that a directory has because of its kind: its weights are missing, or are files of the training run;
/// for another library, that transformers knows neither its class nor its files.
fn explain(checkpoint: &Checkpoint, faults: &mut Vec<Fault>, directory: &Fault) {
    if !program(directory).is_empty() {
        let is_foreign = |kind| matches!(kind, FaultKind::NoWeights | FaultKind::UnknownArchitecture);
        faults.retain(|fault| is_of_transformers(checkpoint) || !is_foreign(fault.kind));
        return;
    }
    let signs: Vec<&str> = directory.places.iter().filter_map(|place| place.file.as_deref()).collect();
    let is_sign = |fault: &Fault| fault.places.iter().any(|p| p.file.as_deref().is_some_and(|f| signs.contains(&f)));
    faults.retain(|fault| match fault.kind {
        FaultKind::NoWeights => false,
        FaultKind::PickleWeights => !is_sign(fault),
        _ => true,
    });
}

/// Whether an entry lies in the directory itself.
fn is_own(name: &str) -> bool {
    !name.trim_end_matches('/').contains('/')
}
