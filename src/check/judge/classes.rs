//! The first two stages: the targets of a checkpoint, and the class that each of them builds.

use crate::checkpoint::files;
use serde_json::Value;

use super::Inputs;
use crate::check::layers;
use crate::check::load::{self, LoadReport, Stored, Target};
use crate::checkpoint::{Fault, FaultKind, Place};
use crate::knowledge::names::NameKind;
use crate::knowledge::quantization::DeclaredScheme;
use crate::knowledge::{Architecture, Doubt, Expected, Refusal};

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

/// The versions to predict for whose loader has the class. None where `model_type` is known and described by no file: then
/// another class is built than `architectures` names.
pub(super) fn resolve_targets<'a>(inputs: &Inputs<'a>) -> Vec<TargetClass<'a>> {
    let names: Vec<&str> = inputs.stored.names().collect();
    let model_type = inputs.config.get("model_type").and_then(Value::as_str).unwrap_or_default();
    let is_of_another = |architecture: &Architecture<'_>| {
        architecture.is_of_other_type(model_type)
            && inputs.knowledge.names.contains(NameKind::ModelType, model_type)
            && inputs.config.get("auto_map").is_none()
    };
    let targets = load::targets(&inputs.knowledge.library, inputs.config, &names, inputs.versions);
    let own = targets.into_iter().filter(|(_, architecture)| !is_of_another(architecture));
    own.map(|(target, architecture)| TargetClass { target, architecture }).collect()
}

/// Builds the class of each target.
pub(super) fn build_classes<'a>(inputs: &Inputs<'a>, targets: Vec<TargetClass<'a>>) -> Vec<BuiltClass<'a>> {
    // The layout in which another version packs quantised weights is unknown. One that reads no scheme builds plain modules.
    let reads_none = |one: &TargetClass<'_>| matches!(inputs.scheme_of(one.target.loader), DeclaredScheme::Plain);
    let comparable = targets.into_iter().filter(|one| one.target.leads || reads_none(one));
    let is_unnamed = inputs.knowledge.library.named_class(inputs.config).is_none() && inputs.is_plain();
    let fitting = comparable.map(|one| if is_unnamed { with_fitting_class(inputs, one) } else { one });
    let built = fitting.map(|TargetClass { target, architecture }| BuiltClass {
        class: with_flat_config(inputs, &architecture).and_then(|mut class| {
            class.doubts.extend(own_code(inputs, &architecture));
            covered(class, inputs.stored)
        }),
        target,
        architecture,
    });
    leading(inputs, built.collect())
}

/// The exception of a class that can generate when `text_config` stayed an object: its generation config is made of it.
///
/// Source: `GenerationConfig.from_model_config` of transformers 4.47.0, 4.57.6 and 5.23.0, run.
const NESTED: &str = "AttributeError: 'dict' object has no attribute 'to_dict'";

/// The class, unless this loader reads its values at the top of config.json and finds them in `text_config`, as a later
/// version writes them.
fn with_flat_config(inputs: &Inputs<'_>, architecture: &Architecture<'_>) -> Result<Expected, Refusal> {
    if architecture.misses_text_config(inputs.config) {
        return Err(Refusal::Raises(NESTED.to_owned()));
    }
    if architecture.leaves_text_config(inputs.config) {
        let reason = "text_config is an object, and what this class makes of it is not described";
        return Err(Refusal::NotCovered(vec![Doubt::Corner(reason.to_owned())]));
    }
    inputs.build(*architecture)
}

/// The class of this config class whose tensors are stored, where config.json names none: an encoder of T5, for one. Without
/// such a class, the one that `model_type` stands for.
fn with_fitting_class<'a>(inputs: &Inputs<'_>, one: TargetClass<'a>) -> TargetClass<'a> {
    let fits = |architecture: &Architecture<'_>| {
        let class = inputs.build(*architecture);
        class.is_ok_and(|class| load::predict(&class, inputs.stored).is_whole())
    };
    if fits(&one.architecture) {
        return one;
    }
    let architecture = one.architecture.siblings().find(fits).unwrap_or(one.architecture);
    TargetClass { architecture, ..one }
}

/// Lets another loader lead where the one that should does not know a part, unless the user named versions.
fn leading<'a>(inputs: &Inputs<'a>, mut built: Vec<BuiltClass<'a>>) -> Vec<BuiltClass<'a>> {
    if inputs.versions.is_empty()
        && is_unknown(&built)
        && let Some(known) = built.iter_mut().find(|one| one.class.is_ok())
    {
        known.target.lead();
    }
    built
}

