//! What a rule found: the unit every report is made of.

use std::ops::Range;

use serde::Serialize;
use serde_json::{Map, Value};

use super::fix::FixHint;
pub use crate::knowledge::rule::Severity;

/// Where a finding points: a file, a place in it, a tensor.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
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
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Finding {
    /// Rule code, `CFG004`.
    pub code: String,
    /// Rule name in kebab case; it states the fault.
    pub name: String,
    /// Severity.
    pub severity: Severity,
    /// One sentence that names the cause, with the figures at hand.
    pub message: String,
    /// Places; empty if the finding concerns the whole checkpoint.
    pub locations: Vec<Location>,
    /// The figures behind the message.
    pub evidence: Map<String, Value>,
    /// The fix, or the manual step.
    pub fix: Option<FixHint>,
}

/// A finding that settings or a baseline accept.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Suppressed {
    /// The finding.
    #[serde(flatten)]
    pub finding: Finding,
    /// The suppression that accepts it.
    pub accepted: Accepted,
}

/// The origin of a suppression.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Accepted {
    /// `ckpt-doctor.json5: suppress[0]`, or the name of a baseline.
    pub by: String,
    /// The reason given there; missing for a baseline.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// A rule that was skipped for a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Skipped {
    /// Rule code.
    pub code: String,
    /// The reason.
    pub why: String,
}
