//! The variables and functions of a checkpoint for the expressions of rules. [`declared`] lists all of them.

use crate::checkpoint::files;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use serde_json::{Map, Value, json};

pub(super) mod declared;

#[cfg(feature = "internals")]
pub use declared::{FUNCTIONS, RuleFunction, VARIABLES, Variable};

use super::load::LoadReport;
use super::tokens::OpenedTokenizer;
use super::{exceptions, index, model_type, modules, templates};
use crate::checkpoint::glob::glob;
use crate::checkpoint::tokenizer::is_vocabulary;
use crate::checkpoint::{Checkpoint, Document, FaultKind, Index, Vocabulary};
use crate::knowledge::{Expression, Scope, lists};

/// Keys of `tokenizer_config.json` that are large; rules reach them through `tokenizer`, `id_of` and `chat_templates`.
const BULKY: [&str; 3] = ["added_tokens_decoder", "additional_special_tokens", "chat_template"];

/// Documents by the name expressions use.
const DOCUMENTS: [(&str, &str); 6] = [
    ("config", files::CONFIG),
    ("generation", files::GENERATION_CONFIG),
    ("processor", files::PROCESSOR_CONFIG),
    ("preprocessor", files::PREPROCESSOR_CONFIG),
    ("tokenizer_config", files::TOKENIZER_CONFIG),
    ("special_tokens", files::SPECIAL_TOKENS),
];

/// The first document that an expression reads and that is missing or invalid.
#[must_use]
pub fn absent(checkpoint: &Checkpoint, expression: &Expression) -> Option<&'static str> {
    let asked = expression.variables();
    let is_absent = |file| checkpoint.document(file).is_none_or(|d| d.value.is_none());
    let mut documents = DOCUMENTS.into_iter().filter(|(name, _)| asked.iter().any(|a| a == name));
    documents.find(|(_, file)| is_absent(file)).map(|(_, file)| file)
}

/// The variables and functions named in [`crate::knowledge::rule::Assert`].
#[must_use]
pub fn scope(
    checkpoint: &Arc<Checkpoint>,
    architecture: Option<&str>,
    model: &Value,
    opened: Option<&OpenedTokenizer>,
    rows: Option<u64>,
) -> Scope<'static> {
    let mut scope = Scope::new();
    bind_documents(&mut scope, checkpoint);
    bind_model(&mut scope, architecture, model);
    scope.bind("tokenizer", &tokenizer(checkpoint));
    scope.bind("chat_templates", &templates::by_file(checkpoint));
    scope.bind("tokens", &opened.map_or(Value::Null, OpenedTokenizer::summary));
    scope.bind("rows", &rows.map_or(Value::Null, Value::from));
    scope.bind("processor_tokenizers", &json!(modules::processor_tokenizers(checkpoint)));
    scope.bind("of_transformers", &json!(model_type::is_of_transformers(checkpoint)));
    bind_directory(&mut scope, checkpoint);
    add_tensor_functions(&mut scope, checkpoint);
    add_file_functions(&mut scope, checkpoint);
    add_loader_functions(&mut scope, checkpoint);
    scope
}

fn bind_documents(scope: &mut Scope<'static>, checkpoint: &Checkpoint) {
    for (name, file) in DOCUMENTS {
        // Of two versions that a merge left in it neither is the document.
        let torn = |d: &&Document| d.faults.iter().any(|f| f.kind == FaultKind::MergeConflictMarker);
        let value = checkpoint.document(file).filter(|d| !torn(d)).and_then(|d| d.value.as_ref());
        match value {
            Some(Value::Object(map)) if name == "tokenizer_config" => {
                let lean: Map<String, Value> = map
                    .iter()
                    .filter(|(k, _)| !BULKY.contains(&k.as_str()))
                    .map(|(k, v)| (k.clone(), v.clone()))
                    .collect();
                scope.bind(name, &Value::Object(lean));
            }
            Some(value) => scope.bind(name, value),
            None => scope.bind(name, &Value::Null),
        }
    }
}

