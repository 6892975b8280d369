//! What a rule found: the unit every report is made of.

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
    /// Rule code, `CFG004`.
    pub code: String,
    /// Rule name in kebab case; it states the fault.
    pub name: String,
    /// How bad it is.
    pub severity: Severity,
    /// One sentence that names the cause, with the figures at hand.
    pub message: String,
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
