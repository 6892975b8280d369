//! Recipes: the parts that `build-merged` takes from each donor.

use std::borrow::Cow;
use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::{Map, Value};

use super::expression::{Expression, Template};
use super::processor::{Let, Processor};
use super::source::{self, DataError};
use crate::checkpoint::FileName;

mod edits;
mod files;

pub use edits::{DocumentEdit, FollowEdit, GraftEdit, PartEdit, TokensForm};
pub use files::{CopySpec, FileSpec, ModulesSpec, TemplateSpec, TextSpec};

/// A recipe, as read from its file in `rules/recipes/`.
///
/// Expressions see `opt` (the options), a variable for each donor role (its config with the defaults of the class filled in),
/// `stored` (the config of each role as it is in the file: `stored.vision`), `processor`, `preprocessor`, `tokens`, the names
/// that `let` defined so far, and the functions
/// - `shape(role, tensor)`, and `has(role, prefix)`: whether the donor has a tensor with the prefix;
/// - `dtype(role)`: the floating-point type of most bytes of a donor as torch names it, `'bfloat16'`;
/// - `id_of(token)`: the id in the tokenizer of the result, null when it has no such token;
/// - `row_norm(role)`: the norm of rows of a donor's embedding as they enter the first layer, for which all of its values are read:
///   the root of the mean of their squares; null where they are zeros, or cannot be read or computed;
/// - `word_fit(from, to)`: the map between the embeddings of two donors, fitted on words that both vocabularies have, for which
///   their rows are read: the number of `words`, and of those `left_out`; the `cosine` of predicted rows with the words' own, the
///   same with `shuffled` words, and the `size` of predicted rows in proportion to theirs; `words` is 0 where there is none;
/// - `tried(host, part)`: the versions of transformers that ran a host of this model type with a part of this model type in the
///   tests of the program;
/// - `row_scale(role)`: the factor of a donor's class on embeddings of tokens, before the first layer;
/// - `image_fold(host, guest)`: the `factor` on the projector that keeps image features as large as in the host, under the
///   version that wrote it, when its class has the guest's language model; `trained` is what its own class multiplies them by; `with` and `without` list the versions of
///   transformers, of `--for` or all, that need the factor, or none.
/// - `head_factor(role)`: the `factor` on logits that the class of a language model alone has, and the `key` of its config that
///   states it; 1 and an empty key where none is known;
/// - `chat_template(guest, host)`: the guest's chat template, made to write what the host's processor needs for an image
///   (`image_turn` of its parts); null when the guest has none;
/// - `part(role, name)`: a part of a donor: its config with defaults (`config`), as it is written (`stored`), its JSON pointer
///   (`at`), its model type (`type`), the types that may stand there (`takes`), and the names of its `embedding` and `head`.
///
/// `tokenizer_config` is that of the donor whose tokenizer is used.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Name of the recipe on the command line.
    pub recipe: String,
    /// The result, as one line.
    pub summary: String,
    /// Roles of the donors.
    pub donors: Vec<DonorSpec>,
    /// Options of the recipe.
    #[serde(default)]
    pub options: Vec<OptionSpec>,
    /// Names for expressions, in order; each may use the names before it.
    #[serde(rename = "let", default)]
    pub lets: Vec<Let>,
    /// Processor and tokenizer of the result; `tokens` then holds the ids of the tokens that the processor adds.
    #[serde(default)]
    pub tokens: Option<TokenSpec>,
    /// A part that must be of the kind of the one whose place it takes, because the model keeps its class and its tokenizer.
    #[serde(default)]
    pub alike: Option<AlikeSpec>,
    /// Conditions that the donors must meet before the merge is planned.
    #[serde(default)]
    pub seams: Vec<SeamSpec>,
    /// JSON documents of the result.
    pub documents: Vec<DocumentSpec>,
    /// Tensors of the result; the first entry that matches a donor tensor applies.
    pub tensors: Vec<TensorSpec>,
    /// Other files of the result.
    #[serde(default)]
    pub files: Vec<FileSpec>,
    /// Notes in the report about decisions of the merge.
    #[serde(default)]
    pub notes: Vec<Note>,
    /// Rules whose findings on the result do not stop the merge, for a result that is meant to have the fault, such as tensor
    /// names that no class has. The findings are still reported, and the exit code is 1.
    #[serde(default)]
    pub tolerates: Vec<String>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    pub schema: Option<String>,
    /// The file that the recipe was read from.
    #[serde(skip)]
    pub origin: Origin,
}

