//! Keys that make a loader run code, which no document of a result has, whichever edit brought them.

use crate::checkpoint::files;
use std::collections::BTreeSet;

use serde_json::{Map, Value};

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
