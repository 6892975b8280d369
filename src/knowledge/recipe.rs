//! Recipes: what `build-merged` takes from which donor, as data.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::{Map, Value};

use super::expression::{Expression, Template};
use super::processor::Let;
use super::source::{self, DataError};

/// A recipe as its file in `rules/recipes/` gives it.
///
/// Expressions see `opt` (options in force), one variable for each donor role (its config with the
/// class's defaults filled in), `processor`, `preprocessor`, `tokens`, what `let` has named so far, and the
/// functions `shape(role, tensor)` and `has(role, prefix)`.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Name on the command line.
    pub recipe: String,
    /// One line.
    pub summary: String,
    /// Donor roles.
    pub donors: Vec<DonorSpec>,
    /// Options.
    #[serde(default)]
    pub options: Vec<OptionSpec>,
    /// Names for expressions, in order; each may use those before it.
    #[serde(rename = "let", default)]
    pub lets: Vec<Let>,
    /// The processor of the result and the tokenizer it opens: `tokens` then knows the ids of what it adds.
    #[serde(default)]
    pub tokens: Option<TokenSpec>,
    /// What must fit before anything is planned.
    #[serde(default)]
    pub seams: Vec<SeamSpec>,
    /// The documents of the result.
    pub documents: Vec<DocumentSpec>,
    /// Where tensors come from; the first entry that matches a donor tensor decides.
    pub tensors: Vec<TensorSpec>,
    /// Files that are copied or made from a template.
    #[serde(default)]
    pub files: Vec<FileSpec>,
    /// Sentences about what the merge decided that a person should know.
    #[serde(default)]
    pub notes: Vec<Note>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    pub schema: Option<String>,
}

/// A donor role.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DonorSpec {
    /// Role on the command line.
    pub role: String,
    /// What the role is for.
    pub what: String,
    /// Architectures that can play it; empty for a directory that is no checkpoint.
    #[serde(default)]
    pub architectures: Vec<String>,
    /// Whether the merge can do without.
    #[serde(default)]
    pub optional: bool,
    /// Rules whose findings on this donor do not stop the merge, because it repairs or leaves behind what they are about.
    #[serde(default)]
    pub tolerates: Vec<String>,
}

/// An option.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct OptionSpec {
    /// Name on the command line.
    pub name: String,
    /// What it decides.
    pub help: String,
    /// Values it may have; a value that ends in `:` takes any text after the colon. Empty: a size such as `5GB`.
    #[serde(default)]
    pub values: Vec<String>,
    /// Value when not given.
    pub default: String,
}

/// Which processor adds its tokens to which donor's tokenizer.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TokenSpec {
    /// Role whose tokenizer it is.
    pub base: String,
    /// Processor, one of `rules/processors/`.
    pub processor: String,
}

/// Something that must fit.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SeamSpec {
    /// The condition.
    pub that: Expression,
    /// What does not fit, in one sentence.
    pub message: Template,
    /// The tensor that does not fit.
    #[serde(default)]
    pub tensor: Option<SeamTensor>,
    /// The tensor it has to meet.
    #[serde(default)]
    pub meets: Option<SeamTensor>,
    /// The shape that `tensor` would need.
    #[serde(default)]
    pub needed: Option<Expression>,
    /// Options that solve it.
    #[serde(default)]
    pub options: Vec<String>,
}

/// A donor tensor named by a seam.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SeamTensor {
    /// Role.
    pub from: String,
    /// Its name there.
    pub name: String,
}

/// A JSON document of the result.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DocumentSpec {
    /// File name.
    pub name: String,
    /// When it is written.
    #[serde(default)]
    pub when: Option<Expression>,
    /// Role whose document of that name is the start; an empty object when absent there and `optional` is not set.
    #[serde(default)]
    pub from: Option<String>,
    /// Leave the document out when the donor has none.
    #[serde(default)]
    pub optional: bool,
    /// What takes the place of `Infinity` and `NaN`, which strict JSON cannot say.
    #[serde(default)]
    pub non_finite: Option<Value>,
    /// Changes, in order.
    #[serde(default)]
    pub edits: Vec<DocumentEdit>,
}

/// A change to a document.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum DocumentEdit {
    /// Sets a value; missing objects on the way are made.
    Set(SetEdit),
    /// Puts a donor's config there.
    Graft(GraftEdit),
    /// Removes values.
    Remove(RemoveEdit),
    /// Writes the tokenizer's added tokens, the simulated ones included.
    Tokens(TokensEdit),
}

