//! Architectures: which tensors a model class has, by its config.

mod blueprint;
mod build;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use indexmap::IndexMap;
use serde_json::Value;

pub(crate) use blueprint::Blueprint;

use super::Library;

/// Tensors an architecture may have; a config that asks for more is refused.
pub const TENSOR_CAP: usize = 200_000;

/// Tensors found in a checkpoint, by name, with their shape where it is known.
///
/// A few facts are in no config (the size of LLaVA-3D's CLIP tower): those are read off the tensors.
#[derive(Debug, Clone, Default)]
pub struct Evidence {
    shapes: Arc<BTreeMap<String, Option<Vec<u64>>>>,
}

impl Evidence {
    /// Shape of the tensor of this name, when there is one and its shape is known.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[u64]> {
        self.shapes.get(name)?.as_deref()
    }

    /// Whether there is a tensor of this name.
    #[must_use]
    pub fn contains(&self, name: &str) -> bool {
        self.shapes.contains_key(name)
    }

    /// One more than the largest number that follows `prefix` in a tensor's name; 0 when none does.
    #[must_use]
    pub fn count(&self, prefix: &str) -> u64 {
        let index = |name: &str| -> Option<u64> {
            let rest = name.strip_prefix(prefix)?;
            rest.split_once('.').map_or(rest, |(index, _)| index).parse().ok()
        };
        let names = self.shapes.range(prefix.to_owned()..).map(|(name, _)| name.as_str());
        names.take_while(|name| name.starts_with(prefix)).filter_map(index).max().map_or(0, |n| n.saturating_add(1))
    }
}

impl FromIterator<(String, Option<Vec<u64>>)> for Evidence {
    fn from_iter<I: IntoIterator<Item = (String, Option<Vec<u64>>)>>(tensors: I) -> Self {
        Self { shapes: Arc::new(tensors.into_iter().collect()) }
    }
}

/// Names alone.
impl<'n> FromIterator<&'n str> for Evidence {
    fn from_iter<I: IntoIterator<Item = &'n str>>(names: I) -> Self {
        names.into_iter().map(|name| (name.to_owned(), None)).collect()
    }
}

/// A model class of the library.
#[derive(Clone, Copy)]
pub struct Architecture<'l> {
    library: &'l Library,
    blueprint: &'l Blueprint,
    /// Only the base module of the class, such as `LlamaModel`.
    base: bool,
}

impl<'l> Architecture<'l> {
    pub(crate) const fn new(library: &'l Library, blueprint: &'l Blueprint, base: bool) -> Self {
        Self { library, blueprint, base }
    }

    /// Its name: the stem of its file.
    #[must_use]
    pub fn name(&self) -> &'l str {
        &self.blueprint.architecture
    }

    /// One line on what it is.
    #[must_use]
    pub fn summary(&self) -> &'l str {
        &self.blueprint.summary
    }

    /// Where its facts come from.
    #[must_use]
    pub fn sources(&self) -> &'l [String] {
        &self.blueprint.sources
    }

    /// The tensors the class builds from `config`, the content of config.json.
    ///
    /// # Errors
    /// Says, in a sentence each, why the class cannot be built from this config.
    pub fn expect(&self, config: &Value) -> Result<Expected, Vec<String>> {
        self.expect_given(config, &Evidence::default())
    }

    /// As [`Self::expect`], reading off the stored tensors what no config says.
    ///
    /// # Errors
    /// As [`Self::expect`].
    pub fn expect_given(&self, config: &Value, evidence: &Evidence) -> Result<Expected, Vec<String>> {
        let mut expected = build::build(self.library, self.blueprint, config, evidence)?;
        if self.base {
            expected.keep_base();
        }
        Ok(expected)
    }
}

impl std::fmt::Debug for Architecture<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// The state dict a model class has for one config, and what its loader knows besides.
#[derive(Debug, Clone, Default)]
pub struct Expected {
    /// Name of the architecture.
    pub architecture: String,
    /// The config with the class's defaults filled in, sub-configs included.
    pub config: Value,
    /// Tensors in the order of the class's state dict.
    pub tensors: IndexMap<String, ExpectedTensor>,
    /// Buffers that are in the model and not in its state dict; in a file they are ignored silently.
    pub buffers: BTreeSet<String>,
    /// The class's `base_model_prefix`; empty for none.
    pub base_model_prefix: String,
    /// Whether the class holds its base model in an attribute of that name, that is, has a head.
    pub has_head: bool,
}

/// A tensor of an [`Expected`] state dict.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ExpectedTensor {
    /// Outermost dimension first; empty for a scalar.
    pub shape: Vec<u64>,
    /// Name of the tensor whose storage it shares.
    pub tied_to: Option<String>,
    /// Name of a group that a checkpoint has whole or not at all; both are right.
    pub optional: Option<String>,
}

impl Expected {
    /// Bytes of all tensors, each shared storage once; `None` when that overflows.
    #[must_use]
    pub fn total_bytes(&self, bytes_per_element: u64) -> Option<u64> {
        self.tensors.values().filter(|t| t.tied_to.is_none()).try_fold(0_u64, |total, tensor| {
            let elements = tensor.shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d))?;
            total.checked_add(elements.checked_mul(bytes_per_element)?)
        })
    }

    /// Drops the optional groups of which no tensor is present.
    pub fn drop_absent_groups(&mut self, present: impl Fn(&str) -> bool) {
        let found: BTreeSet<String> =
            self.tensors.iter().filter(|(name, _)| present(name)).filter_map(|(_, t)| t.optional.clone()).collect();
        self.tensors.retain(|_, tensor| tensor.optional.as_ref().is_none_or(|group| found.contains(group)));
    }

    /// Reduces a class with a head to its base module.
    fn keep_base(&mut self) {
        let prefix = format!("{}.", self.base_model_prefix);
        let strip = |name: &str| name.strip_prefix(&prefix).map(str::to_owned);
        self.tensors = std::mem::take(&mut self.tensors)
            .into_iter()
            .filter_map(|(name, tensor)| {
                let tied_to = tensor.tied_to.as_deref().and_then(strip);
                Some((strip(&name)?, ExpectedTensor { tied_to, ..tensor }))
            })
            .collect();
        self.buffers = self.buffers.iter().filter_map(|name| strip(name)).collect();
        self.has_head = false;
    }
}
