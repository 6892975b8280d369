//! Policies of `LeRobot`: which statistics each feature needs, and which are stored.
//!
//! Up to version 0.3 a policy has buffers `normalize_inputs.buffer_observation_state.mean` among its weights, which start as
//! infinity. From 0.4 on, `policy_preprocessor.json` and `policy_postprocessor.json` list steps, and the statistics are in a shard
//! that a step names as its `state_file`, as `observation.state.mean`; a feature that has none there is not normalised.
//! Sources: `lerobot/common/policies/normalize.py` of 0.1 to 0.3, `lerobot/processor/normalize_processor.py` and `pipeline.py` of
//! 0.4 to 0.6.

use std::collections::BTreeSet;

use crate::checkpoint::files;
use serde_json::{Value, json};

use super::index;
use crate::checkpoint::{Checkpoint, Shard};

/// The documents of the steps, with the registered name of the step that normalises or un-normalises.
const PIPELINES: [(&str, &str); 2] =
    [(files::POLICY_PREPROCESSOR, "normalizer_processor"), (files::POLICY_POSTPROCESSOR, "unnormalizer_processor")];

/// Whether a step of a policy names this file, in which its statistics are.
pub(super) fn names_state(checkpoint: &Checkpoint, file: &str) -> bool {
    let steps = PIPELINES.iter().filter_map(|(document, _)| checkpoint.document(document)?.get("/steps")?.as_array());
    steps.flatten().any(|step| step.get("state_file").and_then(Value::as_str) == Some(file))
}

/// Where a policy keeps its statistics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Layout {
    /// Buffers of the model.
    Buffers,
    /// State files of processors.
    Processors,
    /// Neither is present.
    Missing,
}

impl Layout {
    const fn name(self) -> &'static str {
        match self {
            Self::Buffers => "buffers",
            Self::Processors => "processors",
            Self::Missing => "missing",
        }
    }
}

/// The names of files whose weights no loader opens, because it opens others.
pub(super) fn set_aside(checkpoint: &Checkpoint) -> BTreeSet<String> {
    let opened: BTreeSet<&str> = index::opened_shards(checkpoint).map(|shard| shard.name.as_str()).collect();
    let is_left = |name: &&String| !opened.contains(name.as_str()) && !names_state(checkpoint, name);
    checkpoint.shards.keys().filter(is_left).cloned().collect()
}

/// The variable `robot` of rules: `layout`, and `features` with `name`, `input`, `mode`, `width`, `document`, `state_file`, `state_read`,
/// `stem`, `asks`, `lacks` and `stored_width`. Null for a config that is no policy.
pub(super) fn policy(checkpoint: &Checkpoint) -> Value {
    let Some(config) = checkpoint.config().filter(|config| config.get("type").is_some_and(Value::is_string)) else {
        return Value::Null;
    };
    let is_policy =
        ["input_features", "output_features"].iter().any(|key| config.get(key).is_some_and(Value::is_object));
    if !is_policy {
        return Value::Null;
    }
    let is_buffer =
        |name: &str| ["normalize_inputs.", "unnormalize_outputs."].iter().any(|start| name.starts_with(start));
    let layout = if PIPELINES.iter().any(|(document, _)| checkpoint.has_file(document)) {
        Layout::Processors
    } else if index::opened_tensors(checkpoint).any(|tensor| is_buffer(&tensor.name)) {
        Layout::Buffers
    } else {
        Layout::Missing
    };
    let side = |key: &str, is_input: bool| -> Vec<Value> {
        let features = config.get(key).and_then(Value::as_object).into_iter().flatten();
        features.map(|(name, feature)| feature_of(checkpoint, layout, name, feature, is_input)).collect()
    };
    let features: Vec<Value> = [side("input_features", true), side("output_features", false)].concat();
    json!({ "layout": layout.name(), "features": features })
}

