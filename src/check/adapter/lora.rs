//! What PEFT adds to a base model when it opens or merges a LoRA, or why that cannot be said.
//!
//! [`crate::merge`] calls it for a recipe with an adapter, and [`super::fit`] for the load of one.
//! Source: peft 0.21.2, `tuners/lora/layer.py` and `tuners/lora/model.py`.

use std::collections::BTreeMap;

use serde_json::Value;

use super::keys::{AdapterKey, MatrixRole};
use super::targets::Targets;
use super::{AdapterModule, PAIRS, other_library};
use crate::checkpoint::adapter::Adapter;
use crate::checkpoint::{Checkpoint, Tensor, escape, files};

/// A LoRA of which every tensor has a place in a base model.
#[derive(Debug)]
pub struct Lora<'c> {
    /// The changes of weights, by the name of the module.
    pub modules: BTreeMap<&'c str, LoraModule<'c>>,
    /// Tensors of the base model that are replaced, by their names in it: `modules_to_save`, or an embedding that was resized.
    pub whole: BTreeMap<&'c str, &'c Tensor>,
    /// Whether the biases of the modules were trained as well, and are among the whole tensors.
    pub biases: bool,
}

/// The matrices of a module.
#[derive(Debug)]
pub struct LoraModule<'c> {
    /// `lora_A [r, in]`, or `lora_embedding_A [r, rows]`.
    pub a: &'c Tensor,
    /// `lora_B [out, r]`, or `lora_embedding_B [columns, r]`.
    pub b: &'c Tensor,
    /// Whether they are those of an embedding, whose weight is `[rows, columns]`.
    pub is_embedding: bool,
    /// The lengths that DoRA adds, one for each output.
    pub magnitude: Option<&'c Tensor>,
    /// The factor on their product: `lora_alpha / r`, or `lora_alpha / sqrt(r)`.
    pub scaling: f64,
}

/// Keys with any value: they say which modules have matrices, or are read in training alone.
const FREE: [&str; 22] = [
    "alpha_pattern",
    "auto_mapping",
    "base_model_name_or_path",
    "exclude_modules",
    "fan_in_fan_out",
    "inference_mode",
    "layers_pattern",
    "layers_to_transform",
    "lora_alpha",
    "lora_dropout",
    "megatron_core",
    "modules_to_save",
    "peft_type",
    "peft_version",
    "qalora_group_size",
    "r",
    "rank_pattern",
    "revision",
    "runtime_config",
    "target_modules",
    "task_type",
    "use_rslora",
];

/// Times that a check reads a LoRA for versions of transformers, at most: the work of one judgement is divided by it.
pub(super) const READINGS: u64 = 4;

/// Values of `init_lora_weights` that leave the weights of the base model as they are.
const PLAIN_STARTS: [&str; 3] = ["gaussian", "eva", "orthogonal"];

/// What a LoRA is read for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LoraUse {
    /// Its matrices are placed in a base model.
    Load,
    /// Their product is added to the weights: nothing else may belong to it.
    Merge,
}

/// The LoRA in this directory.
///
/// # Errors
/// Why it is none that can be used so, as a sentence without its subject, the adapter.
pub fn lora(checkpoint: &Checkpoint, purpose: LoraUse) -> Result<Lora<'_>, String> {
    let adapter = Adapter::from_checkpoint(checkpoint).ok_or_else(|| format!("has no {}", files::ADAPTER_CONFIG))?;
    let config = adapter.config().ok_or_else(|| format!("has no readable {}", files::ADAPTER_CONFIG))?;
    if let Some((_, library)) = other_library(config) {
        return Err(format!("was written by {library}; only LoRAs of PEFT are supported"));
    }
    match config.get("peft_type").and_then(Value::as_str) {
        Some("LORA") => {}
        Some(other) => return Err(format!("is of type {}; only LORA is supported", escape(other, 40))),
        None => return Err(format!("has no peft_type in {}; only LORA is supported", files::ADAPTER_CONFIG)),
    }
    if let Some((key, value)) =
        config.as_object().and_then(|keys| keys.iter().find(|(key, value)| !is_plain(key, value, purpose)))
    {
        let value = escape(&value.to_string(), 60);
        return Err(format!("sets {} to {value}, which is not supported", escape(key, 60)));
    }
    let tensors = adapter.tensors().ok_or_else(|| match adapter.file() {
        Some(file) if file != files::ADAPTER_WEIGHTS => {
            format!("has its weights in {file}, a pickle; save it with safe_serialization=True")
        }
        _ => format!("has no readable {}", files::ADAPTER_WEIGHTS),
    })?;
    let (modules, whole) = sorted(tensors, purpose)?;
    let targets = Targets::from_config(config, checkpoint, if purpose == LoraUse::Load { READINGS } else { 1 });
    let is_rs = config.get("use_rslora") == Some(&Value::Bool(true));
    let mut found = BTreeMap::new();
    for (name, module) in modules {
        found.insert(name, matrices(name, &module, &targets, is_rs, purpose)?);
    }
    if targets.excess().is_some() {
        return Err("has lists or patterns that are too large to be compared".to_owned());
    }
    if found.is_empty() && whole.is_empty() {
        return Err("has no tensors".to_owned());
    }
    let biases = config.get("bias").is_some_and(|bias| bias == "lora_only");
    Ok(Lora { modules: found, whole, biases })
}

