//! A PEFT adapter: a small set of weights that changes another model, and its config.

use super::files;
use std::collections::BTreeMap;
use std::path::{Component, Path};

use serde_json::Value;

use super::budget::Budget;
use super::{Checkpoint, Document, Dtype, Shard, Source, Tensor, is_plain_file_name};

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

/// Shards of a base model that are read.
const MAX_SHARDS: usize = 300;

/// The base model beside an adapter, or in a folder of it: the shapes of its floating-point tensors.
#[derive(Debug, Clone, Default)]
pub struct AdapterBase {
    shapes: BTreeMap<String, Vec<u64>>,
}

impl AdapterBase {
    /// Reads the shard headers of the base model that `adapter_config.json` names by a relative path of at most four parts;
    /// `None` when there is no `config.json`. No other file there is opened, and no path from the root is tried.
    pub(super) fn read(checkpoint: &Checkpoint, budget: &mut Budget) -> Option<Self> {
        let base =
            checkpoint.document(files::ADAPTER_CONFIG)?.get("/base_model_name_or_path")?.as_str().map(Path::new)?;
        let is_near = |c: Component<'_>| matches!(c, Component::ParentDir | Component::CurDir | Component::Normal(_));
        let is_relative = base.starts_with("..") || base.starts_with(".");
        let is_allowed = is_relative && base.components().all(is_near) && base.components().count() <= 4;
        let place = checkpoint.source.join(base).filter(|place| is_allowed && place.exists(files::CONFIG))?;
        Some(Self { shapes: shapes(&place, budget) })
    }

    /// The shape of a tensor by its name in the base model; a head that is tied and not stored has that of the embedding.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[u64]> {
        let embedding = || {
            let mut tied = self.shapes.iter().filter(|_| name == "lm_head.weight");
            tied.find(|(name, _)| name.ends_with("embed_tokens.weight")).map(|(_, shape)| shape)
        };
        self.shapes.get(name).or_else(embedding).map(Vec::as_slice)
    }
}

fn shapes(place: &Source, budget: &mut Budget) -> BTreeMap<String, Vec<u64>> {
    let Ok(entries) = place.list("") else { return BTreeMap::new() };
    let names = entries.take(MAX_SHARDS * 10).filter_map(|entry| entry.ok()?.name.into_string().ok());
    let is_shard = |name: &String| {
        name.ends_with(".safetensors")
            && !name.starts_with("adapter_")
            && !name.starts_with('.')
            && is_plain_file_name(name)
    };
    let mut names: Vec<String> = names.filter(is_shard).collect();
    names.sort();
    let shards = names.iter().take(MAX_SHARDS).map(|name| Shard::read_within(place, name, budget));
    let tensors = shards.flat_map(|shard| shard.tensors);
    let plain = tensors.filter(|tensor| matches!(tensor.dtype, Dtype::F32 | Dtype::F16 | Dtype::BF16 | Dtype::F64));
    plain.map(|tensor| (tensor.name, tensor.shape)).collect()
}
