//! The values of `adapter_config.json` against the keys and types of PEFT's config classes.

use std::collections::BTreeMap;

use serde_json::Value;

use crate::checkpoint::files;
use crate::checkpoint::{Fault, FaultKind, Place, escape, pointer};
use crate::knowledge::loader::version_numbers;
use crate::knowledge::peft::{PeftKey, PeftKeys};

/// Keys that are read when an adapter is made or trained, and not when it is loaded. Source: peft 0.21.2,
/// `tuners/lora/config.py`, `config.py`.
const OF_TRAINING: [&str; 7] = [
    "corda_config",
    "eva_config",
    "inference_mode",
    "loftq_config",
    "lora_ga_config",
    "peft_version",
    "runtime_config",
];

/// Values of `task_type`. Source: peft 0.21.2, `utils/peft_types.py`; 0.14 is the first version that refuses others.
const TASKS: [&str; 6] = ["SEQ_CLS", "SEQ_2_SEQ_LM", "CAUSAL_LM", "TOKEN_CLS", "QUESTION_ANS", "FEATURE_EXTRACTION"];
const FIRST_WITH_TASKS: &[u64] = &[0, 14];

/// Characters of a name that a message quotes.
const CAP: usize = 60;

/// Faults of keys and of values that the config class refuses, for these versions of PEFT; without any, for the newest one
/// and the last one that refuses unknown keys.
pub(super) fn faults(config: &Value, table: &PeftKeys, versions: &[String]) -> Vec<Fault> {
    let kind = config.get("peft_type").and_then(Value::as_str).unwrap_or_default();
    if kind.is_empty() {
        return Vec::new();
    }
    let Some(keys) = table.of_type(kind) else { return vec![unknown_type(kind, table, table.newest())] };
    let mut faults = refused(config, keys, versions);
    if versions.is_empty() {
        faults.extend(table.newest().and_then(|newest| lost(config, keys, newest)));
        faults.extend(table.last_raising().and_then(|version| unknown(config, keys, table, version, None)));
    }
    for asked in versions {
        let Some(version) = table.nearest(asked) else { continue };
        if keys.get("peft_type").is_some_and(|key| !key.is_in(version)) {
            faults.push(unknown_type(kind, table, Some(version)));
        } else {
            faults.extend(unknown(config, keys, table, version, Some(asked)));
        }
    }
    faults
}

fn at(key: &str) -> Place {
    Place::file(files::ADAPTER_CONFIG).pointer(format!("/{}", pointer::escape(key)))
}

/// A `peft_type` that a version lacks; with the type that differs from it in case alone.
fn unknown_type(kind: &str, table: &PeftKeys, version: Option<&str>) -> Fault {
    let fault = Fault::new(FaultKind::AdapterTypeUnknown).at(at("peft_type"));
    let fault = fault.with("peft_type", escape(kind, CAP)).with("version", version.unwrap_or_default());
    let upper = kind.to_uppercase();
    if upper != kind && table.of_type(&upper).is_some() { fault.with("similar", upper) } else { fault }
}

/// Keys that this version of the config class lacks, as one fault.
fn unknown(
    config: &Value,
    keys: &BTreeMap<String, PeftKey>,
    table: &PeftKeys,
    version: &str,
    asked: Option<&str>,
) -> Option<Fault> {
    let is_foreign = |(key, _): &(&String, &Value)| keys.get(*key).is_none_or(|known| !known.is_in(version));
    let mut foreign: Vec<(&String, &Value)> = config.as_object()?.iter().filter(is_foreign).collect();
    // Python names the first of the call in its TypeError.
    let (first, _) = *foreign.first()?;
    foreign.sort_by_key(|(key, _)| *key);
    let raises = table.raises(version);
    let names: Vec<String> = foreign.iter().map(|(key, _)| escape(key, CAP)).collect();
    let drops: Vec<String> = foreign
        .iter()
        .filter(|(key, value)| keys.get(*key).is_some_and(|known| is_idle(key, known, value)))
        .map(|(key, _)| pointer::escape(key))
        .collect();
    let set = foreign.iter().filter(|(key, value)| keys.get(*key).is_some_and(|known| !is_idle(key, known, value)));
    let needs = set.clone().filter_map(|(key, _)| keys.get(*key)?.since.as_deref()).max_by_key(|v| version_numbers(v));
    let set: Vec<String> = set.map(|(key, _)| escape(key, CAP)).collect();
    let fault =
        foreign.iter().fold(Fault::new(FaultKind::AdapterConfigKeyUnknown), |fault, (key, _)| fault.at(at(key)));
    let fault = fault.with("key", escape(first, CAP)).with("count", foreign.len()).with("keys", names);
    let fault = fault.with("version", asked.unwrap_or(version)).with("raises", raises).with("asked", asked.is_some());
    let class = if config.get("peft_type").is_some_and(|kind| kind == "LORA") { "LoraConfig." } else { "" };
    let fault =
        fault.with("class", class).with("set", set).with("all_idle", drops.len() == foreign.len()).with("drops", drops);
    Some(needs.into_iter().fold(fault, |fault, needs| fault.with("needs", needs)))
}

