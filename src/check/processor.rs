//! The files of a processor against the model: values that follow from config.json, the file of the image processor, and
//! the tokens that stand for images.

use crate::checkpoint::files;
use std::collections::BTreeMap;

use serde_json::{Map, Value, json};

use super::class_names::has_code;
use super::load::Target;
use super::model_type::is_model;
use super::tokens::OpenedTokenizer;
use super::view::{Asked, VersionsView};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::classes::ClassKind;
use crate::knowledge::loader::version_numbers;
use crate::knowledge::names::NameKind;
use crate::knowledge::processor::{Placeholder, Processor, ReadValue};
use crate::knowledge::{Knowledge, Scope};

/// Parts of a processor whose settings transformers 5 writes into [`files::PROCESSOR_CONFIG`].
const PARTS: [&str; 3] = ["image_processor", "feature_extractor", "video_processor"];

/// Faults of the processor's files, each under the loaders that have it.
pub(super) fn faults(view: &VersionsView<'_>) -> Vec<Fault> {
    let VersionsView { checkpoint, knowledge, ref asked, of_class: processor, model, .. } = *view;
    // Weights alone, without a tokenizer, are no directory that a processor is opened from.
    if !is_model(checkpoint) || checkpoint.tokenizer.files.is_empty() || is_code(checkpoint) {
        return Vec::new();
    }
    if let Some(missing) = missing_file(checkpoint, knowledge, asked) {
        return vec![missing];
    }
    processor.map_or_else(Vec::new, |processor| values(checkpoint, asked.targets, processor, model))
}

/// Whether the processor is code beside the weights or in another repository.
fn is_code(checkpoint: &Checkpoint) -> bool {
    let auto = [ClassKind::Processor, ClassKind::ImageProcessor, ClassKind::FeatureExtractor].map(ClassKind::auto);
    has_code(
        checkpoint,
        &[files::CONFIG, files::PROCESSOR_CONFIG, files::PREPROCESSOR_CONFIG, files::TOKENIZER_CONFIG],
        &auto,
    )
}

fn value<'c>(checkpoint: &'c Checkpoint, file: &str, pointer: &str) -> Option<&'c Value> {
    checkpoint.document(file)?.get(pointer)
}

/// The part whose settings stand in `processor_config.json`.
pub(super) fn nested_part(checkpoint: &Checkpoint) -> Option<&'static str> {
    PARTS
        .into_iter()
        .find(|part| value(checkpoint, files::PROCESSOR_CONFIG, &format!("/{part}")).is_some_and(Value::is_object))
}

/// The fault of a class that takes images or sound without the file of its image processor or feature extractor.
///
/// Source: `AutoProcessor`, `AutoImageProcessor` and `AutoFeatureExtractor` of transformers 4.47.0, 4.57.6 and 5.23.0, run.
fn missing_file(checkpoint: &Checkpoint, knowledge: &Knowledge, asked: &Asked<'_>) -> Option<Fault> {
    let class = value(checkpoint, files::CONFIG, "/architectures/0")?.as_str()?;
    let model_type = value(checkpoint, files::CONFIG, "/model_type")?.as_str()?;
    // Other heads, and towers alone, are used without a processor.
    let is_of_processor = ["ForConditionalGeneration", "ForCTC"].iter().any(|end| class.ends_with(end));
    if checkpoint.entries.contains_key(files::PREPROCESSOR_CONFIG) || !is_of_processor {
        return None;
    }
    let nested = nested_part(checkpoint);
    let has_processor = |target: &&Target| {
        !knowledge.names.lacks(target.version(), NameKind::Processor, model_type)
            && knowledge.names.contains(NameKind::Processor, model_type)
    };
    let raises = |target: &&Target| nested.is_none() || version_numbers(target.version()) < vec![4, 57];
    let targets: Vec<&Target> = asked.targets.iter().filter(has_processor).filter(raises).collect();
    let fault = Fault::new(FaultKind::ProcessorFileMissing)
        .at(nested.map_or_else(
            || Place::file(files::PREPROCESSOR_CONFIG),
            |part| Place::file(files::PROCESSOR_CONFIG).pointer(format!("/{part}")),
        ))
        .with("class", class)
        .with("nested", nested)
        .with("has_processor_config", checkpoint.entries.contains_key(files::PROCESSOR_CONFIG))
        .with("content", nested.and_then(|part| with_class(checkpoint, part)));
    (!targets.is_empty()).then(|| fault.under_all(targets.into_iter().map(|target| target.loader.version())))
}

/// The settings of a nested part as `preprocessor_config.json` holds them, with the class of the processor.
fn with_class(checkpoint: &Checkpoint, part: &str) -> Option<Value> {
    let mut settings = value(checkpoint, files::PROCESSOR_CONFIG, &format!("/{part}"))?.clone();
    let class = value(checkpoint, files::PROCESSOR_CONFIG, "/processor_class")?.clone();
    settings.as_object_mut()?.insert("processor_class".to_owned(), class);
    Some(settings)
}