/// The file of a recipe, and the files in its folder that it names.
#[derive(Debug, Clone, Default)]
pub struct Origin {
    /// Path of the file; `rules/recipes/…` for a built-in recipe.
    pub path: String,
    /// Text of the file.
    pub text: Cow<'static, str>,
    /// Templates in the folder of the file, by the paths that the recipe gives them.
    pub templates: BTreeMap<String, String>,
    /// The processor in the folder of the file that `tokens` names.
    pub processor: Option<Processor>,
}

/// A donor role.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DonorSpec {
    /// Name of the role on the command line.
    pub role: String,
    /// Description of the donor.
    pub what: String,
    /// Architectures that the donor may have; `["*"]` for a checkpoint of any class, also of an unknown one; empty for a
    /// directory that is not a checkpoint, whose errors do not count.
    #[serde(default)]
    pub architectures: Vec<String>,
    /// Parts that the donor must have, instead of `architectures`; `rules/parts/` describes the parts of models.
    #[serde(default)]
    pub parts: Vec<String>,
    /// Parts that the donor must not have, for the choice of a recipe.
    #[serde(default)]
    pub no_parts: Vec<String>,
    /// The part that the result has of the donor: faults of its other parts do not stop the merge. A template, which sees `opt`.
    #[serde(default)]
    pub only_part: Option<Template>,
    /// The part that the result does not have of the donor: its faults do not stop the merge. A template, which sees `opt`.
    #[serde(default)]
    pub without_part: Option<Template>,
    /// Whether the donor may be left out.
    #[serde(default)]
    pub optional: bool,
    /// Rules whose findings on this donor do not stop the merge, because the result does not have the fault.
    #[serde(default)]
    pub tolerates: Vec<String>,
}

impl DonorSpec {
    /// Whether errors of the donor stop the merge; otherwise it is a directory that only provides files.
    #[must_use]
    pub fn is_checkpoint(&self) -> bool {
        !self.architectures.is_empty() || !self.parts.is_empty()
    }

    /// Whether the role takes a checkpoint of any class.
    #[must_use]
    pub fn takes_any(&self) -> bool {
        self.architectures.iter().any(|name| name == ANY)
    }
}

/// The entry of `architectures` for a checkpoint of any class.
pub const ANY: &str = "*";

/// An option.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct OptionSpec {
    /// Name of the option on the command line.
    pub name: String,
    /// Effect of the option.
    pub help: String,
    /// Kind of the values; `choice` when missing and `values` is given, otherwise `size`.
    #[serde(default)]
    pub kind: Option<OptionKind>,
    /// Allowed values of a `choice`; one that ends in `:` takes a dotted module name after the colon, which expressions see as
    /// `arg.NAME`.
    #[serde(default)]
    pub values: Vec<String>,
    /// Default value.
    pub default: String,
}

impl OptionSpec {
    /// The kind of the values.
    #[must_use]
    pub fn kind(&self) -> OptionKind {
        self.kind.unwrap_or(if self.values.is_empty() { OptionKind::Size } else { OptionKind::Choice })
    }
}

/// Kind of the values of an option.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum OptionKind {
    /// One of `values`; expressions see a string.
    Choice,
    /// A size such as `5GB`, `300MiB` or `1000`; expressions see the text.
    Size,
    /// An integer; expressions see a number.
    Integer,
    /// A positive number; expressions see it.
    Number,
    /// Any text of one line; expressions see a string.
    Text,
}

impl OptionKind {
    /// The name in a recipe file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Choice => "choice",
            Self::Size => "size",
            Self::Integer => "integer",
            Self::Number => "number",
            Self::Text => "text",
        }
    }
}

/// Processor and tokenizer of the result.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TokenSpec {
    /// Role of the donor whose tokenizer is used.
    pub base: String,
    /// Name of a processor in `rules/processors/`, or the path of a `.json5` file below the folder of the recipe. When
    /// missing, as `of`, no token is added.
    #[serde(default)]
    pub processor: Option<String>,
    /// Role of the donor whose processor needs the tokens, instead of `processor`: `rules/parts/` names them.
    #[serde(default)]
    pub of: Option<String>,
}

