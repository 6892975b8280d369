//! Processors: which tokens one adds to a tokenizer when it is opened.

use serde::Deserialize;

use super::expression::{Expression, Template};
use super::source::{self, DataError};

/// A processor as its file in `rules/processors/` gives it. Expressions see the checkpoint's
/// `processor` (`processor_config.json`) and what `let` has named so far.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Processor {
    /// Its name.
    pub processor: String,
    /// Architectures it belongs to.
    pub architectures: Vec<String>,
    /// Names for expressions, in order.
    #[serde(rename = "let", default)]
    pub lets: Vec<Let>,
    /// In the order in which they are added; one that is there already keeps its id.
    pub add: Vec<TokenRun>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    pub schema: Option<String>,
}

/// A name for an expression.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Let {
    /// The name.
    pub name: String,
    /// Its value.
    pub is: Expression,
}

/// A token, or a numbered run of them.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TokenRun {
    /// Content; `i` is the number within the run: `<loc{zpad(i, 4)}>`.
    pub content: Template,
    /// How many; one when absent.
    #[serde(default)]
    pub count: Option<Expression>,
    /// Whether the tokenizer treats them as special.
    #[serde(default)]
    pub special: bool,
    /// Whether text is normalised before they are looked for.
    #[serde(default)]
    pub normalized: bool,
    /// Name under which expressions find the first one's id in `tokens`.
    #[serde(rename = "as", default)]
    pub name: Option<String>,
}

impl Processor {
    /// The processors inside the program.
    ///
    /// # Errors
    /// [`DataError`]; the house tests see to it that there is none.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        source::embedded("processors").iter().map(|(path, text)| source::parse_embedded(path, text)).collect()
    }
}
