//! What a tokenizer class of transformers 5 makes of tokenizer.json: it takes the vocabulary and the merges, and builds the
//! model, the post-processor and the added tokens itself.
//!
//! Source: `AutoTokenizer.from_pretrained` and `TokenizersBackend.convert_to_native_format` of transformers 5.23.0. A class
//! without a constructor of its own, and every class of transformers 4, opens tokenizer.json as it is.

use crate::checkpoint::files;
use std::collections::BTreeSet;

use serde_json::Value;

use super::class_names::has_code;
use super::model_type::CAP;
use super::view::Asked;
use crate::checkpoint::tokenizer::content;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, escape};
use crate::knowledge::classes::ClassKind;
use crate::knowledge::names::NameKind;
use crate::knowledge::tokenizers::{BuiltTokenizer, BuiltTokenizers};
use crate::knowledge::{Knowledge, Loader};

/// The class that opens tokenizer.json as it is, also in the place of classes that are not known.
const BACKEND: &str = "TokenizersBackend";

/// Names of classes in whose place it is opened.
const GENERIC: [&str; 4] = ["TokenizersBackend", "PythonBackend", "PreTrainedTokenizer", "MistralCommonBackend"];

/// Types of models between which a vocabulary gives much the same tokens: both look up whole words.
const OF_WORDS: [&str; 2] = ["WordLevel", "WordPiece"];

/// Depth of sequences of post-processors that is read; each takes two levels of a document, which has at most 127.
const MAX_DEPTH: usize = 64;

/// Tokens before and after text.
type Around<'v> = (Vec<&'v str>, Vec<&'v str>);

/// Faults of tokenizer.json in the hands of such a class. Called by the engine with the targets of the run.
pub(super) fn faults(checkpoint: &Checkpoint, knowledge: &Knowledge, asked: &Asked<'_>) -> Vec<Fault> {
    let mut faults = Vec::new();
    if checkpoint.tokenizer.source.as_deref() != Some(files::TOKENIZER) {
        return faults;
    }
    for target in asked.targets {
        let version = target.loader.version();
        let Some(built) = knowledge.tokenizers.of(version) else { continue };
        let Some((name, class)) = class_of(checkpoint, knowledge, built, version) else { continue };
        let mut found: Vec<Fault> = other_model(checkpoint, class).into_iter().collect();
        // With a model of another type, everything else differs too.
        if found.is_empty() {
            found.extend(dropped_tokens(checkpoint, class));
            let is_new = !knowledge.tokenizers.always_replaces(name);
            found.extend(is_new.then(|| other_around(checkpoint, class)).flatten());
        }
        faults.extend(found.into_iter().map(|fault| fault.with("class", name).under(version)));
    }
    faults
}

/// The class that `AutoTokenizer` of a version opens, if it builds the tokenizer itself; `None` where tokenizer.json is opened as
/// it is, or is not what is opened. A merge compares that of a donor with that of its result.
pub(crate) fn building_class(checkpoint: &Checkpoint, knowledge: &Knowledge, loader: Loader) -> Option<String> {
    if checkpoint.tokenizer.source.as_deref() != Some(files::TOKENIZER) {
        return None;
    }
    let built = knowledge.tokenizers.of(loader.version())?;
    class_of(checkpoint, knowledge, built, loader.version()).map(|(name, _)| name.to_owned())
}

/// The class that `AutoTokenizer` of a loader opens tokenizer.json with; `None` where code of a repository does, or where it is
/// not known. Called for the verdict on the tokenizer.
pub(super) fn opened_class(checkpoint: &Checkpoint, knowledge: &Knowledge, loader: Loader) -> Option<String> {
    let version = loader.version();
    if let Some(built) = knowledge.tokenizers.of(version).filter(|_| loader.major() >= 5) {
        return name_of(checkpoint, knowledge, built, version).map(str::to_owned);
    }
    let text = |file: &str, pointer: &str| checkpoint.document(file)?.get(pointer)?.as_str();
    let named = text(files::TOKENIZER_CONFIG, "/tokenizer_class");
    let with_code: &[&str] =
        if named.is_some() { &[files::TOKENIZER_CONFIG] } else { &[files::TOKENIZER_CONFIG, files::CONFIG] };
    if has_code(checkpoint, with_code, &[ClassKind::Tokenizer.auto()]) {
        return None;
    }
    let of_type = || knowledge.classes.class_of(version, ClassKind::Tokenizer, text(files::CONFIG, "/model_type")?);
    let name = named.or_else(|| text(files::CONFIG, "/tokenizer_class")).or_else(of_type)?;
    let lacks = |name: &str| knowledge.classes.lacks(version, ClassKind::Tokenizer, name);
    let fast = format!("{name}Fast");
    Some(if name.ends_with("Fast") || lacks(&fast) { name.to_owned() } else { fast })
}

