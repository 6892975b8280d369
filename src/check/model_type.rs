//! How `AutoConfig` takes the class of config.json: by `model_type`.
//!
//! Source: `AutoConfig.from_pretrained` of transformers 4.47.0, 4.57.6 and 5.23.0. Code of the directory
//! (`auto_map.AutoConfig`) is preferred to the mapping.

use crate::checkpoint::files;
use serde_json::Value;

use super::load::Target;
use super::view::{Asked, VersionsView};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, escape};
use crate::knowledge::Knowledge;
use crate::knowledge::names::NameKind;

/// Characters of a value that a message shows.
pub(super) const CAP: usize = 80;

/// A value for a message: the start of a string, and the kind of an array or object.
pub(super) fn short(value: &Value) -> Value {
    match value {
        Value::String(text) => escape(text, CAP).into(),
        Value::Array(_) => "an array".into(),
        Value::Object(_) => "an object".into(),
        other => other.clone(),
    }
}

/// The class that config.json names, or else the one that `AutoModel` builds.
pub(super) fn class_of<'k>(knowledge: &'k Knowledge, config: &'k Value, target: &Target) -> Option<&'k str> {
    let auto = || {
        let model_type = config.get("model_type").and_then(Value::as_str)?;
        knowledge.library.auto_class(model_type, "model", target.loader)
    };
    knowledge.library.named_class(config).or_else(auto)
}

/// Whether config.json is one of transformers: that of timm, diffusers or `LeRobot` names no model type and no class, and that of
/// a sentence encoder whose own module is a table of embeddings is model2vec's.
pub(super) fn is_of_transformers(checkpoint: &Checkpoint) -> bool {
    let has = |key| checkpoint.config().is_some_and(|config| config.get(key).is_some());
    (has("model_type") || has("architectures")) && !has("_class_name") && !is_table(checkpoint)
}

/// Whether modules.json says that sentence-transformers reads this directory itself as a table of embeddings. Source:
/// sentence-transformers 6.2.0, `models/StaticEmbedding.py`.
fn is_table(checkpoint: &Checkpoint) -> bool {
    let modules = checkpoint.document(files::MODULES).and_then(|file| file.value.as_ref()?.as_array());
    modules.into_iter().flatten().any(|module| {
        let text = |key: &str| module.get(key).and_then(Value::as_str).unwrap_or_default();
        matches!(text("path"), "" | "." | "./") && text("type").ends_with(".StaticEmbedding")
    })
}

/// Whether transformers opens the directory as a model; adapters and other libraries have names of their own for weights.
pub(super) fn is_model(checkpoint: &Checkpoint) -> bool {
    is_of_transformers(checkpoint) && !checkpoint.has_file(files::ADAPTER_CONFIG)
}

/// The place of the `model_type` that a class selects a part by, of the fault that the part is unknown.
fn place_of_part(fault: &Fault) -> Option<Place> {
    let is_part = fault.kind == FaultKind::UnknownArchitecture && fault.detail.contains_key("part");
    let is_type = |place: &&Place| place.pointer.as_ref().is_some_and(|pointer| pointer.ends_with("/model_type"));
    fault.places.first().filter(|_| is_part).filter(is_type).cloned()
}

