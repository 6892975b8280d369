//! Fixes of a rule: safety, title, advice, and the edits that `check --fix` makes.

use std::fmt;

use serde::de::{SeqAccess, Visitor, value::MapAccessDeserializer};
use serde::{Deserialize, Deserializer, Serialize};

use super::super::expression::{Expression, Template};
use super::super::source;

/// Safety of a fix, with the grades of ruff.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Safety {
    /// Restores bookkeeping: every tensor and every value that a loader reads stays, and no trace of a loss is erased.
    Safe,
    /// Changes what a loader reads or runs, on strong evidence; applied with `--unsafe-fixes`.
    Unsafe,
    /// Needs information that the checkpoint does not contain; `help` states the next step.
    Manual,
}

impl Safety {
    /// The word used in output.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Safe => "safe",
            Self::Unsafe => "unsafe",
            Self::Manual => "manual",
        }
    }
}

/// A fix of a rule.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Fix {
    /// Safety of the edits; `manual` without edits.
    pub safety: Safety,
    /// What the edits do, as an imperative; required with edits. `check --fix` prints it as what was done.
    #[serde(default)]
    pub title: Option<Template>,
    /// What a person should do, as an imperative; required without edits. With edits: what to do besides them.
    #[serde(default)]
    pub help: Option<Template>,
    /// Condition for this fix; an expression that cannot be evaluated counts as false.
    #[serde(default)]
    pub when: Option<Expression>,
    /// Condition under which the fix rests on the description of the class, as a vote or a rename does: then it is made only
    /// if every leading loader takes all tensors of the class from the repaired checkpoint and leaves none over.
    #[serde(default)]
    pub needs_whole_load: Option<Expression>,
    /// A list; the edits are made for each element, bound as `one`.
    #[serde(default)]
    pub each: Option<Expression>,
    /// What `check --fix` does: all of these edits, or none.
    #[serde(default)]
    pub edits: Vec<EditSpec>,
}

impl Fix {
    /// Checks that title, help, safety and edits belong together, and that the edits refer to what exists.
    pub(super) fn check(&self) -> Result<(), String> {
        match (self.edits.is_empty(), self.safety == Safety::Manual) {
            (true, false) => return Err(format!("a fix without edits is manual, not {}", self.safety.name())),
            (false, true) => return Err("a manual fix has no edits".to_owned()),
            (true, true) if self.needs_whole_load.is_some() => {
                return Err("a manual fix needs no load as its proof".to_owned());
            }
            _ => {}
        }
        match (self.edits.is_empty(), &self.title, &self.help) {
            (true, Some(_), _) => return Err("a fix without edits has a `help` and no `title`".to_owned()),
            (true, None, None) => return Err("a fix without edits needs a `help`: what a person should do".to_owned()),
            (false, None, _) => return Err("a fix with edits needs a `title`: what the edits do".to_owned()),
            _ => {}
        }
        self.edits.iter().try_for_each(EditSpec::check)
    }
}

/// An edit of a fix. Its templates and expressions see the variables of the message.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum EditSpec {
    /// Sets a value of a JSON document; adds it when missing.
    Set {
        /// File name.
        file: Template,
        /// JSON pointer (RFC 6901).
        pointer: Template,
        /// The new value.
        to: Expression,
    },
    /// Removes a member of a JSON document.
    Remove {
        /// File name.
        file: Template,
        /// JSON pointer.
        pointer: Template,
    },
    /// Replaces the characters that the finding points at.
    Replace {
        /// The new text; empty to delete them.
        with: Template,
    },
    /// Replaces prefixes of tensor names, in the shards and in the index: a list of pairs of old and new prefix, of which
    /// the first that matches a name applies.
    Rename(Expression),
    /// Adds a file from `rules/recipes/`; the checkpoint must not have a file of that name.
    Write {
        /// File name.
        file: Template,
        /// Path below `rules/recipes/`.
        text: String,
    },
    /// Adds a JSON document; the checkpoint must not have a file of that name.
    Create {
        /// File name.
        file: Template,
        /// The value of the document, an object.
        to: Expression,
    },
    /// Runs one of the repairs that need more than an expression.
    Repair(BuiltInRepair),
}

impl EditSpec {
    /// Checks that a repair or a file that the edit names exists.
    fn check(&self) -> Result<(), String> {
        match self {
            Self::Write { text, .. } if source::text(&format!("recipes/{text}")).is_none() => {
                Err(format!("missing file: rules/recipes/{text}"))
            }
            _ => Ok(()),
        }
    }
}

/// A repair that needs more than an expression; `src/check/fix/repairs.rs` implements each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum BuiltInRepair {
    /// Adds to `auto_map` the class that the modules define for a key.
    AddAutoClass,
    /// Adds to a module the imports of the modules that it imports.
    AddImports,
    /// Replaces `Infinity` with the largest float32.
    ClampInfinity,
    /// Cuts off the NUL bytes at the end of a document.
    CutNulBytes,
    /// Removes the second of two equal members, key and value.
    DropEqualKey,
    /// Adds the entries that `added_tokens_decoder` lacks and another tokenizer file has.
    FillTokenHoles,
    /// Moves the values of `text_config` to the top of config.json.
    FlattenTextConfig,
    /// Writes the merges of tokenizer.json as strings with a blank.
    JoinMerges,
    /// Puts a single-quoted string in double quotes.
    QuoteString,
    /// Rebuilds the index from the shard headers.
    RebuildIndex,
    /// Writes a document in UTF-8 that is in another encoding.
    Reencode,
    /// Writes the header of a shard again.
    WriteHeader,
}

#[cfg(feature = "internals")]
impl BuiltInRepair {
    /// Every repair, in the order of their names.
    pub const ALL: &[Self] = &[
        Self::AddAutoClass,
        Self::AddImports,
        Self::ClampInfinity,
        Self::CutNulBytes,
        Self::DropEqualKey,
        Self::FillTokenHoles,
        Self::FlattenTextConfig,
        Self::JoinMerges,
        Self::QuoteString,
        Self::RebuildIndex,
        Self::Reencode,
        Self::WriteHeader,
    ];
}

/// A fix or a list of fixes.
#[cfg(test)]
#[derive(schemars::JsonSchema)]
#[schemars(untagged)]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) enum OneOrMany {
    One(Fix),
    Many(Vec<Fix>),
}

/// Deserialises the `fix` of a rule: one fix or a list.
pub(super) fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Fix>, D::Error> {
    // The errors of an untagged enum have neither line nor cause.
    struct Fixes;
    impl<'de> Visitor<'de> for Fixes {
        type Value = Vec<Fix>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a fix or a list of fixes")
        }

        fn visit_map<A: serde::de::MapAccess<'de>>(self, map: A) -> Result<Self::Value, A::Error> {
            Ok(vec![Fix::deserialize(MapAccessDeserializer::new(map))?])
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Value, A::Error> {
            let mut fixes = Vec::new();
            while let Some(fix) = items.next_element()? {
                fixes.push(fix);
            }
            Ok(fixes)
        }
    }
    deserializer.deserialize_any(Fixes)
}
