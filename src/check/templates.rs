//! Chat templates: their syntax, the token that ends a turn, and the begin-of-sequence token that they write.
//!
//! A template is parsed and rendered as `apply_chat_template` of transformers does it, in a sandbox: it opens nothing, and
//! [`render`] bounds its steps, memory and output. One that uses more than an allow list of syntax, or whose values may grow, is
//! rendered in a process under limits ([`elsewhere`]), or not at all. An error of rendering proves nothing, because templates
//! refuse conversations on purpose, and the engine lacks parts of Jinja2.

use crate::checkpoint::files;
use serde_json::{Map, Value};

use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, escape};

mod elsewhere;
mod render;
mod tame;

use elsewhere::{Away, render_away};
pub use elsewhere::{RenderJob, render_elsewhere};
pub use render::Rendering;
use render::{FUEL, MAX_TEXT, Rendered};

/// Templates of one checkpoint that are read; published ones have at most three.
const MAX_TEMPLATES: usize = 16;

/// Characters of a token or message that a finding shows.
const CAP: usize = 80;

/// A chat template, and its place.
struct Template<'c> {
    text: &'c str,
    file: &'c str,
    /// Where it stands in a JSON document.
    pointer: Option<String>,
    /// Whether it is the one that is used unless a user asks for another.
    is_default: bool,
}

impl Template<'_> {
    fn place(&self) -> Place {
        Place { pointer: self.pointer.clone(), ..Place::file(self.file) }
    }
}

/// The templates that are read.
fn templates(checkpoint: &Checkpoint) -> Vec<Template<'_>> {
    let mut found = listed(checkpoint);
    found.truncate(MAX_TEMPLATES);
    found
}

/// The templates of a checkpoint, and perhaps more than are read: `chat_template.jinja`, and the key of the JSON documents,
/// which may hold a list of named templates. Source: `apply_chat_template` of tokenizers and processors in transformers 4.47.0
/// to 5.23.0.
fn listed(checkpoint: &Checkpoint) -> Vec<Template<'_>> {
    let texts = checkpoint.texts.iter();
    let own = texts.map(|(file, text)| Template { text, file, pointer: None, is_default: true });
    let mut found: Vec<Template<'_>> = own.collect();
    for file in [files::TOKENIZER_CONFIG, files::CHAT_TEMPLATE_JSON, files::PROCESSOR_CONFIG] {
        let Some(value) = checkpoint.document(file).and_then(|document| document.get("/chat_template")) else {
            continue;
        };
        if let Some(text) = value.as_str() {
            found.push(Template { text, file, pointer: Some("/chat_template".to_owned()), is_default: true });
        }
        let items = value.as_array().into_iter().flatten().enumerate();
        let texts = items.filter_map(|(i, item)| Some((i, item, item.get("template")?.as_str()?)));
        for (i, item, text) in texts.take(MAX_TEMPLATES.saturating_add(1)) {
            let pointer = Some(format!("/chat_template/{i}/template"));
            let is_default = item.get("name").and_then(Value::as_str) == Some("default");
            found.push(Template { text, file, pointer, is_default });
        }
    }
    found
}

/// The template that is used unless a user asks for another. Called by a merge for a donor.
pub(crate) fn default_template(checkpoint: &Checkpoint) -> Option<&str> {
    templates(checkpoint).into_iter().find(|template| template.is_default).map(|template| template.text)
}

/// The value of `chat_templates` in expressions: the default template by the file that holds it.
pub(super) fn by_file(checkpoint: &Checkpoint) -> Value {
    let default = templates(checkpoint).into_iter().filter(|template| template.is_default);
    default.map(|template| (template.file.to_owned(), Value::from(template.text.trim()))).collect::<Map<_, _>>().into()
}

/// Faults of chat templates. Called by the engine for each checkpoint.
pub(super) fn faults(checkpoint: &Checkpoint) -> Vec<Fault> {
    let special = checkpoint.tokenizer.special_tokens.iter();
    let special: Vec<(String, String)> = special.map(|(name, token)| (name.clone(), token.clone())).collect();
    let templates = templates(checkpoint);
    let mut faults = Vec::new();
    for (template, rendering) in templates.iter().zip(renderings(&templates, special)) {
        let place = template.place();
        let not_rendered = |kind, reason: String| Fault::new(kind).at(place.clone()).with("reason", reason);
        match rendering {
            Ok(Rendering::Invalid { line, reason }) => {
                let fault = Fault::new(FaultKind::TemplateSyntax).at(place);
                faults.push(fault.with("line", line).with("reason", escape(&reason, CAP)));
            }
            Ok(Rendering::Done(rendered)) => {
                faults.extend(end_of_turn(checkpoint, &rendered, place.clone()));
                faults.extend(second_begin(checkpoint, &rendered, place));
            }
            Ok(Rendering::Refused(reason)) => faults.push(not_rendered(FaultKind::TemplateNotRendered, reason)),
            Ok(Rendering::Unknown) => {}
            Err(reason) => faults.push(not_rendered(FaultKind::TemplateNeedsProcess, reason)),
        }
    }
    faults.extend(listed(checkpoint).get(MAX_TEMPLATES).map(|next| {
        let reason = format!("the files have more than {MAX_TEMPLATES}");
        Fault::new(FaultKind::TemplateNotRendered).at(next.place()).with("reason", reason)
    }));
    faults
}