/// The class that `AutoTokenizer` opens, if it builds the tokenizer itself.
fn class_of<'k>(
    checkpoint: &'k Checkpoint,
    knowledge: &'k Knowledge,
    built: &'k BuiltTokenizers,
    version: &str,
) -> Option<(&'k str, &'k BuiltTokenizer)> {
    let name = name_of(checkpoint, knowledge, built, version)?;
    built.class(name).map(|class| (name, class))
}

/// The class that `AutoTokenizer` of transformers 5 opens; `None` for code of a repository.
fn name_of<'k>(
    checkpoint: &'k Checkpoint,
    knowledge: &'k Knowledge,
    built: &'k BuiltTokenizers,
    version: &str,
) -> Option<&'k str> {
    let text = |file: &str, pointer: &str| checkpoint.document(file)?.get(pointer)?.as_str();
    let plain = |name: &'k str| name.strip_suffix("Fast").unwrap_or(name);
    if has_code(checkpoint, &[files::TOKENIZER_CONFIG], &[ClassKind::Tokenizer.auto()]) {
        return None;
    }
    let path = text(files::CONFIG, "/_name_or_path").unwrap_or_default().to_lowercase();
    if built.as_is.iter().any(|pattern| pattern.is_match(&path)) {
        return Some(BACKEND);
    }
    let named = text(files::TOKENIZER_CONFIG, "/tokenizer_class")
        .or_else(|| text(files::CONFIG, "/tokenizer_class"))
        .map(plain);
    let model_type = text(files::CONFIG, "/model_type");
    let is_overruled = model_type.is_some_and(|model_type| built.overruled.contains(model_type));
    let own = model_type.and_then(|t| knowledge.classes.class_of(version, ClassKind::Tokenizer, t)).map(plain);
    // Without a named class the one of the config's class is opened.
    let own = own.filter(|_| {
        named.is_some() || !model_type.is_some_and(|t| knowledge.names.lacks(version, NameKind::ModelType, t))
    });
    if named == Some("LlamaTokenizer") && !is_overruled && has_byte_level(checkpoint) {
        return Some(BACKEND);
    }
    let name = match (named, own) {
        (Some(named), Some(own)) if named != own && GENERIC.contains(&own) => BACKEND,
        (Some(named), Some(own)) if named != own && is_overruled => own,
        (named, own) => named.or(own)?,
    };
    let is_unknown = knowledge.classes.lacks(version, ClassKind::Tokenizer, name);
    Some(if is_unknown || GENERIC.contains(&name) { BACKEND } else { name })
}

/// Whether a part of tokenizer.json is byte-level; `AutoTokenizer` then opens it as it is instead of as `LlamaTokenizer`.
fn has_byte_level(checkpoint: &Checkpoint) -> bool {
    fn is_byte_level(part: &Value, depth: usize) -> bool {
        let inner =
            ["pretokenizers", "decoders", "processors", "normalizers"].into_iter().filter_map(|key| part.get(key));
        part.get("type").and_then(Value::as_str) == Some("ByteLevel")
            || depth < MAX_DEPTH
                && inner.filter_map(Value::as_array).flatten().any(|part| is_byte_level(part, depth.saturating_add(1)))
    }
    let Some(document) = checkpoint.document(files::TOKENIZER) else { return false };
    let parts = ["/pre_tokenizer", "/decoder", "/post_processor", "/normalizer"];
    parts.into_iter().filter_map(|pointer| document.get(pointer)).any(|part| is_byte_level(part, 0))
}

/// The fault of a model of another type than the class builds.
fn other_model(checkpoint: &Checkpoint, class: &BuiltTokenizer) -> Option<Fault> {
    let document = checkpoint.document(files::TOKENIZER)?;
    let stored = document.get("/model/type")?.as_str()?;
    let is_alike = |name: &str| OF_WORDS.contains(&name);
    if stored == class.model || (is_alike(stored) && is_alike(&class.model)) {
        return None;
    }
    let fault = Fault::new(FaultKind::TokenizerModelOfOtherType)
        .at(Place::file(files::TOKENIZER).pointer("/model/type"))
        .with("type", escape(stored, CAP))
        .with("model", class.model.as_str());
    Some(match class.raises.get(stored) {
        Some(error) => fault.with("raises", error.as_str()),
        None => fault,
    })
}

/// The fault of added tokens that only tokenizer.json has: the class takes those of `added_tokens_decoder` instead.
fn dropped_tokens(checkpoint: &Checkpoint, class: &BuiltTokenizer) -> Option<Fault> {
    let tokenizer = &checkpoint.tokenizer;
    let decoder = tokenizer.added_tokens_decoder.as_ref()?;
    let base = tokenizer.base()?;
    let mut taken: BTreeSet<&str> = special_values(checkpoint, class).into_iter().collect();
    taken.extend(decoder.iter().map(|token| token.content.as_str()));
    let is_dropped = |token: &str| base.id_of(token).is_none() && !taken.contains(token) && !class.adds.contains(token);
    let added = tokenizer.tokenizer_json_added.as_deref()?;
    let dropped: Vec<_> = added.iter().enumerate().filter(|(_, token)| is_dropped(&token.content)).collect();
    let (at, first) = dropped.first()?;
    let fault = Fault::new(FaultKind::AddedTokensDropped)
        .at(Place::file(files::TOKENIZER).pointer(format!("/added_tokens/{at}")));
    Some(fault.with("token", escape(&first.content, CAP)).with("count", dropped.len()))
}