/// Faults of `model_type`, and of the types of parts that no description has, each under the loaders that raise.
pub(super) fn faults(view: &VersionsView<'_>) -> Vec<Fault> {
    let VersionsView { checkpoint, knowledge, asked, of_loads, .. } = *view;
    let asked = &asked;
    let Some(config) = checkpoint.config().filter(|config| is_model(checkpoint) && !has_code(config)) else {
        return Vec::new();
    };
    // Names in a document of another encoding are not those that a loader would read.
    let document = checkpoint.document(files::CONFIG);
    let is_encoded = |f: &Fault| matches!(f.kind, FaultKind::WrongEncoding | FaultKind::InvalidUtf8);
    if document.is_some_and(|document| document.faults.iter().any(is_encoded)) {
        return Vec::new();
    }
    let class = config.pointer("/architectures/0").and_then(Value::as_str);
    let of_class = class.and_then(|class| knowledge.library.model_type_of(class));
    let place = Place::file(files::CONFIG).pointer("/model_type");
    let fault = match config.get("model_type") {
        Some(value) => unknown(knowledge, value, place, asked),
        None => missing(checkpoint, knowledge, of_class, asked.targets),
    };
    let with_class = |fault: Fault| match (class, of_class) {
        (Some(class), Some(model_type)) => fault.with("class", escape(class, CAP)).with("of_class", model_type),
        _ => fault,
    };
    let of_part = |place: Place| {
        let value = config.pointer(place.pointer.as_deref()?)?;
        Some(unknown(knowledge, value, place, asked)?.with("part", true))
    };
    let faults = fault.into_iter().map(with_class).chain(of_loads.iter().filter_map(place_of_part).filter_map(of_part));
    faults.chain(class_of_whole(knowledge, config)).collect()
}

/// The fault of a class that contains the language model which the config describes.
fn class_of_whole(knowledge: &Knowledge, config: &Value) -> Option<Fault> {
    let class = config.pointer("/architectures/0")?.as_str()?;
    let model_type = config.get("model_type")?.as_str()?;
    let classes =
        knowledge.text_types.of(model_type).filter(|classes| classes.whole.iter().any(|name| name == class))?;
    let fault = Fault::new(FaultKind::ClassOfWholeModel).at(Place::file(files::CONFIG).pointer("/architectures/0"));
    Some(fault.with("class", class).with("model_type", model_type).with("own", classes.own.as_str()))
}

/// Whether the config class is code beside the weights or in another repository.
pub(super) fn has_code(config: &Value) -> bool {
    config.pointer("/auto_map/AutoConfig").is_some()
}

/// The fault of a `model_type` that loaders lack. Types that only an architecture file describes belong to packages that
/// register them, such as that of LLaVA-3D.
fn unknown(knowledge: &Knowledge, value: &Value, place: Place, asked: &Asked<'_>) -> Option<Fault> {
    let names = &knowledge.names;
    let name = value.as_str().unwrap_or_default();
    if !names.contains(NameKind::ModelType, name) && knowledge.library.describes(name) {
        return None;
    }
    let lacking = asked.lacking(names, NameKind::ModelType, name);
    if lacking.is_empty() {
        return None;
    }
    let versions: Vec<&str> = lacking.iter().map(|target| target.version()).collect();
    // The rule tells lists and dicts, which are not hashable, from other values.
    let shown = match value {
        Value::Array(_) => Value::Array(Vec::new()),
        Value::Object(_) => Value::Object(serde_json::Map::new()),
        other => short(other),
    };
    let fault = Fault::new(FaultKind::ModelTypeUnknown).at(place).with("model_type", shown).with("versions", versions);
    let fault = names
        .similar(NameKind::ModelType, name)
        .into_iter()
        .fold(fault, |fault, similar| fault.with("similar", similar));
    Some(fault.under_all(lacking.into_iter().map(|target| target.loader.version())))
}

/// The fault of a config without `model_type`. transformers 4 takes a type that occurs in the path; only the last
/// component is known here.
fn missing(
    checkpoint: &Checkpoint,
    knowledge: &Knowledge,
    of_class: Option<&str>,
    targets: &[Target],
) -> Option<Fault> {
    let directory = checkpoint.source.path().file_name();
    let directory = directory.map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let old = targets.iter().find(|target| target.loader.major() < 5);
    let guess = old.and_then(|target| knowledge.names.model_type_in(target.version(), &directory));
    let raising = targets.iter().filter(|t| t.loader.major() >= 5 || guess.is_none() || guess != of_class);
    let raising: Vec<_> = raising.map(|target| target.loader.version()).collect();
    if raising.is_empty() {
        return None;
    }
    let fault = Fault::new(FaultKind::ModelTypeMissing).at(Place::file(files::CONFIG)).with("directory", directory);
    let fault = guess.into_iter().fold(fault, |fault, guess| fault.with("guess", guess));
    Some(fault.under_all(raising))
}