/// A part that must have the model type, the vocabulary and the special tokens of the part whose place it takes. Any other part
/// stops the merge.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct AlikeSpec {
    /// Name of the part.
    pub part: Template,
    /// Role of the donor that has the new part.
    pub from: String,
    /// Role of the donor whose part it replaces.
    pub into: String,
    /// Names of the parts that are trained with a tokenizer; the model type of any part is compared.
    #[serde(default)]
    pub reads_text: Vec<String>,
    /// Recipes that exchange a part of another kind, for the error.
    #[serde(default)]
    pub otherwise: Vec<Exchange>,
}

/// A recipe that exchanges a part.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Exchange {
    /// Name of the part.
    pub part: String,
    /// Name of the recipe.
    pub recipe: String,
    /// Its roles, each with the role of this recipe that has the donor.
    pub roles: BTreeMap<String, String>,
}

/// A condition that the donors must meet.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SeamSpec {
    /// The condition.
    pub that: Expression,
    /// The mismatch, as one sentence.
    pub message: Template,
    /// Tensor that does not match.
    #[serde(default)]
    pub tensor: Option<SeamTensor>,
    /// Tensor that it must match.
    #[serde(default)]
    pub meets: Option<SeamTensor>,
    /// Shape that `tensor` would need.
    #[serde(default)]
    pub needed: Option<Expression>,
    /// Options that avoid the mismatch.
    #[serde(default)]
    pub options: Vec<String>,
}

/// A donor tensor that a seam names.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SeamTensor {
    /// Role of the donor.
    pub from: String,
    /// Name of the tensor in the donor.
    pub name: String,
}

/// A JSON document of the result.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DocumentSpec {
    /// File name; it ends in `.json`.
    pub name: FileName,
    /// Condition for writing the document.
    #[serde(default)]
    pub when: Option<Expression>,
    /// Role of the donor whose document is the starting point; an empty object if the donor has none.
    #[serde(default)]
    pub from: Option<String>,
    /// Whether the document is left out if the donor has none.
    #[serde(default)]
    pub optional: bool,
    /// Whether `Infinity` becomes the largest float32, as in the fix of JSN001; otherwise `Infinity` stops the merge.
    #[serde(default)]
    pub clamp_infinity: bool,
    /// Edits, in order.
    #[serde(default)]
    pub edits: Vec<DocumentEdit>,
}

/// Tensors that are taken from a donor, or left out.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TensorSpec {
    /// Role of the donor.
    pub from: String,
    /// Regular expression for tensor names of the donor; all when missing.
    #[serde(default)]
    pub names: String,
    /// An adapter of PEFT that is merged into the tensors. Every tensor of the adapter must have a place in them.
    #[serde(default)]
    pub adapter: Option<AdapterSpec>,
    /// Name of the part of the donor that the tensors belong to, as `rules/parts/` describes it.
    #[serde(default)]
    pub part: Option<Template>,
    /// Role of the donor in whose model the part is inserted: the tensors get its names for the same part.
    #[serde(default)]
    pub into: Option<String>,
    /// Whether the tensors get the names that they have in a model of the part alone.
    #[serde(default)]
    pub alone: bool,
    /// Whether a later entry may take the same tensors, so that each is there twice.
    #[serde(default)]
    pub also: bool,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
    /// Name in the result: a template, in which `$1` is the first group of `names`. The name of the donor when missing. With
    /// `into` or `alone`, it is the name inside the part.
    #[serde(rename = "as", default)]
    pub rename: Option<Template>,
    /// First row and number of rows of the donor that are used: a list of two integers. All rows when missing or null.
    #[serde(default)]
    pub slice: Option<Expression>,
    /// Treatment of a shape that does not match: an expression that gives `copy`, `pad`, `map`, `grow-rows`, `sample-rows`
    /// or `reinit`.
    #[serde(default)]
    pub fit: Option<Expression>,
    /// Factor on all values, except those of `reinit`: a number. None when missing, null or 1. With `part` and without
    /// `names`, it is a factor on what the part puts out, and so on the tensors of its last layer alone.
    #[serde(default)]
    pub scale: Option<Expression>,
    /// Type to which float16, bfloat16, float32 and float64 tensors are cast: one of these names. As stored when missing or
    /// null.
    #[serde(default)]
    pub dtype: Option<Expression>,
    /// Reason for leaving the tensors out.
    #[serde(default)]
    pub drop: Option<String>,
    /// Whether the tensors must be trained even if they are copied, as a projector in front of another language model. A
    /// tensor with padded, appended or new values is always one to train.
    #[serde(default)]
    pub train: bool,
    /// Donor tensor whose rows the new ones of `mean-like` and `sampled-like` are like.
    #[serde(default)]
    pub like: Option<SeamTensor>,
    /// The embeddings between which `map` leads.
    #[serde(default)]
    pub words: Option<WordsSpec>,
    /// Donor tensor that it must match, for the message.
    #[serde(default)]
    pub meets: Option<SeamTensor>,
    /// Options that avoid the mismatch.
    #[serde(default)]
    pub options: Vec<String>,
}