/// Whether a key has a value with which PEFT merges `B @ A` times a factor.
fn is_plain(key: &str, value: &Value, purpose: LoraUse) -> bool {
    match (key, value) {
        (key, _) if FREE.contains(&key) => true,
        ("use_dora", Value::Bool(_)) if purpose == LoraUse::Load => true,
        ("bias", Value::String(word)) => word == "none" || (purpose == LoraUse::Load && word == "lora_only"),
        ("init_lora_weights", Value::String(word)) => PLAIN_STARTS.contains(&word.as_str()),
        // The configs say what the initialisation is made with.
        ("init_lora_weights", _)
        | ("loftq_config" | "eva_config" | "corda_config" | "lora_ga_config", Value::Object(_))
        | (_, Value::Null | Value::Bool(false)) => true,
        (_, Value::Array(items)) => items.is_empty(),
        (_, Value::Object(keys)) => keys.is_empty(),
        _ => false,
    }
}

/// The matrices by module, and the tensors of the base model.
type Sorted<'c> = (BTreeMap<&'c str, AdapterModule<'c>>, BTreeMap<&'c str, &'c Tensor>);

fn sorted(tensors: &[Tensor], purpose: LoraUse) -> Result<Sorted<'_>, String> {
    let (mut modules, mut whole) = (BTreeMap::<&str, AdapterModule<'_>>::new(), BTreeMap::new());
    for tensor in tensors {
        let name = &tensor.name;
        match AdapterKey::parse(name) {
            AdapterKey::Lora { role: MatrixRole::Bias, .. } => {
                return Err(format!("has the bias {}, which is not supported", escape(name, 200)));
            }
            AdapterKey::Lora { role: MatrixRole::Magnitude, .. } if purpose == LoraUse::Merge => {
                return Err(format!("has the magnitudes of DoRA {}, which are not supported", escape(name, 200)));
            }
            AdapterKey::Lora { module, role } => drop(modules.entry(module).or_default().insert(role, tensor)),
            AdapterKey::Whole(name) => drop(whole.insert(name, tensor)),
            AdapterKey::Named { .. } => {
                return Err(format!("has {}, whose name contains the name of the adapter", escape(name, 200)));
            }
            AdapterKey::Foreign(reason) => return Err(format!("has {}: {reason}", escape(name, 200))),
        }
    }
    Ok((modules, whole))
}

/// The matrices of a module, with the rank that the config gives it.
fn matrices<'c>(
    name: &str,
    module: &AdapterModule<'c>,
    targets: &Targets<'_>,
    is_rs: bool,
    purpose: LoraUse,
) -> Result<LoraModule<'c>, String> {
    let shown = || escape(name, 200);
    let pair = |(down, up)| Some((*module.get(&down)?, *module.get(&up)?));
    let mut pairs = PAIRS.into_iter().filter_map(|pair_of| Some((pair(pair_of)?, pair_of.0 == MatrixRole::EmbeddingA)));
    let magnitude = module.get(&MatrixRole::Magnitude).copied();
    let length = if magnitude.is_some() { 3 } else { 2 };
    let (Some(((a, b), is_embedding)), true) = (pairs.next(), module.len() == length) else {
        return Err(format!("does not have both matrices of {}", shown()));
    };
    if purpose == LoraUse::Merge && !targets.may_cover(name) {
        return Err(format!("has matrices of {}, which target_modules does not name", shown()));
    }
    let (Some(rank), Some(alpha)) = (targets.rank(name), targets.alpha(name)) else {
        return Err(format!("does not say the rank and the lora_alpha of {}", shown()));
    };
    if purpose == LoraUse::Load && magnitude.is_some() != targets.dora {
        return Err(format!(
            "has {} of DoRA for {}",
            if targets.dora { "no magnitude" } else { "a magnitude" },
            shown()
        ));
    }
    if rank == 0 || a.shape.first() != Some(&rank) || b.shape.get(1) != Some(&rank) {
        return Err(format!("has {:?} and {:?} for {}, whose rank is {rank}", a.shape, b.shape, shown()));
    }
    #[expect(clippy::cast_precision_loss, reason = "a rank is far below 2^52")]
    let rank = rank as f64;
    Ok(LoraModule { a, b, is_embedding, magnitude, scaling: alpha / if is_rs { rank.sqrt() } else { rank } })
}

/// The module of a matrix in an adapter's file.
#[must_use]
pub fn module_of(name: &str) -> Option<&str> {
    match AdapterKey::parse(name) {
        AdapterKey::Lora { module, .. } => Some(module),
        _ => None,
    }
}
