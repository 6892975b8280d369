//! The first two stages: the targets of a checkpoint, and the class that each of them builds.

use serde_json::Value;

use super::Inputs;
use crate::check::layers;
use crate::check::load::{self, Target};
use crate::checkpoint::{Fault, FaultKind, Place};
use crate::knowledge::{Architecture, Expected, Loader, Refusal, UnknownPart};

/// A target, and the architecture of the class that its loader would build.
pub(super) struct TargetClass<'a> {
    pub(super) target: Target,
    pub(super) architecture: Architecture<'a>,
}

/// The same, with the class built from the config.
pub(super) struct BuiltClass<'a> {
    pub(super) target: Target,
    pub(super) architecture: Architecture<'a>,
    pub(super) class: Result<Expected, Refusal>,
}

/// The versions to predict for whose loader has the class.
pub(super) fn resolve_targets<'a>(inputs: &Inputs<'a>) -> Vec<TargetClass<'a>> {
    let names: Vec<&str> = inputs.stored.names().collect();
    let targets = load::targets(&inputs.knowledge.library, inputs.config, &names, inputs.versions);
    targets.into_iter().map(|(target, architecture)| TargetClass { target, architecture }).collect()
}

/// Builds the class of each target.
pub(super) fn build_classes<'a>(inputs: &Inputs<'a>, targets: Vec<TargetClass<'a>>) -> Vec<BuiltClass<'a>> {
    // The layout in which another version packs quantised weights is unknown.
    let comparable = targets.into_iter().filter(|one| one.target.leads || inputs.is_plain());
    let built = comparable.map(|TargetClass { target, architecture }| BuiltClass {
        class: load::build(architecture, inputs.config, inputs.stored),
        target,
        architecture,
    });
    leading(inputs, built.collect())
}

/// Lets another loader lead where the one that should does not know a part, unless the user named versions.
fn leading<'a>(inputs: &Inputs<'a>, mut built: Vec<BuiltClass<'a>>) -> Vec<BuiltClass<'a>> {
    if inputs.versions.is_empty() && is_unknown(&built) {
        let version = inputs.config.get("transformers_version").and_then(Value::as_str);
        if let Some(known) = built.iter_mut().find(|one| one.class.is_ok()) {
            known.target.lead(version);
        }
    }
    built
}

/// Whether no leading loader knows the class and all of its parts. A class that is known and cannot be built counts as
/// known.
fn is_unknown(built: &[BuiltClass<'_>]) -> bool {
    built.iter().all(|one| !one.target.leads || matches!(one.class, Err(Refusal::UnknownPart(_))))
}

/// For each loader that has the class, why no report of it is made; used where there is none.
pub(super) fn unpredicted(inputs: &Inputs<'_>, built: &[BuiltClass<'_>]) -> Vec<(&'static str, String)> {
    let why = |one: &BuiltClass<'_>| match &one.class {
        Err(refusal) => refusal.to_string(),
        Ok(_) if inputs.stored.is_empty() => "no tensor was read".to_owned(),
        Ok(_) => "the layout of its quantised tensors is unknown".to_owned(),
    };
    built.iter().map(|one| (one.target.loader.version(), why(one))).collect()
}

/// Faults of classes that are unknown or cannot be built from this config.
pub(super) fn faults(inputs: &Inputs<'_>, built: &[BuiltClass<'_>]) -> Vec<Fault> {
    let mut faults = unknown(inputs, built);
    if is_unknown(built) {
        // A known class is better evidence than a comparison of the layers with one another.
        faults.extend(layers::faults(inputs.stored.names()));
    }
    // A version that nobody named and that cannot build the class is passed over.
    for one in built.iter().filter(|one| one.target.leads) {
        if let Err(Refusal::Impossible(reasons)) = &one.class {
            let fault = Fault::new(FaultKind::ConfigIncomputable)
                .at(Place::file("config.json"))
                .with("architecture", one.architecture.name())
                .under(one.target.loader.version());
            faults.push(fault.with("reason", reasons.first().map_or("", String::as_str)));
        }
    }
    faults
}

/// Faults of a class, or of a part of one, that no loader is known to build, or none of those that the user named.
fn unknown(inputs: &Inputs<'_>, built: &[BuiltClass<'_>]) -> Vec<Fault> {
    let unknown_part = |one: &BuiltClass<'_>| match &one.class {
        Err(Refusal::UnknownPart(part)) => Some(part.clone()),
        _ => None,
    };
    if inputs.versions.is_empty() {
        let part = built.iter().find_map(unknown_part);
        return is_unknown(built).then(|| unknown_class(inputs.config, part.as_ref())).into_iter().collect();
    }
    let for_version = |version: &String| {
        let fault = match built.iter().find(|one| one.target.loader == Loader::nearest(version)) {
            Some(found) => unknown_class(inputs.config, Some(&unknown_part(found)?)),
            None => unknown_class(inputs.config, None),
        };
        Some(fault.with("under", format!("transformers {version}")))
    };
    inputs.versions.iter().filter_map(for_version).collect()
}

fn unknown_class(config: &Value, part: Option<&UnknownPart>) -> Fault {
    let text = |pointer: &str| config.pointer(pointer).and_then(Value::as_str).unwrap_or("none");
    let pointer = match part {
        Some(part) if !part.config.is_empty() => format!("/{}/model_type", part.config.replace('.', "/")),
        _ => "/model_type".to_owned(),
    };
    let fault = Fault::new(FaultKind::UnknownArchitecture)
        .at(Place::file("config.json").pointer(pointer))
        .with("model_type", text("/model_type"))
        .with("class", text("/architectures/0"));
    part.into_iter().fold(fault, |fault, part| fault.with("part", part.to_string()))
}
