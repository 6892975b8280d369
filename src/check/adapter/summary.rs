//! What an adapter is, for `inspect`.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

use super::keys::{AdapterKey, MatrixRole};
use crate::checkpoint::Checkpoint;
use crate::checkpoint::adapter::Adapter;

/// A PEFT adapter: what its config says, and the modules that its tensors belong to.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct AdapterSummary {
    /// `peft_type`.
    pub kind: Option<String>,
    /// `base_model_name_or_path`.
    pub base: Option<String>,
    /// `r`.
    pub rank: Option<u64>,
    /// `lora_alpha`.
    pub alpha: Option<f64>,
    /// The modules with low-rank matrices, by the last part of their names, those with the most modules first.
    pub targets: Vec<AdaptedModules>,
    /// Tensors that are no low-rank matrices: whole modules, biases, and those of other kinds of adapters.
    pub others: usize,
}

/// Modules of one name with low-rank matrices.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct AdaptedModules {
    /// The last part of their names: `q_proj`.
    pub name: String,
    /// Number of modules.
    pub modules: usize,
    /// The ranks of their matrices, ascending.
    pub ranks: Vec<u64>,
}

impl AdapterSummary {
    /// The adapter in a directory; `None` without an `adapter_config.json` that is an object.
    #[must_use]
    pub fn of(checkpoint: &Checkpoint) -> Option<Self> {
        let adapter = Adapter::from_checkpoint(checkpoint)?;
        let config = adapter.config()?;
        let text = |key: &str| config.get(key).and_then(Value::as_str).map(str::to_owned);
        let mut targets: BTreeMap<&str, AdaptedModules> = BTreeMap::new();
        let mut others: usize = 0;
        for tensor in adapter.tensors().unwrap_or_default() {
            let (AdapterKey::Lora { module, role } | AdapterKey::Named { module, role }) =
                AdapterKey::parse(&tensor.name)
            else {
                others = others.saturating_add(1);
                continue;
            };
            // Both matrices of a module have the rank; the first one stands for it.
            if !matches!(role, MatrixRole::A | MatrixRole::EmbeddingA) {
                continue;
            }
            let name = module.rsplit('.').next().unwrap_or(module);
            let target = targets.entry(name).or_insert_with(|| AdaptedModules {
                name: name.to_owned(),
                modules: 0,
                ranks: Vec::new(),
            });
            target.modules = target.modules.saturating_add(1);
            if let Some(rank) = tensor.shape.first()
                && let Err(at) = target.ranks.binary_search(rank)
            {
                target.ranks.insert(at, *rank);
            }
        }
        let mut targets: Vec<AdaptedModules> = targets.into_values().collect();
        targets.sort_by_key(|target| std::cmp::Reverse(target.modules));
        Some(Self {
            kind: text("peft_type"),
            base: text("base_model_name_or_path"),
            rank: config.get("r").and_then(Value::as_u64),
            alpha: config.get("lora_alpha").and_then(Value::as_f64),
            targets,
            others,
        })
    }
}
