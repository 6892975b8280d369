//! Quantisation schemes: how a weight is stored when it is not stored plainly; one file each in `rules/quantization/`.
//!
//! A scheme wraps the plain template of a class and is never a template of its own: in place of one plain tensor
//! stand a few others, whose names and shapes follow from the plain one's.

mod applied;
mod declared;

use serde::Deserialize;

use super::expression::Expression;
use super::processor::Let;
use super::source::{self, DataError};

pub use applied::{AppliedScheme, Shapes};
pub use declared::{DeclaredScheme, block, declared_scheme};

/// A scheme as its file gives it.
///
/// Expressions see the `config`, `q` (its block about quantisation) and the parameters; shapes also see the plain
/// tensor: `rows` and `cols` (its last two dimensions), `lead` (those before them), `count` (of its values), and what
/// `let` names. `held` lists the names that are stored of a module. `init(list)` and `last(list)` take a list apart.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Scheme {
    /// Its name: the stem of its file.
    pub scheme: String,
    /// What people call it.
    pub summary: String,
    /// Where its facts come from.
    pub sources: Vec<String>,
    /// Whether a config means this scheme.
    pub when: Expression,
    /// The program that loads it, when that is not transformers.
    #[serde(default)]
    pub loaded_by: Option<String>,
    /// What the shapes depend on besides the plain shape, in order.
    #[serde(default)]
    pub parameters: Vec<Parameter>,
    /// Whether a module's name in `q` stands for parameters of its own.
    #[serde(default)]
    pub overrides: bool,
    /// When shapes follow from the config at all; always when absent.
    #[serde(default)]
    pub shapes_when: Option<Expression>,
    /// Names for what shapes say often, in order.
    #[serde(default, rename = "let")]
    pub lets: Vec<Let>,
    /// How the plain tensor's name ends; `tensors` put other endings in its place.
    pub plain: String,
    /// The plain shape, read off the stored shapes in `s`; of one dimension where these say only how many values there
    /// are; absent where they do not say that either.
    #[serde(default)]
    pub plain_shape: Option<Expression>,
    /// Keys of `q` that list what is left plain.
    #[serde(default)]
    pub skipped: Vec<String>,
    /// Tensors may as well be plain: the loader takes them as they are.
    #[serde(default)]
    pub plain_too: bool,
    /// Whether modules of one kind are stored alike in every layer but for those listed; true when absent.
    #[serde(default)]
    pub all_alike: Option<Expression>,
    /// Ending by which tensors are taken for this scheme's when no config says so.
    #[serde(default)]
    pub sign: Option<String>,
    /// Those lists name modules one by one (or match them by `re:…`), not whole branches.
    #[serde(default)]
    pub skipped_are_modules: bool,
    /// What stands in place of the plain tensor; the first one holds the values.
    pub tensors: Vec<StoredPart>,
    /// Endings of tensors that a quantised module may have although the class has not.
    #[serde(default)]
    pub extra: Vec<String>,
    /// Globs of further names that belong to the scheme and are not checked.
    #[serde(default)]
    pub ignored: Vec<String>,
    /// What transformers says of an incomplete module, when it raises; `{tensor}` is the plain name.
    #[serde(default)]
    pub raises: Option<String>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    pub schema: Option<String>,
}

/// A value that shapes depend on.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Parameter {
    /// Name in expressions.
    pub name: String,
    /// Its value.
    pub is: Expression,
    /// Other values worth trying when the shapes disagree.
    #[serde(default)]
    pub others: Vec<i64>,
    /// No config says it: whichever value fits is right.
    #[serde(default)]
    pub free: bool,
}

/// One of the tensors that stand in place of a plain one.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct StoredPart {
    /// How its name ends.
    pub name: String,
    /// Its shape; null, or no expression, for any.
    #[serde(default)]
    pub shape: Option<Expression>,
    /// Element types it may have.
    pub dtypes: Vec<String>,
    /// Whether a module is incomplete without it; true when absent.
    #[serde(default)]
    pub required: Option<Expression>,
}

impl Scheme {
    /// The schemes inside the program.
    ///
    /// # Errors
    /// [`DataError`]; the house tests see to it that there is none.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        source::embedded("quantization").iter().map(|(path, text)| source::parse_embedded(path, text)).collect()
    }

    /// Endings of its tensors, in order.
    pub fn endings(&self) -> impl Iterator<Item = &str> {
        self.tensors.iter().map(|part| part.name.as_str())
    }

    /// Whether values are stored under the plain name.
    #[must_use]
    pub fn keeps_name(&self) -> bool {
        self.tensors.first().is_some_and(|part| part.name == self.plain)
    }
}
