//! The `fix` of a rule: what can be done, how safe that is, and the edits that do it.

use std::fmt;

use serde::de::{SeqAccess, Visitor, value::MapAccessDeserializer};
use serde::{Deserialize, Deserializer, Serialize};

use super::super::expression::{Expression, Template};
use super::super::source;

/// How safe a fix is, as ruff grades it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Safety {
    /// Restores bookkeeping; every tensor and value a loader reads stays.
    Safe,
    /// Changes what a loader would compute, on strong evidence.
    Unsafe,
    /// The information is not here; the exact next step is shown.
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

/// What can be done about a finding.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Fix {
    /// How safe it is.
    pub safety: Safety,
    /// The step, as an imperative sentence.
    pub help: Template,
    /// When this is the fix; it sees what the message sees, and what cannot be evaluated counts as no.
    #[serde(default)]
    pub when: Option<Expression>,
    /// A list; the edits are made for each element, bound as `one`.
    #[serde(default)]
    pub each: Option<Expression>,
    /// What `check --fix` does; none for a manual fix. All of them are made, or none.
    #[serde(default)]
    pub edits: Vec<EditSpec>,
}

/// An edit as a rule gives it. Names and expressions see what the message sees.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum EditSpec {
    /// Gives a value of a JSON document another, or adds it.
    Set {
        /// File name.
        file: Template,
        /// JSON pointer; what a name in it has of `~` and `/` is written `~0` and `~1`.
        pointer: Template,
        /// The value.
        to: Expression,
    },
    /// Takes a member of a JSON document away.
    Remove {
        /// File name.
        file: Template,
        /// JSON pointer.
        pointer: Template,
    },
    /// Puts text in place of the characters that the finding points at.
    Replace {
        /// The text; empty to take them away.
        with: Template,
    },
    /// Gives tensors whose names start so another start, in the shards and in the index: pairs of how names start and how
    /// they start afterwards, of which the first that fits a name counts.
    Rename(Expression),
    /// Adds a file from `rules/recipes/`, under a name that must be free.
    Write {
        /// File name.
        file: Template,
        /// Path below `rules/recipes/`.
        text: String,
    },
    /// A repair that needs more than an expression.
    Repair(BuiltInRepair),
}

impl EditSpec {
    /// Whether what it names exists; the error says what does not.
    pub(super) fn check(&self) -> Result<(), String> {
        match self {
            Self::Write { text, .. } if source::text(&format!("recipes/{text}")).is_none() => {
                Err(format!("no such file: rules/recipes/{text}"))
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
    /// Cuts off the NUL bytes at the end of a document.
    CutNulBytes,
    /// Removes the second of two equal members, key and value.
    DropEqualKey,
    /// Adds the entries that `added_tokens_decoder` lacks and another tokenizer file has.
    FillTokenHoles,
    /// Puts a single-quoted string in double quotes.
    QuoteString,
    /// Rebuilds the index from the shard headers.
    RebuildIndex,
    /// Writes a document in UTF-8 that is in another encoding.
    Reencode,
    /// Writes the header of a shard again.
    WriteHeader,
}

impl BuiltInRepair {
    /// Every repair, in the order of their names.
    pub const ALL: &[Self] = &[
        Self::AddAutoClass,
        Self::AddImports,
        Self::CutNulBytes,
        Self::DropEqualKey,
        Self::FillTokenHoles,
        Self::QuoteString,
        Self::RebuildIndex,
        Self::Reencode,
        Self::WriteHeader,
    ];
}

/// The two ways to write fixes, for the schema.
#[cfg(test)]
#[derive(schemars::JsonSchema)]
#[schemars(untagged)]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) enum OneOrMany {
    One(Fix),
    Many(Vec<Fix>),
}

/// The fixes of a rule: one, or a list of which the first that fits is taken.
pub(super) fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Fix>, D::Error> {
    // An untagged enum would do, but its errors have neither line nor cause.
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
