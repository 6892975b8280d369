//! What `AutoTokenizer` does with the files of a tokenizer that has a tokenizer.json.
//!
//! Source: `AutoTokenizer.from_pretrained` and the `_from_pretrained` of tokenizers in transformers 4.47.0, 4.57.6 and 5.23.0.
//! Which values the classes refuse is derived by trying them.

use serde_json::{Map, Value};

use super::built_tokenizer::opened_class;
use super::generation::is_truthy;
use super::judged::{JudgedFiles, observed};
use super::model_type::CAP;
use super::tokenizer_json::{self, values};
use super::view::{Observation, VersionsView};
use crate::checkpoint::files::{self, Object};
use crate::checkpoint::tokenizer::Merges;
use crate::checkpoint::{Checkpoint, Document, Fault, FaultKind, Place, escape, pointer};
use crate::knowledge::classes::ClassKind;
use crate::knowledge::tokenizer_config::TokenizerClass;
use crate::knowledge::value_outcome::ValueOutcome;
use crate::knowledge::{Knowledge, Loader};

/// Faults of refused values, each under the loaders that raise, and for each loader whether all values were judged.
pub(super) fn observe(view: &VersionsView<'_>) -> Observation {
    let VersionsView { checkpoint, knowledge, asked, .. } = *view;
    // Other files are not judged.
    let Some(document) = tokenizer_json::document(checkpoint) else { return Observation::default() };
    let is_read = document.value.is_some() && document.faults.iter().all(Fault::is_read_by_python);
    let of_file = is_read.then(|| values::judged(document, checkpoint.tokenizer.base(), &knowledge.tokenizer_values));
    observed(asked.targets, Object::Tokenizer, |loader| match &of_file {
        Some(of_values) => judged(checkpoint, knowledge, loader, document, of_values),
        None => Err(format!("{} has no values that were read", files::TOKENIZER)),
    })
}

/// Whether a key names files, or changes what is opened.
fn opens_otherwise(key: &str, value: &Value) -> bool {
    let is_off = || match value {
        Value::Null | Value::Bool(false) => true,
        Value::Array(list) => list.is_empty(),
        _ => false,
    };
    match key {
        "fast_tokenizer_files" | "tokenizer_file" => true,
        "from_slow" | "init_inputs" => !is_off(),
        "gguf_file" => !value.is_null(),
        _ => false,
    }
}

/// What a known version does with the files of a tokenizer that is opened from tokenizer.json.
fn judged(
    checkpoint: &Checkpoint,
    knowledge: &Knowledge,
    loader: Loader,
    document: &Document,
    of_values: &values::JudgedTokenizer,
) -> Result<JudgedFiles, String> {
    let Some(name) = opened_class(checkpoint, knowledge, loader) else {
        return Err("which class opens it is not known".to_owned());
    };
    let name = escape(&name, CAP);
    let class = checkpoint.tokenizer.tokenizer_class.as_deref();
    let class = class.map_or_else(|| ClassKind::Tokenizer.auto().to_owned(), |class| escape(class, CAP));
    let mut found = JudgedFiles::new(FaultKind::TokenizerSettingRefused, class);
    let known = knowledge.tokenizer_configs.of(loader.version()).and_then(|configs| configs.class(&name));
    let Some(class) = known else {
        return Err(format!("which files {name} opens is not known"));
    };
    found.unknown.clone_from(&of_values.unknown.as_ref().map(|at| format!("whether {at} loads is not known")));
    // A class that builds the tokenizer itself takes the vocabulary without the library.
    let builds = knowledge.tokenizers.of(loader.version()).is_some_and(|built| built.class(&name).is_some());
    let is_own = |fault: &&Fault| {
        let at = fault.places.first().and_then(|place| place.pointer.as_deref()).unwrap_or_default();
        builds && (at.starts_with("/added_tokens") || at.starts_with("/model"))
    };
    if let Some(fault) = of_values.refused.iter().find(is_own) {
        let at = fault.places.first().and_then(|place| place.pointer.as_deref()).unwrap_or_default();
        found.doubt(format!("what {name} does with {at} is not known"));
    }
    found.refused.extend(of_values.refused.iter().filter(|fault| !is_own(fault)).cloned());
    of_vocabulary(&mut found, checkpoint, document, &name, builds);
    for slot in values::PARTS {
        let part = document.get(&format!("/{slot}")).filter(|part| !part.is_null());
        let kind = part.map_or(Some("null"), |part| part.get("type")?.as_str());
        // A type that no version has is another fault, as is a model that a class builds in the place of this one.
        let is_judged = |kind: &&str| slot != "model" || !builds && *kind != "null";
        let Some(kind) = kind.filter(is_judged) else { continue };
        found.value(class.part(&format!("{slot} {kind}")), &name, files::TOKENIZER, &format!("/{slot}"), part);
    }
    let config = checkpoint.document(files::TOKENIZER_CONFIG);
    let empty = Map::new();
    let Some(settings) = config.map_or(Some(&empty), |config| {
        config.value.as_ref().and_then(Value::as_object).filter(|_| config.faults.iter().all(Fault::is_read_by_python))
    }) else {
        found.doubt(format!("{} has no values that were read", files::TOKENIZER_CONFIG));
        return Ok(found);
    };
    of_settings(&mut found, &class, &name, settings, loader);
    if !settings.contains_key("added_tokens_decoder") {
        of_older_files(&mut found, &class, &name, checkpoint, document);
    }
    Ok(found)
}