/// Writes the added tokens.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TokensEdit {
    /// JSON pointer.
    pub at: String,
    /// As which of transformers' two forms.
    pub form: TokensForm,
    /// When.
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
    /// JSON pointer.
    pub at: String,
    /// The value.
    pub to: Expression,
    /// When.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Puts a donor's document there.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct GraftEdit {
    /// JSON pointer.
    pub at: String,
    /// Role whose config.json it is.
    pub from: String,
    /// Keys left out: exact, or a prefix that ends in `*`.
    #[serde(default)]
    pub without: Vec<String>,
}

/// Removes values.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct RemoveEdit {
    /// JSON pointers.
    pub at: Vec<String>,
    /// When.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Where tensors come from, or that they are left behind.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TensorSpec {
    /// Role.
    pub from: String,
    /// Regular expression over the donor's names.
    pub names: String,
    /// When the entry counts at all.
    #[serde(default)]
    pub when: Option<Expression>,
    /// Name in the result; `{…}` are expressions, then `$1` is the first group. The name itself when absent.
    #[serde(rename = "as", default)]
    pub rename: Option<Template>,
    /// What is done when the shape does not fit; an expression that gives `copy`, `pad`, `grow-rows` or `reinit`.
    #[serde(default)]
    pub fit: Option<Expression>,
    /// Left behind, and why.
    #[serde(default)]
    pub drop: Option<String>,
    /// The donor tensor it has to meet, for the message when it does not fit.
    #[serde(default)]
    pub meets: Option<SeamTensor>,
    /// Options that make it fit.
    #[serde(default)]
    pub options: Vec<String>,
}

/// A file that is not a JSON document.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum FileSpec {
    /// Copies files, those that are there.
    Copy(CopySpec),
    /// Copies the Python modules that the given ones import, themselves included.
    Modules(ModulesSpec),
    /// Writes a file that comes with the recipe.
    Template(TemplateSpec),
}

/// Copies files.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct CopySpec {
    /// Role.
    pub from: String,
    /// File names.
    pub names: Vec<String>,
    /// When.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Copies Python modules and what they import.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ModulesSpec {
    /// Roles, the first that is given and has the module is taken.
    pub from: Vec<String>,
    /// Modules to start from, without `.py`.
    pub roots: Vec<String>,
    /// When.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// Writes a file that comes with the recipe.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TemplateSpec {
    /// File name in the result.
    pub name: String,
    /// Path below `rules/recipes/`.
    pub text: String,
    /// Placeholders: `{{key}}` becomes the expression's value.
    #[serde(default)]
    pub fill: BTreeMap<String, Expression>,
    /// When.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// A sentence for the report.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Note {
    /// When.
    pub when: Expression,
    /// The sentence.
    pub say: Template,
}

/// Keys that make a loader fetch or run code; no merge carries them from a donor's config.
///
/// `trust_remote_code`: CVE-2026-5241. `_attn_implementation_internal` and its kin: CVE-2026-4372.
/// A recipe that needs an `auto_map` writes its own.
pub const CODE_SWITCHES: &[&str] = &[
    "auto_map",
    "custom_pipelines",
    "trust_remote_code",
    "_attn_implementation",
    "_attn_implementation_internal",
    "_experts_implementation",
    "_experts_implementation_internal",
    "attn_implementation",
    "experts_implementation",
    "kernel_config",
    "use_kernels",
];

impl Recipe {
    /// Parses a recipe.
    ///
    /// # Errors
    /// [`DataError`] with the place.
    pub fn parse(path: &str, text: &str) -> Result<Self, DataError> {
        source::parse(path, text)
    }

    /// The recipes inside the program, by name.
    ///
    /// # Errors
    /// [`DataError`]; the house tests see to it that there is none.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        source::embedded("recipes").iter().map(|(path, text)| source::parse_embedded(path, text)).collect()
    }
}

/// A merge written down in a file: `build-merged merge.json5`. Relative paths start at the file's folder.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct MergeFile {
    /// Recipe name, or a path of one; chosen by the donors when absent.
    #[serde(default)]
    pub recipe: Option<String>,
    /// Role to directory.
    pub donors: Map<String, Value>,
    /// Options.
    #[serde(default)]
    pub options: Map<String, Value>,
    /// Directory to make.
    pub out: String,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    pub schema: Option<String>,
}