/// Every special token that the class adds: those that `tokenizer_config.json` names, and its own.
fn special_values<'v>(checkpoint: &'v Checkpoint, class: &'v BuiltTokenizer) -> Vec<&'v str> {
    let config = checkpoint.document(files::TOKENIZER_CONFIG).and_then(|document| document.get("")?.as_object());
    let own = class.special.iter().filter(|(name, _)| config.is_none_or(|config| !config.contains_key(*name)));
    let mut values: Vec<&str> = own.map(|(_, token)| token.as_str()).collect();
    for (key, value) in config.into_iter().flatten() {
        match value {
            Value::Array(list) if key.ends_with("_special_tokens") => values.extend(list.iter().filter_map(content)),
            Value::Object(map) if key == "extra_special_tokens" => values.extend(map.values().filter_map(content)),
            value if key.ends_with("_token") => values.extend(content(value)),
            _ => {}
        }
    }
    values
}

/// The fault of a post-processor that the class replaces by one that writes other tokens.
fn other_around(checkpoint: &Checkpoint, class: &BuiltTokenizer) -> Option<Fault> {
    let config = |key: &str| {
        checkpoint.document(files::TOKENIZER_CONFIG)?.get(&format!("/{key}")).filter(|value| !value.is_null())
    };
    if class.settings.iter().any(|key| config(key).is_some()) {
        return None;
    }
    let part = checkpoint.document(files::TOKENIZER)?.get("/post_processor").unwrap_or(&Value::Null);
    let [before, after] = if part.is_null() { &class.without } else { class.around.as_ref()? };
    let own = (tokens(checkpoint, class, before)?, tokens(checkpoint, class, after)?);
    let stored = around(part, 0)?;
    if own == stored {
        return None;
    }
    let shown = |(before, after): &Around<'_>| {
        let tokens = before.iter().copied().chain(["text"]).chain(after.iter().copied());
        escape(&tokens.collect::<Vec<_>>().join(" "), CAP)
    };
    let fault =
        Fault::new(FaultKind::PostProcessorReplaced).at(Place::file(files::TOKENIZER).pointer("/post_processor"));
    Some(fault.with("stored", shown(&stored)).with("own", shown(&own)))
}

/// The tokens that these attributes have; `None` when one has no token, or a token that the vocabulary lacks.
fn tokens<'v>(checkpoint: &'v Checkpoint, class: &'v BuiltTokenizer, names: &'v [String]) -> Option<Vec<&'v str>> {
    let tokenizer = &checkpoint.tokenizer;
    let of = |name: &'v String| {
        let token = match class.special.get(name) {
            None => name,
            Some(default) => match tokenizer.special_tokens.iter().find(|(attribute, _)| attribute == name) {
                Some((_, token)) => token,
                None if tokenizer.named_special.contains(name) => return None,
                None => default,
            },
        };
        Some(token.as_str()).filter(|token| tokenizer.contains(token))
    };
    names.iter().map(of).collect()
}

/// What a post-processor of tokenizer.json writes around a single text; `None` for a type that is not read.
fn around(part: &Value, depth: usize) -> Option<Around<'_>> {
    let kind = part.get("type").and_then(Value::as_str);
    match kind {
        _ if part.is_null() => Some((Vec::new(), Vec::new())),
        Some("ByteLevel") => Some((Vec::new(), Vec::new())),
        Some("BertProcessing" | "RobertaProcessing") => {
            let token = |key: &str| part.get(key)?.get(0)?.as_str();
            Some((vec![token("cls")?], vec![token("sep")?]))
        }
        Some("TemplateProcessing") => {
            let (mut before, mut after, mut is_after) = (Vec::new(), Vec::new(), false);
            for piece in part.get("single")?.as_array()? {
                let Some(name) = piece.pointer("/SpecialToken/id").and_then(Value::as_str) else {
                    is_after = true;
                    continue;
                };
                let written = part.get("special_tokens")?.get(name)?.get("tokens")?.as_array()?;
                let written = written.iter().map(Value::as_str).collect::<Option<Vec<_>>>()?;
                if is_after { after.extend(written) } else { before.extend(written) }
            }
            Some((before, after)).filter(|_| is_after)
        }
        Some("Sequence") if depth < MAX_DEPTH => {
            let mut whole: Around<'_> = (Vec::new(), Vec::new());
            for inner in part.get("processors")?.as_array()? {
                let (mut before, after) = around(inner, depth.saturating_add(1))?;
                before.append(&mut whole.0);
                whole.0 = before;
                whole.1.extend(after);
            }
            Some(whole)
        }
        _ => None,
    }
}