/// A value of a file that does not fit the model.
struct Misfit {
    file: String,
    pointer: String,
    found: Option<Value>,
    needed: Value,
    because: String,
    wrong: String,
}

/// Values of the processor's files that do not fit the model: one fault for the missing ones of each file, and one for each
/// other value.
fn values(checkpoint: &Checkpoint, targets: &[Target], processor: &Processor, model: &Value) -> Vec<Fault> {
    let named = [files::PROCESSOR_CONFIG, files::PREPROCESSOR_CONFIG, files::TOKENIZER_CONFIG]
        .into_iter()
        .find_map(|file| value(checkpoint, file, "/processor_class")?.as_str());
    if processor.class.as_deref().zip(named).is_some_and(|(class, named)| class != named) {
        return Vec::new();
    }
    let Some(settings) = Settings::new(checkpoint) else { return Vec::new() };
    let scope = settings.scope(processor, model);
    let mut faults: Vec<Fault> = Vec::new();
    for target in targets {
        let entries = processor.reads.iter().filter(|entry| entry.loaders.contains(target.version()));
        let misfits: Vec<Misfit> = entries.filter_map(|entry| misfit(&settings, entry, &scope)).collect();
        let (missing, other): (Vec<Misfit>, Vec<Misfit>) = misfits.into_iter().partition(|one| one.found.is_none());
        let mut by_file: BTreeMap<String, Vec<Misfit>> = BTreeMap::new();
        for one in missing {
            by_file.entry(one.file.clone()).or_default().push(one);
        }
        let of_files = by_file.into_iter().filter_map(|(file, missing)| absent_values(checkpoint, &file, &missing));
        for fault in of_files.chain(other.into_iter().map(Misfit::fault)) {
            fault.join(&mut faults, target.loader.version());
        }
    }
    faults
}

/// The documents of a processor: those of the image processor may stand in `processor_config.json`.
struct Settings<'c> {
    checkpoint: &'c Checkpoint,
    /// File and pointer of the settings of the image processor.
    images: (&'static str, String),
}

impl<'c> Settings<'c> {
    /// `None` when the settings of the image processor are in two files, or in none.
    fn new(checkpoint: &'c Checkpoint) -> Option<Self> {
        let nested = nested_part(checkpoint).filter(|part| *part != "video_processor");
        let images = match (checkpoint.entries.contains_key(files::PREPROCESSOR_CONFIG), nested) {
            (true, None) => (files::PREPROCESSOR_CONFIG, String::new()),
            (false, Some(part)) => (files::PROCESSOR_CONFIG, format!("/{part}")),
            _ => return None,
        };
        let settings = Self { checkpoint, images };
        // A document that cannot be read has a fault of its own.
        let is_read = |file: &str| checkpoint.document(file).is_none_or(|document| document.value.is_some());
        let is_complete = is_read(files::PROCESSOR_CONFIG)
            && is_read(files::PREPROCESSOR_CONFIG)
            && settings.image_processor().is_some();
        is_complete.then_some(settings)
    }

    fn image_processor(&self) -> Option<&'c Value> {
        value(self.checkpoint, self.images.0, &self.images.1)
    }

    /// File and pointer at which a value of the file is read.
    fn place(&self, file: &str, at: &str) -> (String, String) {
        match file {
            files::PREPROCESSOR_CONFIG => (self.images.0.to_owned(), format!("{}{at}", self.images.1)),
            _ => (file.to_owned(), at.to_owned()),
        }
    }

    fn scope(&self, processor: &Processor, model: &Value) -> Scope<'static> {
        let mut scope = Scope::new();
        scope.bind("model", model);
        scope.bind("preprocessor", self.image_processor().unwrap_or(&Value::Null));
        scope.bind("processor", value(self.checkpoint, files::PROCESSOR_CONFIG, "").unwrap_or(&json!({})));
        for item in &processor.facts {
            // An entry that needs a value that the config lacks is not judged.
            if let Ok(value) = item.is.eval(&scope) {
                scope.bind(&item.name, &value);
            }
        }
        scope
    }
}

/// What an entry says of the checkpoint; `None` when the value fits, or cannot be judged.
fn misfit(settings: &Settings<'_>, entry: &ReadValue, scope: &Scope<'_>) -> Option<Misfit> {
    if !entry.when.as_ref().is_none_or(|when| when.eval_bool(scope).unwrap_or(false)) {
        return None;
    }
    let (file, pointer) = settings.place(&entry.file, &entry.at);
    let found = value(settings.checkpoint, &file, &pointer).filter(|found| !found.is_null()).cloned();
    let needed = entry.is.eval(scope).ok().filter(|needed| !needed.is_null())?;
    let read = match (&found, &entry.absent) {
        (Some(found), _) => found.clone(),
        (None, Some(absent)) => absent.eval(scope).ok()?,
        (None, None) => return None,
    };
    let because = entry.because.try_render(scope).ok()?;
    let wrong = entry.wrong.try_render(scope).ok()?;
    (read != needed).then_some(Misfit { file, pointer, found, needed, because, wrong })
}

