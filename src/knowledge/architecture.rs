//! Architectures: which tensors a model class has, by its config.

mod blueprint;
mod build;
mod cause;
mod conversion_rows;
mod conversions;
mod doubt;
mod field_type;
pub(crate) mod member;
mod refusal;
mod resolve;

use std::collections::BTreeSet;

use indexmap::IndexMap;
use serde_json::Value;

pub(crate) use blueprint::{Blueprint, Class, SubConfig};
pub use conversion_rows::Conversion;
pub use doubt::Doubt;
#[cfg(test)]
pub(crate) use field_type::FieldType;
pub use refusal::Refusal;
#[cfg(test)]
pub(crate) use refusal::UnknownPart;

use super::{Evidence, Library, Loader};

/// Tensors that a config may ask for whatever is stored; one that asks for more, and for more than twice what is stored, is
/// refused. Kimi K2 has 70 000.
pub const TENSOR_CAP: usize = 60_000;

/// Depth of configs within configs, and of parts within parts.
const DEPTH_CAP: usize = 8;

/// A model class of the library, as one loader builds it.
#[derive(Clone, Copy)]
pub struct Architecture<'l> {
    library: &'l Library,
    file: &'l Blueprint,
    class: &'l Class,
    loader: Loader,
}

impl<'l> Architecture<'l> {
    pub(crate) const fn new(library: &'l Library, file: &'l Blueprint, class: &'l Class, loader: Loader) -> Self {
        Self { library, file, class, loader }
    }

    /// Its name: the stem of its file, in most cases the `model_type`.
    #[must_use]
    pub fn name(&self) -> &'l str {
        &self.file.architecture
    }

    /// The class, as in `architectures` of config.json.
    #[must_use]
    pub fn class(&self) -> &'l str {
        &self.class.name
    }

    /// The loader that builds it.
    pub(crate) const fn loader(&self) -> Loader {
        self.loader
    }

    /// The `model_type` of its config; `None` where it has none of its own.
    #[must_use]
    pub fn model_type(&self) -> Option<&'l str> {
        self.file.model_types.first().map(String::as_str)
    }

    /// The other classes of the same config class.
    pub fn siblings(self) -> impl Iterator<Item = Self> {
        let others = self.file.classes(self.loader).filter(move |class| class.name != self.class.name);
        others.map(move |class| Self { class, ..self })
    }

    /// Whether Auto classes of transformers build it.
    #[must_use]
    pub fn has_auto(&self) -> bool {
        self.file.has_auto()
    }

    /// Whether Auto classes build it for other model types than this one.
    #[must_use]
    pub fn is_of_other_type(&self, model_type: &str) -> bool {
        self.has_auto() && !self.file.model_types.iter().any(|own| own == model_type)
    }

    /// Whether the config class of this loader makes a config of its own of the object under a key.
    #[must_use]
    pub fn builds_config(&self, key: &str) -> bool {
        self.file.config(self.loader).configs.iter().any(|(name, _)| name == key)
    }

    /// Whether this loader reads at the top of config.json what a later version writes into `text_config`: a class that
    /// generates then raises, and one of another shape would be built from its defaults.
    #[must_use]
    pub fn misses_text_config(&self, config: &Value) -> bool {
        let generates = ["ForCausalLM", "ForConditionalGeneration", "LMHeadModel"];
        self.leaves_text_config(config) && generates.iter().any(|end| self.class().ends_with(end))
    }

    /// Whether `text_config` stays an object. Heads of some classes take their width from it, and raise; others do not ask.
    #[must_use]
    pub fn leaves_text_config(&self, config: &Value) -> bool {
        config.get("text_config").is_some_and(Value::is_object)
            && self.has_auto()
            && !self.builds_config("text_config")
            && self.own_key(config).is_none()
    }

    /// The model type of the config under a key that names none.
    #[must_use]
    pub fn sub_config_type(&self, key: &str) -> Option<String> {
        self.file.sub_config_type(key, self.loader)
    }

    /// The key of the config inside config.json that the config class reads, where the class is a part of a larger model.
    #[must_use]
    pub fn own_key<'c>(&self, config: &'c Value) -> Option<&'c str> {
        build::own_key(self.file, self.loader, config.as_object()?)
    }

    /// Whether the config class of this loader makes a config of the object under `key`, whether or not this class builds it.
    #[must_use]
    pub fn is_part(&self, key: &str) -> bool {
        self.sub_config_type(key).is_some() || self.is_fixed_part(key)
    }

    /// Whether the config class of this loader opens the part under `key` as one class, whatever its `model_type` is.
    #[must_use]
    pub fn is_fixed_part(&self, key: &str) -> bool {
        self.library.is_fixed_part(self.file, key, self.loader)
    }

    /// The type that the config class of this loader declares for a key, given by its path without the first slash: of the
    /// class itself, or of the class of the part's model type that is the default.
    #[cfg(test)]
    pub(crate) fn declared_type(&self, path: &str) -> Option<&'l FieldType> {
        let mut file = self.file;
        let mut steps = path.split('/').peekable();
        while let Some(step) = steps.next() {
            if steps.peek().is_none() {
                return file.config(self.loader).type_of(step);
            }
            let part = file.sub_config_type(step, self.loader)?;
            file = self.library.of_model_type(&part, self.loader)?;
        }
        None
    }

    /// Whether a key of a config is a word of its file.
    #[must_use]
    pub fn speaks_of(&self, key: &str) -> bool {
        self.library.speaks_of(self.name(), key)
    }

    /// Whether its file reads sizes from stored tensors, as classes do whose config does not name them.
    #[must_use]
    pub fn reads_tensors(&self) -> bool {
        ["stored(", "stored_count(", "has_tensor("].iter().any(|function| self.speaks_of(function))
    }

    /// The config that a search for one begins with when there is none.
    #[must_use]
    pub fn start(&self) -> Value {
        Value::Object(self.file.start.clone())
    }

    /// The tensors the class builds from `config`, the content of config.json.
    ///
    /// # Errors
    /// Says why the class cannot be built from this config.
    pub fn expect(&self, config: &Value) -> Result<Expected, Refusal> {
        self.expect_given(config, &Evidence::default())
    }

    /// As [`Self::expect`], reading off the stored tensors what no config says.
    ///
    /// # Errors
    /// As [`Self::expect`].
    pub fn expect_given(&self, config: &Value, evidence: &Evidence) -> Result<Expected, Refusal> {
        build::build(*self, config, evidence, &mut 0)
    }

    /// As [`Self::expect_given`], with the number of tensors and parts that it came to, if it was refused too.
    pub(crate) fn expect_counted(&self, config: &Value, evidence: &Evidence) -> (Result<Expected, Refusal>, usize) {
        let mut steps = 0;
        let expected = build::build(*self, config, evidence, &mut steps);
        (expected, steps)
    }
}

