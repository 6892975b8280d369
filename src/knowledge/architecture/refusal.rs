//! Why a class cannot be built from a config.

use std::fmt;

use serde_json::Value;

use super::doubt::{Doubt, Setting};
use crate::knowledge::EvalError;

/// What building a class gives.
pub(super) type BuildResult<T> = Result<T, Refusal>;

/// Why a class cannot be built from a config: the config is at fault, or too little is known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Refusal {
    /// No loader could build it: a sentence for each fault of the config.
    Impossible(Vec<String>),
    /// This loader raises: the exception as it says it.
    Raises(String),
    /// A part of the model is not known here. The config may be right.
    UnknownPart(UnknownPart),
    /// The description does not cover this config, and fails on it. The config may be right.
    NotCovered(Vec<Doubt>),
}

/// A part of a model that is not known here.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct UnknownPart {
    /// Dotted path of the sub-config that governs it; empty for the config itself.
    pub config: String,
    /// Its model type, when that is what is not known.
    pub model_type: Option<String>,
    /// Its class, when that is what is not known.
    pub class: Option<String>,
}

impl Refusal {
    /// A config that the description does not cover, for this reason.
    pub(super) fn uncovered(reason: impl Into<String>) -> Self {
        Self::NotCovered(vec![Doubt::Corner(reason.into())])
    }

    /// A config that the description does not cover because a key has this value, or is absent.
    pub(super) fn setting(key: &str, value: Option<&Value>) -> Self {
        Self::NotCovered(vec![Doubt::Values(vec![Setting { key: key.to_owned(), value: value.cloned() }])])
    }

    /// A config that no loader could build, for this reason.
    pub(super) fn impossible(reason: impl Into<String>) -> Self {
        Self::Impossible(vec![reason.into()])
    }

    /// Whether the description knows where it ends, and ends there.
    pub(super) fn is_corner(&self) -> bool {
        matches!(self, Self::NotCovered(doubts) if doubts.iter().any(|doubt| matches!(doubt, Doubt::Corner(_))))
    }

    /// The same with what else the description does not cover, which may be the reason.
    pub(super) fn or_doubts(self, others: Vec<Doubt>) -> Self {
        let own = match self {
            Self::NotCovered(doubts) => doubts,
            _ if others.is_empty() => return self,
            _ => Vec::new(),
        };
        let mut doubts = own;
        let is_named = |doubts: &[Doubt], other: &Doubt| doubts.iter().any(|doubt| doubt.pointer() == other.pointer());
        for other in others {
            if other.pointer().is_none() || !is_named(&doubts, &other) {
                doubts.push(other);
            }
        }
        Self::NotCovered(doubts)
    }

    /// The same, found in the sub-config at `path`.
    pub(super) fn inside(self, path: &str) -> Self {
        match self {
            Self::Impossible(reasons) => {
                Self::Impossible(reasons.into_iter().map(|reason| format!("{path}: {reason}")).collect())
            }
            Self::Raises(_) => self,
            Self::NotCovered(doubts) => Self::NotCovered(doubts.into_iter().map(|doubt| doubt.inside(path)).collect()),
            Self::UnknownPart(part) if part.config.is_empty() => {
                Self::UnknownPart(UnknownPart { config: path.to_owned(), ..part })
            }
            Self::UnknownPart(part) => {
                Self::UnknownPart(UnknownPart { config: format!("{path}.{}", part.config), ..part })
            }
        }
    }
}

impl From<EvalError> for Refusal {
    fn from(e: EvalError) -> Self {
        Self::NotCovered(vec![Doubt::Expression(e.expression)])
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Impossible(reasons) => f.write_str(&reasons.join("; ")),
            Self::Raises(error) => write!(f, "the loader raises {error}"),
            Self::UnknownPart(part) => write!(f, "{part}"),
            Self::NotCovered(doubts) => {
                let mut words: Vec<String> = doubts.iter().map(ToString::to_string).collect();
                words.dedup();
                let fails = |doubt: &Doubt| matches!(doubt, Doubt::Values(_) | Doubt::Expression(_));
                let start = if doubts.iter().any(fails) { "" } else { "it is not known here: " };
                write!(f, "{start}{}", words.join("; "))
            }
        }
    }
}

/// `text_config (model type mamba) is not known here`.
impl fmt::Display for UnknownPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let config = if self.config.is_empty() { "a part" } else { &self.config };
        match (&self.class, &self.model_type) {
            (Some(class), _) => write!(f, "{config} (class {class}) is not known here"),
            (None, Some(model_type)) => write!(f, "{config} (model type {model_type}) is not known here"),
            (None, None) => write!(f, "{config} is not known here"),
        }
    }
}