/// The class, and its config with defaults: that of the whole model and of its language model.
fn bind_model(scope: &mut Scope<'static>, architecture: Option<&str>, model: &Value) {
    scope.bind("arch", &json!(architecture.unwrap_or_default()));
    scope.bind("model", model);
    // A flat config of a class with parts has the key with the value null.
    let part = |key: &str| model.get(key).filter(|part| part.is_object());
    let text = part("text_config").or_else(|| part("llm_config")).unwrap_or(model);
    scope.bind("text", text);
}

fn bind_directory(scope: &mut Scope<'static>, checkpoint: &Checkpoint) {
    let name = checkpoint.source.path().file_name().map(|n| n.to_string_lossy().into_owned());
    scope.bind("directory", &json!(name.unwrap_or_default()));
    let has_weights = index::opened_tensors(checkpoint).next().is_some();
    scope.bind("has_weights", &json!(has_weights));
    scope.bind("all_read", &json!(has_weights && index::all_read(checkpoint)));
}

/// Functions that look at tensors which a loader opens.
fn add_tensor_functions(scope: &mut Scope<'static>, checkpoint: &Arc<Checkpoint>) {
    let here = Arc::clone(checkpoint);
    scope
        .function1("shape", move |name| index::opened_tensor(&here, name).map_or(Value::Null, |(_, t)| json!(t.shape)));
    let here = Arc::clone(checkpoint);
    scope.function1("dtype", move |name| {
        index::opened_tensor(&here, name).map_or(Value::Null, |(_, t)| json!(t.dtype.name()))
    });
    let here = Arc::clone(checkpoint);
    scope
        .function1("has_tensor", move |prefix| json!(index::opened_tensors(&here).any(|t| t.name.starts_with(prefix))));
}

/// Functions that look at documents and names.
fn add_file_functions(scope: &mut Scope<'static>, checkpoint: &Arc<Checkpoint>) {
    let here = Arc::clone(checkpoint);
    scope.function1("config_at", move |pointer| {
        here.config().and_then(|c| c.pointer(pointer)).cloned().unwrap_or_default()
    });
    let here = Arc::clone(checkpoint);
    let left = Allowance::new(DOCUMENT_BYTES);
    scope.function1("document", move |name| {
        let Some(document) = here.document(name) else { return Value::Null };
        let cost = document.text.as_ref().map_or(0, |text| text.len());
        if left.take(cost) { document.value.clone().unwrap_or_default() } else { Value::Null }
    });
    let here = Arc::clone(checkpoint);
    let left = Allowance::new(NAMES_MATCHED);
    let count = checkpoint.names().count();
    scope.function1("names", move |pattern| if left.take(count) { names(&here, pattern) } else { Value::Null });
    scope.function("listed", |arguments| match arguments {
        [Value::String(name)] => lists::listed(name).cloned().ok_or_else(|| format!("there is no list `{name}`")),
        _ => Err("listed(name) takes the name of a list".to_owned()),
    });
    let here = Arc::clone(checkpoint);
    scope.function1("is_opened", move |name| json!(index::is_opened(&here, name)));
    let here = Arc::clone(checkpoint);
    scope.function1("is_imported", move |file| json!(modules::is_imported(&here, file)));
    let here = Arc::clone(checkpoint);
    scope.function1("has_file", move |name| json!(here.has_file(name)));
}

/// Functions that tell what a loader does with a file, in its words.
fn add_loader_functions(scope: &mut Scope<'static>, checkpoint: &Arc<Checkpoint>) {
    scope.function2("json_error", |file, reason| json!(exceptions::unparsed(file, reason)));
    scope.function1("utf8_error", |file| json!(exceptions::undecoded(file)));
    scope.function1("python_type", |found| json!(exceptions::python_type(found)));
    let here = Arc::clone(checkpoint);
    scope.function1("is_parsed", move |file| json!(exceptions::is_parsed(&here, file)));
    let here = Arc::clone(checkpoint);
    scope.function1("id_of", move |token| here.tokenizer.id_of(token).map_or(Value::Null, Value::from));
}

