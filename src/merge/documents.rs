//! The JSON documents of a merge: a donor's, edited, or new ones.

use serde_json::{Map, Value, json};

use super::context::Context;
use super::draft::MergeDraft;
use super::error::MergeError;
use crate::check::tokens::OpenedTokenizer;
use crate::checkpoint::{Document, FaultKind, Vocabulary, pointer};
use crate::knowledge::recipe::{CODE_SWITCHES, DocumentEdit, DocumentSpec, GraftEdit, TokensForm};

/// A document of the result and where it came from.
pub(super) struct MergedDocument {
    pub document: Document,
    pub origin: String,
}

pub(super) fn plan(context: &Context<'_>, draft: &mut MergeDraft) -> Result<Vec<MergedDocument>, MergeError> {
    let mut out = Vec::new();
    for spec in &context.recipe.documents {
        if context.holds(spec.when.as_ref(), &spec.name)?
            && let Some(document) = plan_document(context, spec, draft)?
        {
            out.push(document);
        }
    }
    Ok(out)
}

fn plan_document(
    context: &Context<'_>,
    spec: &DocumentSpec,
    draft: &mut MergeDraft,
) -> Result<Option<MergedDocument>, MergeError> {
    let donor =
        spec.from.as_ref().map(|role| (role, context.donor(role).and_then(|d| d.checkpoint.document(&spec.name))));
    let (start, faultless) = match donor {
        Some((_, Some(d))) => match &d.value {
            Some(value) if value.is_object() => (Some((value.clone(), d)), d.faults.is_empty()),
            _ => (None, false),
        },
        _ => (None, true),
    };
    let Some((mut value, source)) = start
        .map(|(v, d)| (v, Some(d)))
        .or_else(|| (!spec.optional && faultless).then(|| (Value::Object(Map::new()), None)))
    else {
        return match donor {
            Some((role, Some(_))) => Err(MergeError::Donor(format!(
                "the {role} donor's {} cannot be read as a JSON object; `ckpt-doctor check` on it says why",
                spec.name
            ))),
            _ => Ok(None),
        };
    };
    if let Some(source) = source {
        unambiguous(source, spec.from.as_deref().unwrap_or_default())?;
        finite(spec, source, &mut value, draft)?;
        let removed = strip_switches(&mut value);
        if !removed.is_empty() && spec.name != "added_tokens.json" {
            draft.repairs.push(format!(
                "{}: {} of the donor left behind; a merge carries no key that makes a loader run code",
                spec.name,
                removed.join(", ")
            ));
        }
    }
    for edit in &spec.edits {
        apply_edit(context, spec, edit, &mut value)?;
    }
    let role = spec.from.as_deref().unwrap_or_default();
    if let Some(d) = source.filter(|d| !d.left_out.is_empty() && d.value.as_ref() != Some(&value)) {
        // Its vocabulary was not read into the value: writing the value would lose it.
        return Err(MergeError::Recipe(format!("{}: {} can be copied, not edited", context.recipe.recipe, d.name)));
    }
    let document = match source {
        // Nothing changed: the donor's own bytes, not our spelling of them.
        Some(d) if d.value.as_ref() == Some(&value) && d.faults.is_empty() => {
            return Ok(Some(MergedDocument { document: d.clone(), origin: format!("{role} donor, unchanged") }));
        }
        _ => Document::from_value(&spec.name, value),
    };
    let origin = if source.is_some() { format!("{role} donor, edited") } else { "made by the recipe".to_owned() };
    Ok(Some(MergedDocument { document, origin }))
}

/// Puts the recipe's value where the donor has `Infinity` or `NaN`: the result is strict JSON.
fn finite(spec: &DocumentSpec, source: &Document, value: &mut Value, draft: &mut MergeDraft) -> Result<(), MergeError> {
    let mut places = Vec::new();
    for fault in source.faults.iter().filter(|f| f.kind == FaultKind::NonFiniteNumber) {
        let Some(pointer) = fault.places.first().and_then(|p| p.pointer.as_deref()) else { continue };
        let Some(stand_in) = &spec.non_finite else {
            return Err(MergeError::Donor(format!(
                "{}{pointer} is not a finite number and the recipe has no stand-in for it; repair the donor first",
                spec.name
            )));
        };
        let negative = fault.detail.get("literal").and_then(Value::as_str).is_some_and(|l| l.starts_with('-'));
        if let Some(slot) = value.pointer_mut(pointer) {
            *slot = match stand_in.as_f64() {
                Some(n) if negative => Value::from(-n),
                _ => stand_in.clone(),
            };
            places.push(pointer.to_owned());
        }
    }
    if let (Some(first), Some(stand_in)) = (places.first(), &spec.non_finite) {
        draft.repairs.push(format!(
            "{}: {} number{} that strict JSON cannot say replaced by {stand_in}, the first at {first}",
            spec.name,
            places.len(),
            if places.len() == 1 { "" } else { "s" }
        ));
    }
    Ok(())
}

