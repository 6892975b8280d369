//! Rules: what to look for, why it matters and what to say; one JSON5 file each.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

mod fix;

pub use fix::{BuiltInRepair, EditSpec, Fix, Safety};

use super::expression::{Expression, Template};
use super::source::{self, DataError};
use crate::checkpoint::FaultKind;

/// How bad a finding is; a rule says it for all of its findings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Worth knowing; nothing needs doing.
    Info,
    /// Probably unintended, or will hurt later.
    Warning,
    /// Will not load, or loads wrong weights.
    Error,
}

impl Severity {
    /// The word used in output.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Info => "info",
            Self::Warning => "warning",
            Self::Error => "error",
        }
    }
}

/// A rule as its file in `rules/checks/` gives it.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// Family and number: `IDX003`.
    pub code: String,
    /// What is wrong, in kebab case: `shard-missing`.
    pub name: String,
    /// How bad it is.
    pub severity: Severity,
    /// One line.
    pub summary: String,
    /// Why it matters: what a loader does with it.
    pub why: String,
    /// Architectures it is about; empty for all.
    #[serde(default)]
    pub applies: Vec<String>,
    /// When it is worth asking at all; an expression that cannot be evaluated counts as no.
    #[serde(default)]
    pub when: Option<Expression>,
    /// What to look for.
    pub check: Check,
    /// The finding's sentence.
    pub message: Template,
    /// What can be done: of several, the first whose `when` holds and whose edits can be made; else its help alone.
    #[serde(default, rename = "fix", deserialize_with = "fix::one_or_many")]
    #[cfg_attr(test, schemars(with = "fix::OneOrMany"))]
    pub fixes: Vec<Fix>,
    /// Where the facts come from.
    #[serde(default)]
    pub references: Vec<String>,
    /// The file it was read from, for a user's own rule.
    #[serde(skip)]
    pub origin: Option<String>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    pub schema: Option<String>,
}

/// The kinds of check. Adding a rule rarely needs another.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Check {
    /// Reports faults of some kinds.
    Fault(FaultCheck),
    /// Reports where an expression is false.
    Assert(Assert),
}

/// Faults of these kinds become findings; the message sees each fault's `kind` and details as variables,
/// and `file`, `tensor`, `pointer` of its first place.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct FaultCheck {
    /// Kinds of fault.
    #[serde(deserialize_with = "fault_kinds")]
    pub kinds: Vec<FaultKind>,
    /// Only faults for which this holds; it sees what the message sees.
    #[serde(default)]
    pub only: Option<Expression>,
    /// One finding for all of them instead of one each; the message sees the first one's details and `count`.
    #[serde(default)]
    pub group: bool,
}

/// A condition that must hold.
///
/// Expressions see the documents as `config`, `generation`, `processor`, `preprocessor`,
/// `tokenizer_config`, `special_tokens` (null when absent or broken), `model` (the config with the
/// class's defaults filled in), `text` (its language part), `arch`, `rows` (of the token embedding),
/// `tokenizer` (`length`, `base`, `class`, `source`, `json_base`, `model_base`, `bos`, `eos`, `pad`,
/// `highest` id), `chat_templates` (by file),
/// `tokens` (what the processor makes of it, by the names in `rules/processors/`, with `length` and
/// `scattered`), `processor_tokenizers`, `directory`, `has_weights`, `all_read` (every shard is there and
/// its header was read), `loaders` (the versions it has to load under), and the functions `shape(tensor)`,
/// `has_tensor(prefix)`, `has_file(name)`, `id_of(token)`, `stays_random(tensor)` (a loader starts it at random; null
/// when the class is unknown). A condition that cannot be evaluated because a value is not there is not a finding.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Assert {
    /// A list; the condition is asked for each element, bound as `it`.
    #[serde(default)]
    pub each: Option<Expression>,
    /// The condition.
    pub that: Expression,
    /// Where to point when it does not hold.
    #[serde(default)]
    pub at: Vec<At>,
}

