//! Removes keys that make a loader run code from the documents of a result, whichever edit brought them.

use crate::checkpoint::files;
use std::collections::BTreeSet;
use std::sync::Arc;

use serde_json::{Map, Value};

use super::draft::MergeDraft;
use super::error::MergeError;
use crate::checkpoint::{Document, FileName};
use crate::knowledge::recipe::{AUTO_MAP, CODE_SWITCHES};

/// Documents whose keys are tokens: a token may be spelled like a switch, and then has an integer.
const TOKEN_MAPS: [&str; 2] = [files::ADDED_TOKENS, files::VOCAB_JSON];

/// Names of removed keys.
pub(super) type Removed = BTreeSet<&'static str>;

/// Removes [`CODE_SWITCHES`] at every level.
pub(super) fn strip(name: &str, value: &mut Value) -> Removed {
    let mut removed = Removed::new();
    strip_below(name, vec![value], &mut removed);
    removed
}

/// As [`strip`], for a finished document: `auto_map` at its top level, which only a `set` of the recipe can have written,
/// stays for [`super::publish::check`].
pub(super) fn strip_finished(name: &str, value: &mut Value) -> Removed {
    let mut removed = Removed::new();
    match value {
        Value::Object(map) => {
            let switches = CODE_SWITCHES.iter().filter(|key| **key != AUTO_MAP);
            remove(name, map, switches, &mut removed);
            strip_below(name, map.values_mut().collect(), &mut removed);
        }
        other => strip_below(name, vec![other], &mut removed),
    }
    removed
}

fn strip_below(name: &str, mut pending: Vec<&mut Value>, removed: &mut Removed) {
    while let Some(value) = pending.pop() {
        match value {
            Value::Object(map) => {
                remove(name, map, CODE_SWITCHES.iter(), removed);
                pending.extend(map.values_mut());
            }
            Value::Array(items) => pending.extend(items.iter_mut()),
            _ => {}
        }
    }
}

fn remove(
    name: &str,
    map: &mut Map<String, Value>,
    switches: impl Iterator<Item = &'static &'static str>,
    removed: &mut Removed,
) {
    let is_token = |value: &Value| TOKEN_MAPS.contains(&name) && value.is_u64();
    for key in switches {
        if map.get(*key).is_some_and(|value| !is_token(value)) {
            map.shift_remove(*key);
            removed.insert(key);
        }
    }
}

/// Adds the removed keys to the repairs of the report.
pub(super) fn record(name: &str, removed: &Removed, draft: &mut MergeDraft) {
    if !removed.is_empty() {
        let keys: Vec<&str> = removed.iter().copied().collect();
        let keys = keys.join(", ");
        draft.repairs.push(format!(
            "{name}: {keys} of the donor not copied; a merge copies no key that makes a loader run code"
        ));
    }
}

/// The bytes of a JSON document that the recipe copies; `None` when it contains no switch, so that the file stays as it
/// is.
pub(super) fn stripped_copy(
    role: &str,
    name: &FileName,
    document: &Document,
    draft: &mut MergeDraft,
) -> Result<Option<Arc<[u8]>>, MergeError> {
    let Some(mut value) = document.value.clone() else {
        return Err(MergeError::Donor(format!(
            "the {role} donor's {name} cannot be read as JSON; run `ckpt-doctor check` on it"
        )));
    };
    let removed = strip(name, &mut value);
    if removed.is_empty() {
        return Ok(None);
    }
    if !document.left_out.is_empty() {
        let keys: Vec<&str> = removed.into_iter().collect();
        return Err(MergeError::Donor(format!(
            "the {role} donor's {name} contains {}, which makes a loader run code; remove it from the donor",
            keys.join(" and ")
        )));
    }
    record(name, &removed, draft);
    let text = Document::from_value(&**name, value).with_numbers_of(document, "").text;
    Ok(Some(text.as_deref().unwrap_or_default().as_bytes().into()))
}