/// Removes [`CODE_SWITCHES`] at every level; returns those removed.
fn strip_switches(value: &mut Value) -> Vec<String> {
    let mut removed = Vec::new();
    let mut pending = vec![value];
    while let Some(value) = pending.pop() {
        match value {
            Value::Object(map) => {
                for key in CODE_SWITCHES {
                    if map.shift_remove(*key).is_some() {
                        removed.push((*key).to_owned());
                    }
                }
                pending.extend(map.values_mut());
            }
            Value::Array(items) => pending.extend(items.iter_mut()),
            _ => {}
        }
    }
    removed.sort();
    removed.dedup();
    // The recipe writes an auto_map of its own: leaving the donor's behind is not news.
    removed.retain(|k| k != "auto_map");
    removed
}

fn apply_edit(
    context: &Context<'_>,
    spec: &DocumentSpec,
    edit: &DocumentEdit,
    value: &mut Value,
) -> Result<(), MergeError> {
    match edit {
        DocumentEdit::Set(set) => {
            if context.holds(set.when.as_ref(), &spec.name)? {
                let place = format!("{}{}", spec.name, set.at);
                let to = set.to.eval(&context.scope).map_err(context.at(place))?;
                pointer::put(value, &Value::Null, &set.at, to).ok_or_else(|| not_there(context, spec, &set.at))?;
            }
        }
        DocumentEdit::Tokens(edit) => {
            if context.holds(edit.when.as_ref(), &spec.name)?
                && let Some(tokens) = &context.tokens
            {
                pointer::put(value, &Value::Null, &edit.at, added(context, tokens, edit.form))
                    .ok_or_else(|| not_there(context, spec, &edit.at))?;
            }
        }
        DocumentEdit::Graft(graft) => {
            let config = grafted(context, graft)?;
            pointer::put(value, &Value::Null, &graft.at, config).ok_or_else(|| not_there(context, spec, &graft.at))?;
        }
        DocumentEdit::Remove(remove) => {
            if context.holds(remove.when.as_ref(), &spec.name)? {
                for pointer in &remove.at {
                    pointer::remove(value, pointer);
                }
            }
        }
    }
    Ok(())
}

/// The added tokens in one of transformers' forms: the base donor's as it states them, then the new ones.
fn added(context: &Context<'_>, tokens: &OpenedTokenizer, form: TokensForm) -> Value {
    let base = context.recipe.tokens.as_ref().and_then(|t| context.donor(&t.base)).map(|d| &d.checkpoint);
    let mut map = Map::new();
    match form {
        TokensForm::Decoder => {
            let stated =
                base.and_then(|c| c.document("tokenizer_config.json")?.get("/added_tokens_decoder")?.as_object());
            map.extend(stated.into_iter().flatten().map(|(k, v)| (k.clone(), v.clone())));
            for (id, token) in &tokens.new {
                let entry = json!({
                    "content": token.content, "lstrip": false, "normalized": token.normalized, "rstrip": false,
                    "single_word": false, "special": token.special,
                });
                map.insert(id.to_string(), entry);
            }
        }
        TokensForm::Ids => {
            // Only what lies beyond the vocabulary, as save_pretrained writes it.
            let size = base.and_then(|c| c.tokenizer.base()).map_or(0, Vocabulary::len);
            let had = base.into_iter().flat_map(|c| c.tokenizer.added()).filter(|(_, id)| **id >= size);
            map.extend(had.map(|(content, id)| (content.clone(), json!(id))));
            map.extend(tokens.new.iter().map(|(id, token)| (token.content.clone(), json!(id))));
        }
    }
    Value::Object(map)
}

fn not_there(context: &Context<'_>, spec: &DocumentSpec, pointer: &str) -> MergeError {
    MergeError::Donor(format!(
        "{}{pointer} cannot be set: something on the way is not an object (recipe {})",
        spec.name, context.recipe.recipe
    ))
}

/// Refuses a document with a key twice: which value a reader takes depends on the reader.
fn unambiguous(document: &Document, role: &str) -> Result<(), MergeError> {
    let twice = document.faults.iter().find(|f| {
        f.kind == FaultKind::DuplicateJsonKey && f.detail.get("equal").is_none_or(|e| *e == Value::Bool(false))
    });
    twice.map_or(Ok(()), |fault| {
        let key = fault.detail.get("key").and_then(Value::as_str).unwrap_or_default();
        Err(MergeError::Donor(format!(
            "the {role} donor's {} has the key \"{key}\" twice with different values; remove the one that is not meant",
            document.name
        )))
    })
}

fn grafted(context: &Context<'_>, graft: &GraftEdit) -> Result<Value, MergeError> {
    let document = context.donor(&graft.from).and_then(|d| d.checkpoint.document("config.json"));
    if let Some(document) = document {
        unambiguous(document, &graft.from)?;
    }
    let config = document
        .and_then(|d| d.value.as_ref())
        .and_then(Value::as_object)
        .ok_or_else(|| MergeError::Donor(format!("the {} donor has no readable config.json", graft.from)))?;
    let left_out = |key: &str| {
        graft.without.iter().any(|w| w.strip_suffix('*').map_or(w == key, |prefix| key.starts_with(prefix)))
    };
    let mut value =
        Value::Object(config.iter().filter(|(k, _)| !left_out(k)).map(|(k, v)| (k.clone(), v.clone())).collect());
    strip_switches(&mut value);
    Ok(value)
}