/// Whether a key has no influence on loading: it holds its default, or is read in training alone.
fn is_idle(key: &str, known: &PeftKey, value: &Value) -> bool {
    known.default.as_ref() == Some(value) || value.is_null() || key == "peft_version"
}

/// Keys that an older version read, set to values that the newest one drops.
fn lost(config: &Value, keys: &BTreeMap<String, PeftKey>, newest: &str) -> Option<Fault> {
    let is_lost = |key: &str, value: &Value| {
        let known = keys.get(key).filter(|known| !known.is_in(newest) && !OF_TRAINING.contains(&key));
        known.is_some_and(|known| !is_idle(key, known, value))
    };
    let lost: Vec<&String> =
        config.as_object()?.iter().filter(|(key, value)| is_lost(key, value)).map(|(k, _)| k).collect();
    let first = lost.first()?;
    let until = keys.get(*first)?.until.as_deref()?;
    let fault = lost.iter().fold(Fault::new(FaultKind::AdapterConfigKeyGone), |fault, key| fault.at(at(key)));
    let names: Vec<String> = lost.iter().map(|key| escape(key, CAP)).collect();
    Some(fault.with("keys", names).with("until", until).with("version", newest))
}

/// Values that every version of the config class refuses, or that its model fails over.
fn refused(config: &Value, keys: &BTreeMap<String, PeftKey>, versions: &[String]) -> Vec<Fault> {
    let is_null = |key: &str| config.get(key).is_some_and(Value::is_null);
    let fault = |key: &str, value: &Value| {
        Fault::new(FaultKind::AdapterValueRefused).at(at(key)).with("key", key).with("value", value.clone())
    };
    let mut found: Vec<Fault> = Vec::new();
    // AdaLoRA has null there until it first moves ranks.
    let may_be_null = |key: &str| keys.get(key).is_none_or(|key| key.default.as_ref().is_none_or(Value::is_null));
    for key in ["rank_pattern", "alpha_pattern"].into_iter().filter(|key| is_null(key) && !may_be_null(key)) {
        let text = "AttributeError: 'NoneType' object has no attribute 'keys'";
        found.push(
            fault(key, &Value::Null).with("raises", text).with("default_value", Value::Object(serde_json::Map::new())),
        );
    }
    if is_null("lora_alpha") && config.get("peft_type").is_some_and(|kind| kind == "LORA") {
        let text = "TypeError: unsupported operand type(s) for /: 'NoneType' and 'int'";
        found.push(fault("lora_alpha", &Value::Null).with("raises", text));
    }
    let refuses = |version: &String| version_numbers(version).as_slice() >= FIRST_WITH_TASKS;
    let task = config.get("task_type").and_then(Value::as_str).filter(|task| !TASKS.contains(task));
    if let Some(task) = task.filter(|_| versions.is_empty() || versions.iter().any(refuses)) {
        let shown = escape(task, CAP);
        let text = format!("ValueError: Invalid task type: '{shown}'");
        found.push(fault("task_type", &Value::from(shown)).with("raises", text));
    }
    found
}
