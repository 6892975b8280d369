//! A PEFT adapter: a small set of weights that changes another model, and its config.

use serde_json::Value;

use super::{Checkpoint, Document, Tensor};

/// The document that marks an adapter directory. Source: `CONFIG_NAME` in peft/utils/constants.py.
pub const CONFIG: &str = "adapter_config.json";

/// The weights files of an adapter. Source: `SAFETENSORS_WEIGHTS_NAME` and `WEIGHTS_NAME` in peft/utils/constants.py.
pub const WEIGHTS: [&str; 2] = ["adapter_model.safetensors", "adapter_model.bin"];

/// Prefix of every tensor name: PEFT's two wrappers around the model.
pub const PREFIX: &str = "base_model.model.";

/// An adapter beside, or in place of, a model.
#[derive(Debug, Clone, Copy)]
pub struct Adapter<'c> {
    checkpoint: &'c Checkpoint,
    document: &'c Document,
}

impl<'c> Adapter<'c> {
    /// The adapter in this directory; `None` without `adapter_config.json`.
    #[must_use]
    pub fn from_checkpoint(checkpoint: &'c Checkpoint) -> Option<Self> {
        Some(Self { checkpoint, document: checkpoint.document(CONFIG)? })
    }

    /// The adapter config; `None` unless it is a JSON object.
    #[must_use]
    pub fn config(&self) -> Option<&'c Value> {
        self.document.value.as_ref().filter(|value| value.is_object())
    }

    /// The tensors; `None` unless they are in a safetensors file with a readable header.
    #[must_use]
    pub fn tensors(&self) -> Option<&'c [Tensor]> {
        let shard = self.checkpoint.shards.get(WEIGHTS[0]).filter(|shard| !shard.unread)?;
        Some(&shard.tensors)
    }

    /// The first file of [`WEIGHTS`] that exists, which is the one PEFT opens.
    #[must_use]
    pub fn file(&self) -> Option<&'static str> {
        WEIGHTS.into_iter().find(|name| self.checkpoint.has_file(name))
    }
}