/// The map of `map`, fitted on words that the vocabularies of two donors share.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct WordsSpec {
    /// Role of the donor in whose embedding's space the values are.
    pub from: String,
    /// Role of the donor to whose embedding's space they are mapped.
    pub to: String,
    /// Whether each row of a matrix is a point there, as in an embedding; otherwise each column is a direction, as in the weight
    /// of a projector. A vector is a point.
    #[serde(default)]
    pub rows: bool,
    /// Factor on the values before they are mapped: a number. None when missing.
    #[serde(default)]
    pub times: Option<Expression>,
}

/// An adapter that is merged.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct AdapterSpec {
    /// Role of the donor that is the adapter.
    pub from: String,
    /// Last parts of the names of modules whose weight is stored `[in, out]`: a list. None when missing.
    #[serde(default)]
    pub turned: Option<Expression>,
}

/// A note in the report.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Note {
    /// Condition for this entry.
    pub when: Expression,
    /// The sentence.
    pub say: Template,
}

/// The key that names the classes of a checkpoint's own modules.
pub const AUTO_MAP: &str = "auto_map";

/// Config keys that make a loader download or run code; no document of a merge contains them, except an [`AUTO_MAP`]
/// that a recipe writes and that names modules of the result.
///
/// `trust_remote_code`: CVE-2026-5241. `_attn_implementation_internal` and related keys: CVE-2026-4372.
pub const CODE_SWITCHES: &[&str] = &[
    AUTO_MAP,
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
    /// [`DataError`] with the position.
    pub fn parse(path: &str, text: &str) -> Result<Self, DataError> {
        let origin = Origin { path: path.to_owned(), text: Cow::Owned(text.to_owned()), ..Origin::default() };
        Ok(Self { origin, ..source::parse(path, text)? })
    }

    /// The built-in recipes, by name.
    ///
    /// # Errors
    /// [`DataError`] for a malformed file; the tests parse all of them.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        let parse = |(path, text): (String, &'static str)| {
            let recipe: Self = source::parse_lazily(&path, text)?;
            let origin = Origin { path, text: Cow::Borrowed(text), ..Origin::default() };
            Ok(Self { origin, ..recipe })
        };
        source::embedded("recipes").into_iter().map(parse).collect()
    }

    /// Text of a template: the one in the folder of the recipe, or else the built-in one of this path.
    #[must_use]
    pub fn template(&self, path: &str) -> Option<&str> {
        self.origin.templates.get(path).map(String::as_str).or_else(|| source::text(&format!("recipes/{path}")))
    }

    /// The processor of `tokens`: the one in the folder of the recipe, or else the known one of this name.
    #[must_use]
    pub fn processor<'p>(&'p self, known: &'p [Processor]) -> Option<&'p Processor> {
        let name = self.tokens.as_ref()?.processor.as_ref()?;
        self.origin.processor.as_ref().or_else(|| known.iter().find(|processor| processor.processor == *name))
    }
}

/// A merge file: `build-merged merge.json5`. Paths in it are relative to its folder.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct MergeFile {
    /// Name or path of the recipe; chosen by the architectures of the donors when missing.
    #[serde(default)]
    pub recipe: Option<String>,
    /// Directory of each donor, by role.
    pub donors: Map<String, Value>,
    /// Options.
    #[serde(default)]
    pub options: Map<String, Value>,
    /// Directory of the result.
    pub out: String,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    pub schema: Option<String>,
}
