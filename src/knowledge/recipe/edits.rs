//! Edits of a recipe's documents.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::knowledge::expression::{Expression, Template};

/// An edit of a document.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum DocumentEdit {
    /// Sets a value; creates missing parent objects.
    Set(SetEdit),
    /// Inserts the config of a donor.
    Graft(GraftEdit),
    /// Removes values.
    Remove(RemoveEdit),
    /// Writes the added tokens of the tokenizer, including those that the processor adds.
    Tokens(TokensEdit),
    /// Writes the dtype of the weights.
    Dtype(DtypeEdit),
    /// Inserts the config of a part of a donor.
    Part(PartEdit),
    /// Sets what follows from a part: the entries of `rules/parts/` for this document.
    Follow(FollowEdit),
}

/// Writes the dtype of the weights: every `torch_dtype` and `dtype` of the document and of the configs in it that is not null
/// gets the value, and the document has one of them.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DtypeEdit {
    /// The dtype as torch names it; null changes nothing.
    pub to: Expression,
}

/// Inserts the config of a part of a donor.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PartEdit {
    /// Name of the part.
    pub part: Template,
    /// Role of the donor. Keys that make a loader run code are left out.
    pub from: String,
    /// Role of the donor in whose model the part is inserted: its place is that of the same part. When missing, the document
    /// becomes the config of the part as a model of its own.
    #[serde(default)]
    pub into: Option<String>,
    /// Whether only the keys are written that differ from those of the part that stands there.
    #[serde(default)]
    pub changes: bool,
    /// Keys to leave out: exact names, or prefixes that end in `*`.
    #[serde(default)]
    pub without: Vec<String>,
    /// Values of keys of the part's config, over those of the donor.
    #[serde(default)]
    pub set: BTreeMap<String, Expression>,
}

/// Sets what follows from a part.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct FollowEdit {
    /// Name of the part.
    pub part: Template,
    /// Role of the donor that the part comes from.
    pub from: String,
    /// Role of the donor in whose model the part is inserted.
    pub into: String,
}

/// Writes the added tokens.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TokensEdit {
    /// JSON pointer, as a template.
    pub at: Template,
    /// Form of the tokens.
    pub form: TokensForm,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// How added tokens are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum TokensForm {
    /// `added_tokens_decoder`: id to properties.
    Decoder,
    /// `added_tokens.json`: content to id.
    Ids,
}

/// Sets a value.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SetEdit {
    /// JSON pointer, as a template; empty for the whole document. Of the keys that make a loader run code, only `/auto_map` can
    /// be set.
    pub at: Template,
    /// The value, without the keys that make a loader run code; `auto_map` may name modules of the result only.
    pub to: Expression,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Inserts the config of a donor.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct GraftEdit {
    /// JSON pointer, as a template.
    pub at: Template,
    /// Role of the donor. Keys that make a loader run code are left out.
    pub from: String,
    /// Keys to leave out: exact names, or prefixes that end in `*`.
    #[serde(default)]
    pub without: Vec<String>,
}

/// Removes values.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct RemoveEdit {
    /// JSON pointers, as templates.
    pub at: Vec<Template>,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}
