//! The Python code that loads a result, from its documents.

use crate::checkpoint::files;
use serde_json::Value;

use super::draft::MergeDraft;
use crate::check::modules::local_class;
use crate::checkpoint::Document;
use crate::checkpoint::module::is_dotted_name;
use crate::knowledge::recipe::AUTO_MAP;

/// Auto classes for models, the most specific one first.
const MODELS: [&str; 5] = [
    "AutoModelForImageTextToText",
    "AutoModelForVision2Seq",
    "AutoModelForCausalLM",
    "AutoModelForSeq2SeqLM",
    "AutoModel",
];

/// Documents in which `auto_map` may name a processor.
const PROCESSOR_DOCUMENTS: [&str; 2] = [files::PROCESSOR_CONFIG, files::PREPROCESSOR_CONFIG];

/// How a result is loaded: its class and the class of its processor or tokenizer.
#[derive(Debug, Clone, Default)]
pub(super) struct Usage {
    model: Option<Loaded>,
    processor: Option<Loaded>,
    /// Whether a document has a chat template.
    has_template: bool,
}

/// A class of transformers that loads a part of the result.
#[derive(Debug, Clone)]
struct Loaded {
    variable: &'static str,
    class: String,
    /// Whether modules of the result are run.
    has_code: bool,
}

impl Usage {
    /// Reads the classes from the documents of a draft.
    pub(super) fn find(draft: &MergeDraft) -> Self {
        let document = |name: &str| draft.documents.iter().find(|document| document.name == name);
        let has = |test: fn(&str) -> bool| draft.plan.files.iter().any(|file| test(&file.name));
        let processor = PROCESSOR_DOCUMENTS.iter().filter_map(|name| document(name)).collect::<Vec<_>>();
        let tokenizer =
            has(|name| name.starts_with("tokenizer") || name == files::VOCAB_JSON || name == files::SPIECE_MODEL);
        let coded = processor.iter().any(|document| auto_class(document, "AutoProcessor"));
        let processor = match (processor.is_empty(), tokenizer) {
            (false, _) => Some(Loaded { variable: "processor", class: "AutoProcessor".to_owned(), has_code: coded }),
            (true, true) => {
                let coded = document(files::TOKENIZER_CONFIG).is_some_and(|d| auto_class(d, "AutoTokenizer"));
                Some(Loaded { variable: "tokenizer", class: "AutoTokenizer".to_owned(), has_code: coded })
            }
            (true, false) => None,
        };
        let of_tokenizer = document(files::TOKENIZER_CONFIG)
            .is_some_and(|d| d.get("/chat_template").is_some_and(|template| !template.is_null()));
        let has_template =
            of_tokenizer || has(|name| name == files::CHAT_TEMPLATE || name == files::CHAT_TEMPLATE_JSON);
        Self { model: document(files::CONFIG).and_then(model), processor, has_template }
    }

    /// The statements that load the result from `dir`; empty without a known class.
    pub(super) fn statements(&self, dir: &str) -> Vec<String> {
        let Some(model) = &self.model else { return Vec::new() };
        let parts: Vec<&Loaded> = [Some(model), self.processor.as_ref()].into_iter().flatten().collect();
        let classes: Vec<&str> = parts.iter().map(|part| part.class.as_str()).collect();
        let mut out = vec![format!("from transformers import {}", classes.join(", "))];
        // A JSON string is a Python string.
        let dir = Value::from(dir);
        out.extend(parts.iter().map(|part| {
            let dtype = if part.variable == "model" { ", torch_dtype=\"auto\"" } else { "" };
            let code = if part.has_code { ", trust_remote_code=True" } else { "" };
            format!("{} = {}.from_pretrained({dir}{dtype}{code})", part.variable, part.class)
        }));
        out
    }
}

/// What a prompt asks in the statements of a report.
const QUESTION: &str = "What is in the picture?";

impl Usage {
    /// The statements that ask the result about a picture; empty unless a processor takes one. `turn` is what its prompts have for
    /// an image: nothing where the processor puts its tokens in front.
    pub(super) fn prompt(&self, turn: Option<&str>) -> Vec<String> {
        let (Some(processor), Some(turn)) = (&self.processor, turn) else { return Vec::new() };
        if processor.variable != "processor" || self.model.is_none() {
            return Vec::new();
        }
        let mut out = vec!["from PIL import Image".to_owned(), "image = Image.open(\"picture.png\")".to_owned()];
        if self.has_template {
            let question = Value::from(QUESTION);
            out.push(format!(
                "chat = [{{\"role\": \"user\", \"content\": [{{\"type\": \"image\"}}, {{\"type\": \"text\", \"text\": {question}}}]}}]"
            ));
            out.push("text = processor.apply_chat_template(chat, add_generation_prompt=True)".to_owned());
        } else {
            // A JSON string is a Python string.
            out.push(format!("text = {}", Value::from([turn, QUESTION].concat())));
        }
        out.push("inputs = processor(images=image, text=text, return_tensors=\"pt\").to(model.dtype)".to_owned());
        out.push("output = model.generate(**inputs, max_new_tokens=20)".to_owned());
        out
    }
}

/// The class of the model: an auto class if the result has code for it, otherwise the class that the config names.
fn model(config: &Document) -> Option<Loaded> {
    let loaded = |class: &str, has_code| Loaded { variable: "model", class: class.to_owned(), has_code };
    if let Some(auto) = MODELS.into_iter().find(|auto| auto_class(config, auto)) {
        return Some(loaded(auto, true));
    }
    let class = config.get("/architectures/0")?.as_str()?;
    (is_dotted_name(class) && !class.contains('.')).then(|| loaded(class, false))
}

/// Whether `auto_map` of a document names a class of the result for this auto class.
fn auto_class(document: &Document, auto: &str) -> bool {
    let entry = document.get(&format!("/{AUTO_MAP}/{auto}"));
    let first = entry.and_then(|entry| entry.as_array().map_or(Some(entry), |list| list.iter().find(|e| !e.is_null())));
    first.and_then(Value::as_str).is_some_and(|target| local_class(target).is_some())
}