impl std::fmt::Debug for Architecture<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({}, transformers {})", self.class(), self.name(), self.loader)
    }
}

/// The state dict a model class has for one config, and what its loader knows besides.
#[derive(Debug, Clone)]
pub struct Expected {
    /// Name of the architecture.
    pub architecture: String,
    /// The loader that builds it so.
    pub loader: Loader,
    /// The class.
    pub class: String,
    /// The `model_type` of its config; empty when it has none.
    pub model_type: String,
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
    /// Regular expressions (searched for, not matched) of names whose absence the loader does not report: of the class
    /// and, for transformers 5, of its parts.
    pub ignore_missing: Vec<String>,
    /// As `ignore_missing`, of names whose presence is not reported.
    pub ignore_unexpected: Vec<String>,
    /// What transformers 5 renames and converts, in the order of application; of transformers 4.57, what the class
    /// renames; empty for 4.47.
    pub conversions: Vec<Conversion>,
    /// Why nothing follows from all this: what the description does not cover of this config. Empty where it covers it.
    pub doubts: Vec<Doubt>,
}

impl Default for Expected {
    fn default() -> Self {
        Self {
            architecture: String::new(),
            loader: Loader::V4_47_0,
            class: String::new(),
            model_type: String::new(),
            config: Value::Null,
            tensors: IndexMap::new(),
            buffers: BTreeSet::new(),
            base_model_prefix: String::new(),
            has_head: false,
            ignore_missing: Vec::new(),
            ignore_unexpected: Vec::new(),
            conversions: Vec::new(),
            doubts: Vec::new(),
        }
    }
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
    /// Drops the optional groups of which no tensor is present.
    pub fn drop_absent_groups(&mut self, present: impl Fn(&str) -> bool) {
        let found: BTreeSet<String> =
            self.tensors.iter().filter(|(name, _)| present(name)).filter_map(|(_, t)| t.optional.clone()).collect();
        self.tensors.retain(|_, tensor| tensor.optional.as_ref().is_none_or(|group| found.contains(group)));
    }
}