/// The fault of values that a file lacks, or that a missing file would hold.
fn absent_values(checkpoint: &Checkpoint, file: &str, missing: &[Misfit]) -> Option<Fault> {
    let first = missing.first()?;
    let keys: Vec<&str> = missing.iter().map(|one| one.pointer.trim_start_matches('/')).collect();
    let exists = checkpoint.document(file).is_some();
    let content: Map<String, Value> =
        missing.iter().map(|one| (one.pointer.trim_start_matches('/').to_owned(), one.needed.clone())).collect();
    let listed: Vec<Value> = missing
        .iter()
        .map(|one| json!({ "key": one.pointer.trim_start_matches('/'), "pointer": one.pointer, "needed": one.needed }))
        .collect();
    let because: Vec<&str> = missing.iter().map(|one| one.because.as_str()).collect();
    // The file itself is the place when it has none of the keys.
    let fault = Fault::new(FaultKind::ProcessorValueMissing).at(Place::file(file));
    Some(
        fault
            .with("keys", keys)
            .with("values", listed)
            .with("content", (!exists).then_some(content))
            .with("because", because)
            .with("wrong", first.wrong.as_str()),
    )
}

impl Misfit {
    fn fault(self) -> Fault {
        Fault::new(FaultKind::ProcessorValueDiffers)
            .with("key", self.pointer.trim_start_matches('/').replace('/', "."))
            .with("found", self.found)
            .with("needed", self.needed)
            .with("because", self.because)
            .with("wrong", self.wrong)
            .at(Place::file(self.file).pointer(self.pointer))
    }
}

/// The value of `missing_attributes` in expressions: attributes that the processor of transformers 4 reads and the
/// tokenizer does not have, with the text of each token.
pub(super) fn missing_attributes(checkpoint: &Checkpoint, processor: Option<&Processor>) -> Value {
    // A list, as transformers 5 writes it, has a rule of its own.
    let extra = value(checkpoint, files::TOKENIZER_CONFIG, "/extra_special_tokens");
    if extra.is_some_and(|extra| !extra.is_object()) || checkpoint.document(files::TOKENIZER_CONFIG).is_none() {
        return Value::Array(Vec::new());
    }
    let is_missing = |name: &str| extra.is_none_or(|extra| extra.get(name).is_none());
    let missing = processor.iter().flat_map(|one| &one.attributes).filter(|(name, _)| is_missing(name));
    // transformers 5 also takes attributes from the keys of the document itself.
    let at_top = |name: &str| value(checkpoint, files::TOKENIZER_CONFIG, &format!("/{name}")).is_some();
    missing.map(|(name, content)| json!({ "name": name, "content": content, "at_top": at_top(name) })).collect()
}

/// The value of `placeholders` in expressions: for each token that stands for images or videos its key in config.json, the
/// id there, its text, its id in the tokenizer, and whether the model embeds another token in its place.
pub(super) fn placeholders(
    checkpoint: &Checkpoint,
    processor: Option<&Processor>,
    opened: Option<&OpenedTokenizer>,
) -> Value {
    let of_config = |placeholder: &Placeholder| {
        let key = placeholder.keys.iter().find(|key| value(checkpoint, files::CONFIG, &format!("/{key}")).is_some())?;
        let id = value(checkpoint, files::CONFIG, &format!("/{key}"))?.as_i64()?;
        let content = placeholder.named_by.as_ref().and_then(|name| {
            let places = [
                (files::TOKENIZER_CONFIG, "/"),
                (files::TOKENIZER_CONFIG, "/extra_special_tokens/"),
                (files::PROCESSOR_CONFIG, "/"),
            ];
            places.into_iter().find_map(|(file, start)| value(checkpoint, file, &format!("{start}{name}"))?.as_str())
        });
        let content = content.unwrap_or(&placeholder.content);
        let new = opened.and_then(|opened| opened.new.iter().find(|(_, token)| token.content == content));
        let of_tokenizer = checkpoint.tokenizer.id_of(content).or(new.map(|(id, _)| *id));
        let replaced = placeholder.is_replaced;
        Some(json!({ "key": key, "id": id, "content": content, "of_tokenizer": of_tokenizer, "is_replaced": replaced }))
    };
    let list: Vec<Value> = processor.iter().flat_map(|one| &one.placeholders).filter_map(of_config).collect();
    list.into()
}