/// Bytes of documents that the expressions of one check may get from `document`, for those of hostile size: a rule asks for one
/// again for each of its elements.
const DOCUMENT_BYTES: usize = 64 << 20;
/// Names that `names` compares in one check, for the same reason.
const NAMES_MATCHED: usize = 10_000_000;

/// What is left of a limit on the work of a function. Rules run one after the other, so that its end is always at the same place.
struct Allowance(AtomicUsize);

impl Allowance {
    const fn new(total: usize) -> Self {
        Self(AtomicUsize::new(total))
    }

    /// Takes `cost` from what is left; `false`, and nothing is left, when it is more than that.
    fn take(&self, cost: usize) -> bool {
        let left = self.0.load(Ordering::Relaxed).checked_sub(cost);
        self.0.store(left.unwrap_or(0), Ordering::Relaxed);
        left.is_some()
    }
}

/// The names of entries, and the paths below folders, that match a pattern; those of folders end with `/`.
fn names(checkpoint: &Checkpoint, pattern: &str) -> Value {
    let Ok(pattern) = glob(pattern) else { return Value::Null };
    let mut found: Vec<_> = checkpoint.names().filter(|name| pattern.is_match(name.as_ref())).collect();
    found.sort_unstable();
    json!(found)
}

/// Binds `lost_shards`, and `stays_random` and `complete`, which depend on the predicted loads.
pub fn bind_loads(scope: &mut Scope<'static>, checkpoint: &Checkpoint, loads: &[LoadReport]) {
    // Without a class no load is predicted, and a `total_size` that is too large is the only trace of a lost tensor.
    let stored = || checkpoint.tensors().fold(0_u64, |n, (_, tensor)| n.saturating_add(tensor.len()));
    let stated = checkpoint.index.as_ref().and_then(Index::total_bytes);
    let held = |name: &String| checkpoint.tensor(name).is_some();
    let whole = loads.iter().all(|load| load.missing.iter().all(held) && load.raises.is_none());
    let known = !loads.is_empty() || stated.is_none_or(|stated| stated <= stored());
    scope.bind("lost_shards", &json!(index::lost_shards(checkpoint)));
    scope.bind("complete", &json!(whole && known && index::is_complete(checkpoint)));
    let random: Option<BTreeSet<String>> =
        (!loads.is_empty()).then(|| loads.iter().flat_map(LoadReport::left_random).map(str::to_owned).collect());
    scope.function1("stays_random", move |name| {
        random.as_ref().map_or(Value::Null, |names| json!(names.contains(name)))
    });
}

fn tokenizer(checkpoint: &Checkpoint) -> Value {
    let t = &checkpoint.tokenizer;
    let special = |attribute: &str| {
        let (_, content) = t.special_tokens.iter().find(|(a, _)| a == attribute)?;
        t.id_of(content)
    };
    let entries = |file: &str| t.vocabularies.get(file).map(|v| v.len());
    let stated = t.stated();
    // Of two tokens with the highest id, the added one is the cause.
    let highest = stated.iter().next_back().map(|(id, token)| (*id, Some(*token)));
    let highest = highest.max(t.base().and_then(Vocabulary::max_id).map(|id| (id, None)));
    json!({
        "length": t.length(),
        "base": t.base().map(Vocabulary::len),
        "class": t.tokenizer_class,
        "source": t.source,
        "json_base": entries(files::TOKENIZER),
        "model_base": entries(files::TOKENIZER_MODEL),
        "bos": special("bos_token"),
        "eos": special("eos_token"),
        "pad": special("pad_token"),
        "highest": highest.map(|(id, _)| id),
        "highest_token": highest.and_then(|(_, token)| token),
        "has_vocabulary": checkpoint.entries.keys().any(|name| is_vocabulary(name) && checkpoint.has_file(name)),
    })
}