/// One feature of a policy.
fn feature_of(checkpoint: &Checkpoint, layout: Layout, name: &str, feature: &Value, is_input: bool) -> Value {
    let kind = feature.get("type").and_then(Value::as_str).unwrap_or_default();
    let [(preprocessor, normalizer), (postprocessor, unnormalizer)] = PIPELINES;
    let (document, step) = if is_input { (preprocessor, normalizer) } else { (postprocessor, unnormalizer) };
    let step = step_of(checkpoint, document, step);
    let state_file = step.and_then(|step| step.get("state_file")).and_then(Value::as_str);
    let map = match layout {
        Layout::Processors => step.and_then(|step| step.pointer("/config/norm_map")),
        Layout::Buffers | Layout::Missing => checkpoint.config().and_then(|config| config.get("normalization_mapping")),
    };
    let mode = map.and_then(|map| map.get(kind)).and_then(Value::as_str).unwrap_or("IDENTITY");
    let stem = match layout {
        Layout::Processors => name.to_owned(),
        Layout::Buffers | Layout::Missing => {
            let module = if is_input { "normalize_inputs" } else { "unnormalize_outputs" };
            format!("{module}.buffer_{}", name.replace('.', "_"))
        }
    };
    let shards: Vec<&Shard> = match layout {
        Layout::Processors => state_file.and_then(|file| checkpoint.shards.get(file)).into_iter().collect(),
        Layout::Buffers | Layout::Missing => checkpoint.shards.values().collect(),
    };
    let asks = statistics_of(mode);
    let tensor = |statistic: &str| {
        let wanted = format!("{stem}.{statistic}");
        shards.iter().flat_map(|shard| &shard.tensors).find(|tensor| tensor.name == wanted)
    };
    let lacks: Vec<&&str> = asks.iter().filter(|statistic| tensor(statistic).is_none()).collect();
    let stored = asks.iter().find_map(|statistic| tensor(statistic)).filter(|tensor| tensor.shape.len() == 1);
    json!({
        "name": name,
        "type": kind,
        "input": is_input,
        "mode": mode,
        "width": width(feature),
        "document": document,
        "step_width": step.and_then(|step| width(step.pointer("/config/features")?.get(name)?)),
        "has_step": step.is_some(),
        "state_file": state_file,
        "has_state": state_file.is_some_and(|file| checkpoint.shards.contains_key(file)),
        "state_read": shards.iter().all(|shard| !shard.unread),
        "stem": stem,
        "asks": asks,
        "lacks": lacks,
        "other_in_training": !is_input && layout == Layout::Processors && differs_in_training(checkpoint, name, asks),
        "stored_width": stored.and_then(|tensor| tensor.shape.first()),
    })
}

/// Whether the preprocessor normalised an action in training by other statistics than those by which the postprocessor
/// un-normalises it. Both files are written from one set.
fn differs_in_training(checkpoint: &Checkpoint, feature: &str, asks: &[&str]) -> bool {
    let numbers = |(document, registered): (&str, &str), statistic: &str| {
        let file = step_of(checkpoint, document, registered)?.get("state_file")?.as_str()?;
        let shard = checkpoint.shards.get(file)?;
        let name = format!("{feature}.{statistic}");
        checkpoint.numbers(shard, shard.tensors.iter().find(|tensor| tensor.name == name)?)
    };
    let [preprocessor, postprocessor] = PIPELINES;
    let pair = |statistic: &&str| Some((numbers(preprocessor, statistic)?, numbers(postprocessor, statistic)?));
    asks.iter().filter_map(pair).any(|(training, action)| training != action)
}

/// The step of this registered name in a document of steps.
fn step_of<'c>(checkpoint: &'c Checkpoint, document: &str, registered: &str) -> Option<&'c Value> {
    let steps = checkpoint.document(document)?.get("/steps")?.as_array()?;
    steps.iter().find(|step| step.get("registry_name").and_then(Value::as_str) == Some(registered))
}

/// The only dimension of a feature; images have three.
fn width(feature: &Value) -> Option<u64> {
    match feature.get("shape")?.as_array()?.as_slice() {
        [width] => width.as_u64(),
        _ => None,
    }
}

/// The statistics by which a mode normalises. Source: `NormalizationMode` of `LeRobot` 0.6.
fn statistics_of(mode: &str) -> &'static [&'static str] {
    match mode {
        "MEAN_STD" => &["mean", "std"],
        "MIN_MAX" => &["min", "max"],
        "QUANTILES" => &["q01", "q99"],
        "QUANTILE10" => &["q10", "q90"],
        _ => &[],
    }
}
