//! What `AutoImageProcessor` and `AutoFeatureExtractor` do with `preprocessor_config.json`.
//!
//! Source: `from_pretrained` of the two in transformers 4.47.0, 4.57.6 and 5.23.0. Which values the classes refuse is derived by
//! trying them.

use serde_json::{Map, Value};

use super::class_names::has_code;
use super::judged::{JudgedFiles, observed};
use super::model_type::{CAP, has_code as has_config_code};
use super::processor::nested_part;
use super::view::{Observation, VersionsView};
use crate::checkpoint::files::{self, Object};
use crate::checkpoint::{Checkpoint, Document, Fault, FaultKind, escape, pointer};
use crate::knowledge::classes::ClassKind;
use crate::knowledge::names::NameKind;
use crate::knowledge::{Knowledge, Loader};

/// Faults of refused values, each under the loaders that raise, and for each loader whether everything was judged.
pub(super) fn observe(view: &VersionsView<'_>) -> Observation {
    let VersionsView { checkpoint, knowledge, asked, .. } = *view;
    let Some(document) = checkpoint.document(files::PREPROCESSOR_CONFIG) else { return Observation::default() };
    observed(asked.targets, Object::Processor, |loader| judged(checkpoint, knowledge, loader, document))
}

/// What a known version does with the file, or why that is not known.
fn judged(
    checkpoint: &Checkpoint,
    knowledge: &Knowledge,
    loader: Loader,
    document: &Document,
) -> Result<JudgedFiles, String> {
    let file = files::PREPROCESSOR_CONFIG;
    let settings = document.value.as_ref().and_then(Value::as_object);
    let Some(settings) = settings.filter(|_| document.faults.iter().all(Fault::is_read_by_python)) else {
        return Err(format!("{file} has no values that were read"));
    };
    let named = class_named(settings);
    if settings.contains_key("auto_map") || has_code(checkpoint, &[files::CONFIG], &AUTO) {
        return Err("its class is code beside the weights".to_owned());
    }
    if named.is_none() && checkpoint.config().is_some_and(has_config_code) {
        return Err(format!("{} is of a class that is code beside the weights", files::CONFIG));
    }
    if nested_part(checkpoint).is_some() && loader.release() >= 457 {
        return Err(format!("{} has settings of a part, too", files::PROCESSOR_CONFIG));
    }
    let text = |file: &str, at: &str| checkpoint.document(file)?.get(at)?.as_str();
    let model_type = text(files::CONFIG, "/model_type");
    let of_processor = OF_PROCESSOR.into_iter().find_map(|file| text(file, "/processor_class"));
    let known = knowledge.preprocessors.of(loader.version());
    let Some(class) = known.and_then(|known| known.opened(settings, model_type)) else {
        return Err(format!("which class opens {file} is not known"));
    };
    let kind = named.map_or(class.kind, |(kind, _)| kind);
    if !knowledge.classes.reads(loader.version(), kind, of_processor, model_type) {
        return Err("the processor opens a class of its own".to_owned());
    }
    // The same in all versions, whatever each opens in its place.
    let label = named.and_then(|(_, class)| class.as_str()).unwrap_or_else(|| class.kind.auto());
    let mut found = JudgedFiles::new(FaultKind::PreprocessorSettingRefused, escape(label, CAP));
    for key in class.keys().filter(|key| !settings.contains_key(*key)) {
        found.value(class.given(key, None), class.name, file, &pointer::join("", key), None);
    }
    let mut alone = 0_usize;
    for (key, value) in settings.iter().filter(|(key, _)| !NAMES.contains(&key.as_str())) {
        alone = alone.saturating_add(class.is_tried_alone(key, value).into());
        found.value(class.given(key, Some(value)), class.name, file, &pointer::join("", key), Some(value));
    }
    if alone > 1 {
        found.doubt(format!("whether {} takes {alone} unusual values together is not known", class.name));
    }
    if checkpoint.document(files::CONFIG).is_some_and(|config| config.get("/pretrained_cfg").is_some()) {
        found.doubt(format!("{} has the settings of images in some versions", files::CONFIG));
    }
    let is_of_processor = of_processor.is_some()
        || checkpoint.has_file(files::PROCESSOR_CONFIG)
        || checkpoint.has_file(files::VIDEO_PREPROCESSOR_CONFIG)
        || model_type.is_some_and(|name| !knowledge.names.lacks(loader.version(), NameKind::Processor, name));
    if is_of_processor {
        found.doubt("what the processor does with its parts is not known".to_owned());
    }
    Ok(found)
}

/// The keys that name the class.
const NAMES: [&str; 2] = [ClassKind::ImageProcessor.key(), ClassKind::FeatureExtractor.key()];

/// The Auto classes whose name in `auto_map` has the code of a repository opened.
const AUTO: [&str; 3] =
    [ClassKind::ImageProcessor.auto(), ClassKind::FeatureExtractor.auto(), ClassKind::Processor.auto()];

/// The files that name the class of a processor.
const OF_PROCESSOR: [&str; 4] =
    [files::PROCESSOR_CONFIG, files::PREPROCESSOR_CONFIG, files::TOKENIZER_CONFIG, files::CONFIG];

/// What the settings name as their class, and of what kind it is.
pub(super) fn class_named(settings: &Map<String, Value>) -> Option<(ClassKind, &Value)> {
    [ClassKind::ImageProcessor, ClassKind::FeatureExtractor].into_iter().find_map(|kind| {
        let named = settings.get(kind.key()).filter(|value| !value.is_null())?;
        Some((kind, named))
    })
}
