//! Files of a recipe besides documents and weights.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::checkpoint::{FileName, FilePattern};
use crate::knowledge::expression::Expression;

/// A file that is not a JSON document.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum FileSpec {
    /// Copies files that exist in the donor.
    Copy(CopySpec),
    /// Copies Python modules and the modules that they import.
    Modules(ModulesSpec),
    /// Writes a file of the recipe.
    Template(TemplateSpec),
    /// Writes a text that an expression gives.
    Text(TextSpec),
}

/// Copies files; a JSON file loses the keys that make a loader run code.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct CopySpec {
    /// Role of the donor.
    pub from: String,
    /// File names, or patterns such as `tokenizer*`. A pattern never matches weights, `README.md`, Python modules, the documents
    /// of the recipe, and files of earlier entries.
    #[cfg_attr(test, schemars(with = "Vec<String>"))]
    pub names: Vec<FilePattern>,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Copies Python modules and what they import.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ModulesSpec {
    /// Roles of the donors; the first one that has the module is used.
    pub from: Vec<String>,
    /// Modules to start from, without `.py`.
    #[serde(default)]
    pub roots: Vec<String>,
    /// Whether to start from the modules that `auto_map` in the documents of the first donor names, too.
    #[serde(default)]
    pub auto_map: bool,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Writes a file of the recipe.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TemplateSpec {
    /// File name in the result.
    pub name: FileName,
    /// Path below the folder of the recipe, or below `rules/recipes/`.
    pub text: String,
    /// Values of placeholders: `{{key}}` becomes the value of the expression.
    #[serde(default)]
    pub fill: BTreeMap<String, Expression>,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Writes a text that an expression gives.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TextSpec {
    /// File name in the result; it ends in `.jinja`.
    pub name: FileName,
    /// The text.
    pub is: Expression,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}
