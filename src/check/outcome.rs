//! The result of checking a checkpoint.

use serde_json::Value;

use super::finding::{Finding, Skipped, Suppressed};
use super::load::LoadReport;
use super::verdict::PredictedLoad;
use super::votes::Vote;

/// The result of checking a checkpoint.
#[derive(Debug, Clone, Default)]
pub struct Outcome {
    /// Architecture the load reports were predicted with.
    pub architecture: Option<String>,
    /// Sorted by file, place and code.
    pub findings: Vec<Finding>,
    /// What each loader of the run does, the leading ones first.
    pub verdicts: Vec<PredictedLoad>,
    /// A report for each loader; none when the architecture is unknown or no tensor name was read.
    pub loads: Vec<LoadReport>,
    /// The config with the class's defaults filled in; null when the architecture is unknown.
    pub config: Value,
    /// Values of config.json that stored tensors contradict.
    pub votes: Vec<Vote>,
    /// Findings that settings accept, in the order of the others.
    pub suppressed: Vec<Suppressed>,
    /// Rules that were skipped, with the reason.
    pub skipped: Vec<Skipped>,
    /// Rules of the user that cannot be used, with the reason: one exceeds the evaluation limit, or names an unknown variable.
    pub unusable: Vec<Skipped>,
}
