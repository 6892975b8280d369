//! Why a class cannot be built from a config.

use std::fmt;

use super::doubt::Doubt;
use crate::knowledge::EvalError;

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
    /// A config that no loader could build, for this reason.
    pub(super) fn impossible(reason: impl Into<String>) -> Self {
        Self::Impossible(vec![reason.into()])
    }

    /// The same, found in the sub-config at `path`.
    pub(super) fn inside(self, path: &str) -> Self {
        match self {
            Self::Impossible(reasons) => {
                Self::Impossible(reasons.into_iter().map(|reason| format!("{path}: {reason}")).collect())
            }
            Self::Raises(_) | Self::NotCovered(_) => self,
            Self::UnknownPart(part) if part.config.is_empty() => {
                Self::UnknownPart(UnknownPart { config: path.to_owned(), ..part })
            }
            Self::UnknownPart(part) => {
                Self::UnknownPart(UnknownPart { config: format!("{path}.{}", part.config), ..part })
            }
        }
    }

    /// Whether a sentence mentions a name.
    pub(super) fn mentions(&self, name: &str) -> bool {
        matches!(self, Self::Impossible(reasons) if reasons.iter().any(|reason| reason.contains(name)))
    }
}

impl From<EvalError> for Refusal {
    fn from(e: EvalError) -> Self {
        Self::impossible(e.to_string())
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Impossible(reasons) => f.write_str(&reasons.join("; ")),
            Self::Raises(error) => write!(f, "the loader raises {error}"),
            Self::UnknownPart(part) => write!(f, "{part}"),
            Self::NotCovered(doubts) => {
                let words: Vec<String> = doubts.iter().map(ToString::to_string).collect();
                write!(f, "it is not known here: {}", words.join("; "))
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