/// What became of each template, in their order; for one that needs a process where none can be had, the reason.
fn renderings(templates: &[Template<'_>], special: Vec<(String, String)>) -> Vec<Result<Rendering, String>> {
    let judged = templates.iter().map(|template| rendered_here(template.text, &special));
    let (mut results, mut away) = (Vec::new(), Vec::new());
    for (judged, template) in judged.zip(templates) {
        match judged {
            Ok(rendering) => results.push(Some(Ok(rendering))),
            Err(why) => {
                results.push(None);
                away.push((template.text.to_owned(), why));
            }
        }
    }
    let mut away = render_away(away, special).into_iter();
    results.into_iter().map(|known| known.or_else(|| away.next()).unwrap_or(Ok(Rendering::Unknown))).collect()
}

/// Renders a template of the allow list; for any other, why it needs a process of its own.
fn rendered_here(text: &str, special: &[(String, String)]) -> Result<Rendering, Away> {
    if text.len() > MAX_TEXT {
        return Ok(Rendering::Refused(format!("it has {} bytes, more than {MAX_TEXT}", text.len())));
    }
    if let Some(cost) = tame::cost(text) {
        return Err(Away::Costs(cost.reason().to_owned()));
    }
    if let Some(name) = tame::unknown_name(text) {
        return Err(Away::Uses(escape(&name, CAP)));
    }
    match Rendering::of(text, special, FUEL) {
        Rendering::Refused(reason) => Err(Away::Costs(reason)),
        rendering => Ok(rendering),
    }
}

/// What becomes of a template in this process; `None` for one that needs a process of its own. For the fuzz target.
#[cfg(feature = "internals")]
#[must_use]
pub fn rendered_in_process(text: &str) -> Option<Rendering> {
    let special = ["bos_token", "eos_token"].map(|name| (name.to_owned(), format!("<{name}>")));
    rendered_here(text, &special).ok()
}

/// The fault of a template that ends turns with a token at which generation does not stop.
fn end_of_turn(checkpoint: &Checkpoint, rendered: &Rendered, place: Place) -> Option<Fault> {
    let tokenizer = &checkpoint.tokenizer;
    let rest = rendered.after_assistant.trim_start();
    let added = tokenizer.added().iter().filter(|(token, _)| rest.starts_with(token.as_str()));
    let (token, id) = added.filter(|(token, _)| !token.is_empty()).max_by_key(|(token, _)| token.len())?;
    let eos = |file: &'static str| {
        let value = checkpoint.document(file)?.get("/eos_token_id").filter(|value| !value.is_null())?;
        Some((file, ids(value)?))
    };
    let (file, ids) = eos(files::GENERATION_CONFIG).or_else(|| eos(files::CONFIG))?;
    // GEN002 compares the id of the tokenizer's end-of-sequence token.
    let of_tokenizer = tokenizer.special_tokens.iter().find(|(name, _)| name == "eos_token");
    let agrees = of_tokenizer.is_none_or(|(_, eos)| tokenizer.id_of(eos).is_none_or(|id| ids.contains(&id)));
    if ids.contains(id) || !agrees {
        return None;
    }
    let fault = Fault::new(FaultKind::TurnEndsElsewhere).at(place).at(Place::file(file).pointer("/eos_token_id"));
    Some(fault.with("token", escape(token, CAP)).with("id", *id).with("of", file).with("ids", ids))
}

/// The ids of `eos_token_id`: one number, or a list.
fn ids(value: &Value) -> Option<Vec<u64>> {
    match value {
        Value::Array(list) => list.iter().map(Value::as_u64).collect(),
        one => Some(vec![one.as_u64()?]),
    }
}

/// The fault of a template that writes the begin-of-sequence token, which the tokenizer adds too.
fn second_begin(checkpoint: &Checkpoint, rendered: &Rendered, place: Place) -> Option<Fault> {
    let tokenizer = &checkpoint.tokenizer;
    let (_, token) = tokenizer.special_tokens.iter().find(|(name, _)| name == "bos_token")?;
    if token.is_empty() || !rendered.text.starts_with(token.as_str()) || !tokenizer.adds_bos(checkpoint) {
        return None;
    }
    Some(Fault::new(FaultKind::BeginTwice).at(place).with("token", escape(token, CAP)))
}
