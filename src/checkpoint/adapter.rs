//! A PEFT adapter: a small set of weights that changes another model, and its config.

mod base;

use serde_json::Value;

pub use base::{AdapterBase, BaseSearch};

use super::{Checkpoint, Document, Tensor, files};

/// The weights files of an adapter. Source: `SAFETENSORS_WEIGHTS_NAME` and `WEIGHTS_NAME` in peft/utils/constants.py.
pub const WEIGHTS: [&str; 2] = [files::ADAPTER_WEIGHTS, files::PICKLED_ADAPTER];

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
        Some(Self { checkpoint, document: checkpoint.document(files::ADAPTER_CONFIG)? })
    }

    /// The adapter config; `None` unless it is a JSON object.
    #[must_use]
    pub fn config(&self) -> Option<&'c Value> {
        self.document.value.as_ref().filter(|value| value.is_object())
    }

    /// The tensors; `None` unless they are in a file that could be read.
    #[must_use]
    pub fn tensors(&self) -> Option<&'c [Tensor]> {
        let shard = self.checkpoint.shards.get(self.file()?).filter(|shard| !shard.unread)?;
        Some(&shard.tensors)
    }

    /// The first file of [`WEIGHTS`] that exists, which is the one PEFT opens.
    #[must_use]
    pub fn file(&self) -> Option<&'static str> {
        WEIGHTS.into_iter().find(|name| self.checkpoint.has_file(name))
    }
}