/// A place named by a rule.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct At {
    /// File name.
    pub file: Option<Template>,
    /// JSON pointer.
    pub pointer: Option<Template>,
    /// Tensor name.
    pub tensor: Option<Template>,
}

/// Rules, by code.
#[derive(Debug, Clone, Default)]
pub struct RuleSet {
    /// Those that are asked, sorted by code.
    pub rules: Vec<Rule>,
    /// Those that were not chosen.
    pub unselected: Vec<Rule>,
}

impl RuleSet {
    /// The rules inside the program.
    ///
    /// # Errors
    /// [`DataError`] naming the file and the place; the house tests see to it that there is none.
    pub fn embedded() -> Result<Self, DataError> {
        let parse = |(path, text): (String, &str)| Ok((source::parse_embedded(&path, text)?, path));
        Self::default().with(source::embedded("checks").into_iter().map(parse))
    }

    /// Rules from named texts.
    ///
    /// # Errors
    /// [`DataError`] for a text that is no rule, a code given twice, or a file or repair that does not exist.
    pub fn from_files<'a>(files: impl IntoIterator<Item = (String, &'a str)>) -> Result<Self, DataError> {
        Self::default().and_files(files)
    }

    /// These rules and others from named texts.
    ///
    /// # Errors
    /// As [`Self::from_files`]; a code or a name that these rules have is taken.
    pub fn and_files<'a>(self, files: impl IntoIterator<Item = (String, &'a str)>) -> Result<Self, DataError> {
        self.with(files.into_iter().map(|(path, text)| {
            let rule: Rule = source::parse(&path, text)?;
            Ok((Rule { origin: Some(path.clone()), ..rule }, path))
        }))
    }

    /// Every rule, chosen or not.
    pub fn all(&self) -> impl Iterator<Item = &Rule> {
        self.rules.iter().chain(&self.unselected)
    }

    fn with(mut self, files: impl Iterator<Item = Result<(Rule, String), DataError>>) -> Result<Self, DataError> {
        for file in files {
            let (rule, path) = file?;
            let wrong = |reason: String| Err(DataError::new(&path, reason));
            if !is_code(&rule.code) {
                return wrong(format!("`{}` is no code: capitals for the family, then digits, as IDX005", rule.code));
            }
            for edit in rule.fixes.iter().flat_map(|f| &f.edits) {
                if let Err(reason) = edit.check() {
                    return wrong(reason);
                }
            }
            if let Some(twin) = self.rules.iter().find(|r| r.code == rule.code || r.name == rule.name) {
                return wrong(format!("{} {} is already taken by {} {}", rule.code, rule.name, twin.code, twin.name));
            }
            self.rules.push(rule);
        }
        self.rules.sort_by(|a, b| a.code.cmp(&b.code));
        Ok(self)
    }
}

/// Whether a rule can be chosen by this code, and by the start of it.
fn is_code(code: &str) -> bool {
    let family = code.trim_end_matches(|c: char| c.is_ascii_digit());
    (2..=8).contains(&family.len())
        && family.bytes().all(|b| b.is_ascii_uppercase())
        && (1..=8).contains(&code.len().saturating_sub(family.len()))
}

/// Kinds of fault by their names; the error for an unknown one suggests the nearest name.
fn fault_kinds<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<FaultKind>, D::Error> {
    let names = Vec::<String>::deserialize(deserializer)?;
    let kind = |name: &String| {
        FaultKind::from_name(name).ok_or_else(|| {
            let near = source::nearest(name, FaultKind::ALL.iter().map(|kind| kind.name()));
            let hint = near.map(|near| format!("; did you mean `{near}`?")).unwrap_or_default();
            D::Error::custom(format!("there is no kind of fault `{name}`{hint}"))
        })
    };
    names.iter().map(kind).collect()
}
