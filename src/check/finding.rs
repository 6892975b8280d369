//! Findings: what rules report, and load reports.

use std::ops::Range;

use serde::Serialize;
use serde_json::{Map, Value};

use super::fix::FixHint;
pub use crate::knowledge::rule::Severity;

/// Where a finding points: a file, a place in it, a tensor.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct Location {
    /// File name within the checkpoint.
    pub file: Option<String>,
    /// Line, from 1.
    pub line: Option<usize>,
    /// Column in characters, from 1.
    pub column: Option<usize>,
    /// JSON pointer (RFC 6901).
    pub pointer: Option<String>,
    /// Tensor name.
    pub tensor: Option<String>,
    /// Byte range in the file, for renderers that show the source.
    #[serde(skip)]
    pub span: Option<Range<usize>>,
}

/// One finding of one rule.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Rule code, `IDX005`.
    pub code: String,
    /// Rule name in kebab case; it states the fault.
    pub name: String,
    /// How bad it is.
    pub severity: Severity,
    /// One sentence that names the cause, with the figures at hand.
    pub message: String,
    /// Further facts, one sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub details: Vec<String>,
    /// Where; may be empty for the whole checkpoint.
    pub locations: Vec<Location>,
    /// The figures the message was made from.
    pub evidence: Map<String, Value>,
    /// What can be done.
    pub fix: Option<FixHint>,
}

/// A finding that is accepted, and not counted.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Suppressed {
    /// What was found.
    #[serde(flatten)]
    pub finding: Finding,
    /// Why it is accepted.
    pub accepted: Accepted,
}

/// Why a finding is not counted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Accepted {
    /// Where that is written: `ckpt-doctor.json5: suppress[0]`, or the name of a baseline.
    pub by: String,
    /// The reason given there; none in a baseline.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// A rule that was not asked of a checkpoint, or could not be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Skipped {
    /// Rule code.
    pub code: String,
    /// Why.
    pub why: String,
}

/// Lists of what a loader would say of the state dict; names are spelled as it spells them.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct LoadReport {
    /// Version of transformers that was read for this prediction: `4.47.0`.
    pub loader: String,
    /// The version that was asked for, or that config.json names, when this one stands for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stands_for: Option<String>,
    /// Expected by the model class, not provided: newly initialised.
    pub missing: Vec<String>,
    /// Provided, not part of the model: ignored.
    pub unexpected: Vec<String>,
    /// In both, with different shapes: the load raises.
    pub mismatched: Vec<Mismatch>,
    /// Wrong, and reported by nobody.
    pub silent: Vec<Silent>,
    /// The exception the loader stops with before it reports any list.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub raises: Option<String>,
}

impl LoadReport {
    /// Whether every tensor of the class comes from the checkpoint.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        self.missing.is_empty() && self.mismatched.is_empty() && self.raises.is_none()
    }

    /// Whether a tensor of the class keeps its random start, reported or not.
    #[must_use]
    pub fn leaves_random(&self, name: &str) -> bool {
        let absent = |silent: &Silent| silent.reason == "indexed-but-absent" && silent.name == name;
        self.missing.iter().any(|missing| missing == name) || self.silent.iter().any(absent)
    }

    /// Whether two loaders say the same.
    #[must_use]
    pub fn agrees(&self, other: &Self) -> bool {
        let said = |r: &Self| Self { loader: String::new(), stands_for: None, ..r.clone() };
        said(self) == said(other)
    }

    /// The version it is for: `5.23.0`, or `4.51.3 (judged as 4.47.0)`.
    #[must_use]
    pub fn version(&self) -> String {
        let version = |asked: &String| format!("{asked} (judged as {})", self.loader);
        self.stands_for.as_ref().map_or_else(|| self.loader.clone(), version)
    }
}

/// A tensor whose stored shape is not the expected one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Mismatch {
    /// State-dict name.
    pub name: String,
    /// Shape in the file.
    pub stored: Vec<u64>,
    /// Shape the class builds from the config.
    pub expected: Vec<u64>,
}

/// A tensor that loads wrong without any message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Silent {
    /// State-dict name.
    pub name: String,
    /// Why: one of `indexed-but-absent`, `prefix-hijack`, `tied-over`.
    pub reason: String,
    /// The tensor whose values it gets instead, when it is tied to one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
}