/// Judges the vocabulary and the merges of tokenizer.json.
fn of_vocabulary(found: &mut JudgedFiles, checkpoint: &Checkpoint, document: &Document, name: &str, builds: bool) {
    let file = files::TOKENIZER;
    let kind = document.get("/model/type").and_then(Value::as_str);
    let tokenizer = &checkpoint.tokenizer;
    let mut refuse = |at: String, key: &str, value: &str| {
        let fault = Fault::new(FaultKind::TokenizerValueRefused).at(Place::file(file).pointer(at)).with("key", key);
        found.refused.push(fault.with("value", value));
    };
    let Some(vocabulary) = document.get("/model/vocab") else { return };
    let is_of_kind = kind.is_none_or(|kind| (kind == "Unigram") == vocabulary.is_array());
    let is_readable = tokenizer.faults.iter().all(|fault| fault.kind != FaultKind::VocabularyMalformed);
    match tokenizer.base() {
        Some(_) if is_of_kind => {}
        None if is_readable && !builds => {
            return refuse("/model/vocab".to_owned(), "vocab", "not a table of tokens");
        }
        _ => return found.doubt(format!("what {name} does with the vocabulary of {file} is not known")),
    }
    if kind.is_some_and(|kind| kind != "BPE") || document.get("/model/merges").is_none() {
        return;
    }
    match tokenizer.merges(document) {
        Merges::Fit => {}
        Merges::Unfit(at) if !builds => {
            let at = format!("/model/merges/{at}");
            let span = document.locate(&at);
            let text = span.and_then(|span| document.text.as_deref()?.get(span)).unwrap_or_default();
            let key = format!("merge {}", escape(text, CAP));
            refuse(at, &key, "no pair of tokens of the vocabulary");
        }
        _ => found.doubt(format!("what {name} does with the merges of {file} is not known")),
    }
}

