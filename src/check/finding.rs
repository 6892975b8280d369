//! Findings: what rules report, and load reports.

use std::ops::Range;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::fix::FixHint;
use crate::checkpoint::untold;
pub use crate::knowledge::rule::{Consequence, Object, Severity};

/// Where a finding points: a file, a place in it, a tensor.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
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
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub span: Option<Range<usize>>,
}

/// One finding of one rule.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Finding {
    /// Rule code, `IDX005`.
    pub code: String,
    /// Rule name in kebab case; it states the fault.
    pub name: String,
    /// Severity.
    pub severity: Severity,
    /// One sentence that names the cause, with figures.
    pub message: String,
    /// Further facts, one sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub details: Vec<String>,
    /// What loaders of the run do because of it, the leading ones first.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub effects: Vec<FindingEffect>,
    /// Places; empty if the finding concerns the whole checkpoint.
    pub locations: Vec<Location>,
    /// The figures behind the message.
    pub evidence: Map<String, Value>,
    /// The fix, or the manual step.
    pub fix: Option<FixHint>,
    /// Further findings of the rule that are counted and not listed, because one file or one checkpoint has too many.
    #[serde(skip_serializing_if = "is_zero", default)]
    pub hidden: u64,
    /// Whether the rule is a note, which the header shows.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub note: bool,
}

impl Finding {
    /// Whether it states what was not checked, and no effect or setting made it more than information. Formats for people
    /// print it in the header of the checkpoint.
    pub(crate) fn is_note(&self) -> bool {
        self.note && self.severity == Severity::Info
    }

    /// The number of findings that it counts for: itself, and the hidden ones.
    #[must_use]
    pub fn count(&self) -> usize {
        usize::try_from(self.hidden).unwrap_or(usize::MAX).saturating_add(1)
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature that serde calls")]
const fn is_zero(n: &u64) -> bool {
    *n == 0
}

/// What one loader does with one object because of a finding.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct FindingEffect {
    /// The object that fails.
    pub object: Object,
    /// Version of transformers that was read for this effect: `4.47.0`; or another program with its version: `vllm 0.19.1`.
    pub loader: String,
    /// The version that the user named, or that wrote config.json, when `loader` stands for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stands_for: Option<String>,
    /// How the object fails.
    pub outcome: Consequence,
    /// The exception with its message, or what becomes wrong.
    pub text: String,
}

/// A finding that settings or a baseline accept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Suppressed {
    /// The finding.
    #[serde(flatten)]
    pub finding: Finding,
    /// The suppression that accepts it.
    pub accepted: Accepted,
}

/// The origin of a suppression.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Accepted {
    /// `ckpt-doctor.json5: suppress[0]`, or the name of a baseline.
    pub by: String,
    /// The reason given there; missing for a baseline.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// A rule that was skipped for a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skipped {
    /// Rule code.
    pub code: String,
    /// The reason.
    pub why: String,
}