/// Whether no leading loader knows the class and all of its parts, and covers this config. A class that is known and cannot
/// be built counts as known.
fn is_unknown(built: &[BuiltClass<'_>]) -> bool {
    let is_gap = |refusal: &Refusal| matches!(refusal, Refusal::UnknownPart(_) | Refusal::NotCovered(_));
    built.iter().all(|one| !one.target.leads || one.class.as_ref().is_err_and(is_gap))
}

/// The doubt about a class of transformers where the directory has code for it: with `trust_remote_code` that code is used,
/// and it may differ.
fn own_code(inputs: &Inputs<'_>, architecture: &Architecture<'_>) -> Option<Doubt> {
    let entries = inputs.config.get("auto_map")?.as_object().filter(|_| architecture.has_auto())?;
    let models = entries.iter().filter(|(key, _)| key.starts_with("AutoModel")).filter_map(|(_, value)| value.as_str());
    let mut modules = models.filter_map(|class| Some(format!("{}.py", class.rsplit_once('.')?.0)));
    let present = modules.find(|module| inputs.checkpoint.modules.contains_key(module))?;
    Some(Doubt::Corner(format!("{present} may differ from the class of transformers")))
}

/// The class, unless the checkpoint differs from it and the description does not cover this config: then the difference may
/// be an error of the description.
fn covered(class: Expected, stored: &Stored) -> Result<Expected, Refusal> {
    let is_clean = |report: LoadReport| report.is_whole() && report.unexpected.is_empty();
    if class.doubts.is_empty() || is_clean(load::predict(&class, stored)) {
        return Ok(class);
    }
    Err(Refusal::NotCovered(class.doubts))
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
    if is_unknown(built) && inputs.stored.is_searchable() {
        // A known class is better evidence than a comparison of the layers with one another.
        faults.extend(layers::faults(inputs.stored.names()));
    }
    faults.extend(unbuildable(built));
    faults
}

/// Faults of classes that cannot be built: one for each leading loader, which stands for the others that raise as well.
fn unbuildable(built: &[BuiltClass<'_>]) -> Vec<Fault> {
    let mut faults: Vec<Fault> = Vec::new();
    let (leading, others): (Vec<_>, Vec<_>) = built.iter().partition(|one| one.target.leads);
    for one in leading.into_iter().chain(others) {
        let fault = Fault::new(FaultKind::ConfigIncomputable)
            .at(Place::file(files::CONFIG))
            .with("architecture", one.architecture.name())
            .under(one.target.loader.version());
        match (&one.class, faults.first_mut()) {
            (Err(Refusal::Raises(_)), Some(first)) if !one.target.leads => {
                first.loaders.push(one.target.loader.version());
            }
            (Err(Refusal::Raises(exception)), _) => {
                let fault = if exception == NESTED { fault.with("nested", true) } else { fault };
                faults.push(fault.with("raises", exception.as_str()).with("loader", one.target.version()));
            }
            // A version that nobody named and that cannot build the class is passed over.
            (Err(Refusal::Impossible(reasons)), _) if one.target.leads => {
                faults.push(fault.with("reason", reasons.first().cloned().unwrap_or_default()));
            }
            _ => {}
        }
    }
    faults
}

/// Faults of a class, or of a part of one, that no loader is known to build, or none of those that the user named.
fn unknown(inputs: &Inputs<'_>, built: &[BuiltClass<'_>]) -> Vec<Fault> {
    if inputs.versions.is_empty() {
        return is_unknown(built)
            .then(|| unknown_class(inputs.config, built.iter().find_map(gap)))
            .into_iter()
            .collect();
    }
    let for_version = |version: &String| {
        let fault = match built.iter().find(|one| one.target.versions.contains(version)) {
            Some(found) => unknown_class(inputs.config, Some(gap(found)?)),
            None => unknown_class(inputs.config, None),
        };
        Some(fault.with("under", format!("transformers {version}")))
    };
    inputs.versions.iter().filter_map(for_version).collect()
}

/// The pointer into config.json of what is unknown of a class, and its description.
fn gap(one: &BuiltClass<'_>) -> Option<(String, String)> {
    let pointer = match one.class.as_ref().err()? {
        Refusal::UnknownPart(part) if part.config.is_empty() => "/model_type".to_owned(),
        Refusal::UnknownPart(part) => format!("/{}/model_type", part.config.replace('.', "/")),
        Refusal::NotCovered(doubts) => {
            doubts.iter().find_map(Doubt::pointer).unwrap_or_else(|| "/model_type".to_owned())
        }
        _ => return None,
    };
    Some((pointer, one.class.as_ref().err()?.to_string()))
}

fn unknown_class(config: &Value, gap: Option<(String, String)>) -> Fault {
    let text = |pointer: &str| config.pointer(pointer).and_then(Value::as_str).unwrap_or("none");
    let (pointer, part) = gap.map_or(("/model_type".to_owned(), None), |(pointer, part)| (pointer, Some(part)));
    let fault = Fault::new(FaultKind::UnknownArchitecture)
        .at(Place::file(files::CONFIG).pointer(pointer))
        .with("model_type", text("/model_type"))
        .with("class", text("/architectures/0"));
    part.into_iter().fold(fault, |fault, part| fault.with("part", part))
}