/// Judges the keys of `tokenizer_config.json`.
fn of_settings(
    found: &mut JudgedFiles,
    class: &TokenizerClass<'_>,
    name: &str,
    settings: &Map<String, Value>,
    loader: Loader,
) {
    let file = files::TOKENIZER_CONFIG;
    for key in class.keys_of_class().filter(|key| !settings.contains_key(*key)) {
        found.value(class.given(key, None), name, file, &pointer::join("", key), None);
    }
    for (key, value) in settings {
        let at = pointer::join("", key);
        let outcome = match key.as_str() {
            // A rule of its own judges names.
            "tokenizer_class" if value.is_string() || value.is_null() => ValueOutcome::Accepted,
            "tokenizer_class" if is_truthy(value) => ValueOutcome::Refused,
            "tokenizer_class" => ValueOutcome::Depends,
            "auto_map" if value.is_object() => ValueOutcome::Accepted,
            "auto_map" => ValueOutcome::Refused,
            "added_tokens_decoder" => {
                of_decoder(found, class, name, value);
                ValueOutcome::Accepted
            }
            // TOK010 reports it.
            "extra_special_tokens" if value.is_array() && loader.major() < 5 => ValueOutcome::Depends,
            key if opens_otherwise(key, value) => ValueOutcome::Depends,
            key => match class.given(key, Some(value)) {
                ValueOutcome::Depends => decided(key, value, settings),
                outcome => outcome,
            },
        };
        found.value(outcome, name, file, &at, Some(value));
    }
}

/// What becomes of a value that others beside it decide.
fn decided(key: &str, value: &Value, settings: &Map<String, Value>) -> ValueOutcome {
    // T5 counts its own additional tokens, where there are any.
    let listed = settings.get("additional_special_tokens").and_then(Value::as_array);
    let own = listed.into_iter().flatten().filter(|token| {
        let text = token.as_str().or_else(|| token.get("content")?.as_str());
        text.is_some_and(|text| text.contains("<extra_id_"))
    });
    match (key, value.as_u64().and_then(|count| usize::try_from(count).ok())) {
        ("extra_ids", Some(count)) if [0, count].contains(&own.count()) => ValueOutcome::Accepted,
        _ => ValueOutcome::Depends,
    }
}

/// Judges the entries of `added_tokens_decoder`.
fn of_decoder(found: &mut JudgedFiles, class: &TokenizerClass<'_>, name: &str, value: &Value) {
    let (file, at) = (files::TOKENIZER_CONFIG, "/added_tokens_decoder");
    let Some(entries) = value.as_object() else {
        return found.value(class.decoder(value), name, file, at, Some(value));
    };
    for (id, token) in entries {
        let at = pointer::join(at, id);
        let is_id = id.parse::<u32>().is_ok() && !id.starts_with('+');
        // Python reads blanks, signs and digits of other scripts as a number, too.
        let is_name = id.is_empty() || id.contains(|c: char| c.is_ascii_alphabetic());
        let outcome = match class.token(token) {
            ValueOutcome::Accepted if is_name => ValueOutcome::Refused,
            ValueOutcome::Accepted if !is_id => ValueOutcome::Depends,
            outcome => outcome,
        };
        found.value(outcome, name, file, &at, Some(token));
    }
}

/// Judges the files that are read where `tokenizer_config.json` has no `added_tokens_decoder`.
fn of_older_files(
    found: &mut JudgedFiles,
    class: &TokenizerClass<'_>,
    name: &str,
    checkpoint: &Checkpoint,
    document: &Document,
) {
    // Python takes the list out of the document, whatever the library reads.
    if document.get("/added_tokens").is_none() {
        found.value(ValueOutcome::Refused, name, files::TOKENIZER, "/added_tokens", None);
    }
    let read = |file: &str| checkpoint.has_file(file).then(|| checkpoint.document(file));
    for file in [files::SPECIAL_TOKENS, files::ADDED_TOKENS] {
        let Some(given) = read(file) else { continue };
        let given = given.filter(|given| given.faults.iter().all(Fault::is_read_by_python));
        let Some(entries) = given.and_then(|given| given.value.as_ref()?.as_object()) else {
            found.doubt(format!("{file} has no values that were read"));
            continue;
        };
        for (key, value) in entries {
            let outcome = if file == files::ADDED_TOKENS {
                if value.is_u64() { ValueOutcome::Accepted } else { ValueOutcome::Depends }
            } else if value.is_object() && key != "extra_special_tokens" {
                class.token(value)
            } else {
                class.given(key, Some(value))
            };
            found.value(outcome, name, file, &pointer::join("", key), Some(value));
        }
    }
}
