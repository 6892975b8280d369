//! The result of checking a checkpoint.

use serde_json::Value;

use super::finding::{Finding, Skipped, Suppressed};
use super::load::LoadReport;
use super::votes::Vote;

/// The result of checking a checkpoint.
#[derive(Debug, Clone, Default)]
pub struct Outcome {
    /// Architecture the load reports were predicted with.
    pub architecture: Option<String>,
    /// Sorted by file, place and code.
    pub findings: Vec<Finding>,
    /// One for each loader that was asked; none when the architecture is unknown or there are no weights to speak of.
    pub loads: Vec<LoadReport>,
    /// The config with the class's defaults filled in; null when the architecture is unknown.
    pub config: Value,
    /// Values of config.json that stored tensors contradict.
    pub votes: Vec<Vote>,
    /// Findings that settings accept, in the order of the others.
    pub suppressed: Vec<Suppressed>,
    /// Rules that did not apply, or were not chosen.
    pub skipped: Vec<Skipped>,
    /// Rules of the user's own that cannot be used, and why: they take more steps than a rule may, or name what there is
    /// not.
    pub unusable: Vec<Skipped>,
}
