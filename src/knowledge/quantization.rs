//! Quantisation schemes: how a quantised weight is stored; one file each in `rules/quantization/`.
//!
//! A scheme transforms the plain template of a class and has no template of its own. It replaces each plain tensor with
//! others, whose names and shapes follow from the plain one.

mod applied;
mod declared;
mod places;
mod stated;

use serde::Deserialize;

use super::expression::Expression;
use super::processor::Let;
use super::source::{self, DataError};

pub use applied::{AppliedScheme, Shapes};
pub use declared::{DeclaredScheme, block, declared_scheme, scheme_read};
pub use places::Places;
pub use stated::stated;

/// A quantisation scheme, as read from its file in `rules/quantization/`.
///
/// Expressions see `q` (the quantisation block of the config), `is_mlx` (whether the config has one under `quantization`, as MLX
/// writes it) and the parameters. Shapes also see the plain tensor: `rows` and `cols` (its last two dimensions), `lead` (the
/// dimensions before them), `count` (the number of its values), and the names in `let`. `held` lists the stored names of a
/// module. `init(list)` is a list without its last element, `last(list)` that element.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Scheme {
    /// Name of the scheme: the stem of its file.
    pub scheme: String,
    /// Usual name of the scheme, for messages.
    pub summary: String,
    /// Sources of the facts.
    #[allow(dead_code, reason = "for readers of the file")]
    pub sources: Vec<String>,
    /// Condition on the config for this scheme.
    pub when: Expression,
    /// Program that loads the weights, when it is not transformers.
    #[serde(default)]
    pub loaded_by: Option<String>,
    /// Values that the shapes depend on besides the plain shape, in order.
    #[serde(default)]
    pub parameters: Vec<Parameter>,
    /// Whether `q` may contain parameters of single modules, under their names.
    #[serde(default)]
    pub overrides: bool,
    /// Condition under which the config determines the shapes; always true when missing.
    #[serde(default)]
    pub shapes_when: Option<Expression>,
    /// Names for expressions of the shapes, in order.
    #[serde(default, rename = "let")]
    pub lets: Vec<Let>,
    /// Ending of the name of the plain tensor; `tensors` replace it by other endings.
    pub plain: String,
    /// The plain shape, computed from the stored shapes in `s`; one dimension if they determine only the number of values;
    /// missing if they do not determine that either.
    #[serde(default)]
    pub plain_shape: Option<Expression>,
    /// Keys of `q` that list the modules excluded from quantisation.
    #[serde(default)]
    pub skipped: Vec<String>,
    /// Whether the loader also accepts plain tensors.
    #[serde(default)]
    pub plain_too: bool,
    /// Whether all modules of one kind are stored alike, except for the excluded ones; true when missing.
    #[serde(default)]
    pub all_alike: Option<Expression>,
    /// Ending of tensor names that identifies the scheme when the config declares none.
    #[serde(default)]
    pub sign: Option<String>,
    /// Whether the exclusions name single modules (or match them with `re:…`) instead of whole branches.
    #[serde(default)]
    pub skipped_are_modules: bool,
    /// Tensors that replace the plain one; the first contains the values.
    pub tensors: Vec<StoredPart>,
    /// Endings of tensors that a quantised module may have in addition to those of the class.
    #[serde(default)]
    pub extra: Vec<String>,
    /// Globs of further names of the scheme; they are not checked.
    #[serde(default)]
    pub ignored: Vec<String>,
    /// Exception that transformers raises for an incomplete module; `{tensor}` is the plain name.
    #[serde(default)]
    pub raises: Option<String>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    pub schema: Option<String>,
}

/// A value that the shapes depend on.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Parameter {
    /// Name in expressions.
    pub name: String,
    /// The value.
    pub is: Expression,
    /// Other values to try when the shapes do not match.
    #[serde(default)]
    pub others: Vec<i64>,
    /// Whether no config sets the value: any value that matches the shapes is right.
    #[serde(default)]
    pub free: bool,
}

/// One of the tensors that replace a plain one.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct StoredPart {
    /// Ending of its name.
    pub name: String,
    /// Its shape; any shape when null or missing.
    #[serde(default)]
    pub shape: Option<Expression>,
    /// Dtypes that it may have.
    pub dtypes: Vec<String>,
    /// Whether a module needs it; true when missing.
    #[serde(default)]
    pub required: Option<Expression>,
}

impl Scheme {
    /// The built-in schemes.
    ///
    /// # Errors
    /// [`DataError`] for a malformed file; the tests parse all of them.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        source::embedded("quantization").iter().map(|(path, text)| source::parse_embedded(path, text)).collect()
    }

    /// Name endings of its tensors, in order.
    pub fn endings(&self) -> impl Iterator<Item = &str> {
        self.tensors.iter().map(|part| part.name.as_str())
    }

    /// Whether the values are stored under the plain name.
    #[must_use]
    pub fn keeps_name(&self) -> bool {
        self.tensors.first().is_some_and(|part| part.name == self.plain)
    }
}
