//! The conversions that a file of `rules/architectures` lists.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// One step of transformers 5's conversion of file names to model names, or of file tensors to model tensors.
///
/// `kind`, `from`, `to` and `ops` are named after the classes and arguments of `core_model_loading.py`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Conversion {
    /// `WeightRenaming`, `WeightConverter`, `PrefixChange`, or the name of a rarer class.
    pub kind: String,
    /// Patterns of file names: regular expressions; of a converter globs.
    pub from: Vec<String>,
    /// What the matched text becomes.
    pub to: Vec<String>,
    /// Operations of a converter, in order, with their arguments: `MergeModulelist{"dim": 0}`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ops: Vec<String>,
    /// The sub-module it is confined to, `base_model_prefix` taken off. An empty one still makes the loader take that
    /// prefix off a name before it looks at it; `None` does not.
    #[serde(skip_deserializing, skip_serializing_if = "Option::is_none")]
    pub scope: Option<String>,
    /// Further arguments, such as `prefix_to_remove`.
    #[serde(flatten)]
    pub extra: Map<String, Value>,
}

/// What the table says under one identifier.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(untagged)]
pub(crate) enum Rows {
    /// The same as under another one, which may stand in another file.
    SameAs(String),
    /// These, in order.
    Own(Vec<Conversion>),
}
