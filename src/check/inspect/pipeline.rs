//! The parts of a pipeline, and other checkpoints in the folders of one.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

use super::Amount;
use crate::checkpoint::{Checkpoint, files};

/// A part of a pipeline, or another checkpoint in a folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct InspectedPart {
    /// Its folder.
    pub folder: String,
    /// Its class: that which `model_index.json` names, or else its own config.
    pub class: Option<String>,
    /// Its tensors; null for a part without weights.
    pub amount: Option<Amount>,
}

/// The parts that the pipeline's `model_index.json` names, and the checkpoints `inside` its folders, by their folders. Called by
/// the program for `inspect`, which opens them.
#[must_use]
pub fn pipeline_parts(whole: &Checkpoint, inside: &[(String, Checkpoint)]) -> Vec<InspectedPart> {
    let mut found: BTreeMap<&str, InspectedPart> = BTreeMap::new();
    let part = |folder: &str, class| InspectedPart { folder: folder.to_owned(), class, amount: None };
    let index = whole.document(files::MODEL_INDEX).and_then(|document| document.value.as_ref());
    for (folder, named) in index.and_then(Value::as_object).into_iter().flatten() {
        // `"unet": ["diffusers", "UNet2DConditionModel"]`; two nulls stand for a part that is left out.
        if let Some(class) = named.get(1).and_then(Value::as_str) {
            found.insert(folder, part(folder, Some(class.to_owned())));
        }
    }
    for (folder, checkpoint) in inside {
        let text = |pointer: &str| checkpoint.config()?.pointer(pointer)?.as_str().map(str::to_owned);
        let own = found.entry(folder).or_insert_with(|| part(folder, None));
        own.class = own.class.take().or_else(|| text("/architectures/0")).or_else(|| text("/_class_name"));
        let mut amount = Amount::default();
        checkpoint.tensors().for_each(|(_, tensor)| amount.add(tensor));
        own.amount = (amount.tensors > 0).then_some(amount);
    }
    found.into_values().collect()
}
