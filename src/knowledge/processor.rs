//! Processors: the tokens that a processor adds to a tokenizer when it is opened.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::expression::{Expression, Template};
use super::rule::LoaderRange;
use super::source::{self, DataError};
use crate::checkpoint::FileName;

/// A processor, as read from its file in `rules/processors/`.
///
/// Expressions of `let` and `add` see `processor` (the `processor_config.json` of the checkpoint) and the names that `let`
/// defined so far.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Processor {
    /// Name of the processor.
    pub processor: String,
    /// Architectures that use the processor: checks of their checkpoints add its tokens. Empty for one that only recipes name.
    #[serde(default)]
    pub architectures: Vec<String>,
    /// Tokenizer classes with which it opens the tokenizer, whatever `tokenizer_class` is; without one for a version, that
    /// of `tokenizer_config.json`.
    #[serde(default)]
    pub opens: Vec<OpensWith>,
    /// Names for expressions, in order; each may use the names before it.
    #[serde(rename = "let", default)]
    pub lets: Vec<Let>,
    /// Tokens in the order in which they are added; a token that the tokenizer has already keeps its id.
    pub add: Vec<TokenRun>,
    /// Class of the processor; the values in `reads` concern no checkpoint whose files name another one.
    #[serde(default)]
    pub class: Option<String>,
    /// Tokens that the model replaces with features of images or videos, and the keys of config.json that hold their ids.
    #[serde(default)]
    pub placeholders: Vec<Placeholder>,
    /// Attributes of the tokenizer that the processor reads, with the text of each token. In transformers 4 a
    /// tokenizer has those that `extra_special_tokens` names.
    #[serde(default)]
    pub attributes: BTreeMap<String, String>,
    /// Names for expressions of `reads`, in order; one that cannot be evaluated has no value.
    #[serde(default)]
    pub facts: Vec<Let>,
    /// Values of the processor's files that follow from the model.
    #[serde(default)]
    pub reads: Vec<ReadValue>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    pub schema: Option<String>,
}

/// The tokenizer class with which a processor opens the tokenizer.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct OpensWith {
    /// Versions of transformers whose processor does so, as bounds: `<5`; all when missing.
    #[serde(default)]
    #[cfg_attr(test, schemars(with = "Option<String>"))]
    pub loaders: LoaderRange,
    /// The class.
    pub class: String,
    /// Special tokens that the class gives the tokenizer, by attribute (`pad_token`), unless `tokenizer_config.json`
    /// names another one or null.
    #[serde(default)]
    pub special: BTreeMap<String, String>,
}

/// A token that the model replaces with features.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Placeholder {
    /// Keys of config.json that hold its id, newest first; the first that the config has applies.
    pub keys: Vec<String>,
    /// Text of the token, unless `named_by` is set.
    pub content: String,
    /// Attribute of the tokenizer, and key of `processor_config.json`, that sets another text: `image_token`.
    #[serde(default)]
    pub named_by: Option<String>,
    /// Whether the model embeds another token in its place, so that its id may be out of range for the embedding.
    #[serde(default)]
    pub is_replaced: bool,
}

/// A value of a processor's file that follows from the model. Expressions see `model` (config.json with the defaults of the
/// class), `processor`, `preprocessor` (the settings of the image processor, wherever they stand), and the names in `facts`.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ReadValue {
    /// The file.
    pub file: FileName,
    /// JSON pointer of the value.
    pub at: String,
    /// Versions of transformers that read it so, as bounds: `<5`; all when missing.
    #[serde(default)]
    #[cfg_attr(test, schemars(with = "Option<String>"))]
    pub loaders: LoaderRange,
    /// Condition for this entry; an expression that cannot be evaluated counts as false.
    #[serde(default)]
    pub when: Option<Expression>,
    /// Value that the class takes when the key is missing; without it, a missing key is not judged.
    #[serde(default)]
    pub absent: Option<Expression>,
    /// The value that fits the model.
    pub is: Expression,
    /// Where the value comes from, after "but": `the vision tower has patch_size 14`.
    pub because: Template,
    /// What happens with another value.
    pub wrong: Template,
}

/// A name for an expression.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Let {
    /// The name.
    pub name: String,
    /// The expression.
    pub is: Expression,
}

/// A token, or a numbered series of tokens.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TokenRun {
    /// Text of the token; `i` is its number in the series: `<loc{zpad(i, 4)}>`.
    pub content: Template,
    /// Number of tokens; 1 when missing.
    #[serde(default)]
    pub count: Option<Expression>,
    /// Whether the tokens are special.
    #[serde(default)]
    pub special: bool,
    /// Whether the tokenizer normalises text before it looks for the tokens.
    #[serde(default)]
    pub normalized: bool,
    /// Name under which `tokens` holds the id of the first token.
    #[serde(rename = "as", default)]
    pub name: Option<String>,
}

impl Processor {
    /// The class with which the processor of this version of transformers opens every tokenizer.
    #[must_use]
    pub fn opens_with(&self, version: &str) -> Option<&OpensWith> {
        self.opens.iter().find(|class| class.loaders.contains(version))
    }

    /// Parses a processor.
    ///
    /// # Errors
    /// [`DataError`] with the position.
    pub fn parse(path: &str, text: &str) -> Result<Self, DataError> {
        source::parse(path, text)
    }

    /// Whether a built-in file has the name of an architecture in it: without one, no built-in processor is of the
    /// architecture. Called by `Knowledge::processor_of` before it parses them.
    pub(super) fn may_have(architecture: &str) -> bool {
        let name = memchr::memmem::Finder::new(architecture);
        source::embedded("processors").iter().any(|(_, text)| name.find(text.as_bytes()).is_some())
    }

    /// The built-in processors.
    ///
    /// # Errors
    /// [`DataError`] for a malformed file; the tests parse all of them.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        source::embedded("processors").iter().map(|(path, text)| source::parse_embedded(path, text)).collect()
    }
}
