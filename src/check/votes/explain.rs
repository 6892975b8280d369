//! Load reports explained by votes: one wrong value of the config instead of a hundred tensors.

use crate::checkpoint::files;
use serde_json::Value;

use super::run::run;
use super::solve::{put_all, stretch};
use super::vote::Vote;
use crate::check::load::{self, Stored};
use crate::check::load::{LoadReport, SilentReason};
use crate::checkpoint::{Fault, FaultKind, Place};
use crate::knowledge::{Architecture, Expected};

/// The config values that cause what a load report lists.
#[derive(Debug, Clone)]
pub struct Explanation {
    /// The values of the config that stored tensors contradict, and that explain some of the report.
    pub votes: Vec<Vote>,
    /// The report after these were corrected.
    pub rest: LoadReport,
}

/// Explains a load report that is not clean by config values; `None` when no value explains any of it.
///
/// Only stored tensors count: where they are missing, the config may be right.
#[must_use]
pub fn explain(
    architecture: Architecture<'_>,
    config: &Value,
    expected: &Expected,
    stored: &Stored,
    report: &LoadReport,
) -> Option<Explanation> {
    let found = size(report);
    let renamed = report.raises.is_some() || report.silent.iter().any(|s| s.reason == SilentReason::PrefixHijack);
    // A quantised tensor has the shape that its scheme packs it into.
    if found == 0 || renamed || config.get("quantization_config").is_some_and(Value::is_object) {
        return None;
    }
    let outcome = run(architecture, config, stored, true)?;
    let votes: Vec<Vote> = outcome.outvoted().filter(|v| v.votes_for > v.votes_against).cloned().collect();
    let values: Vec<(String, Value)> = votes.iter().map(|v| (v.pointer.clone(), v.voted_value.clone())).collect();
    let mut corrected = put_all(config, &expected.config, &values);
    let built = load::build(architecture, &corrected, stored).ok().or_else(|| {
        for (pointer, value) in &values {
            stretch(&mut corrected, &expected.config, pointer, value);
        }
        load::build(architecture, &corrected, stored).ok()
    })?;
    let rest = load::predict(&built, stored);
    (size(&rest) < found && !votes.is_empty()).then_some(Explanation { votes, rest })
}

fn size(report: &LoadReport) -> usize {
    report.missing.len().saturating_add(report.unexpected.len()).saturating_add(report.mismatched.len())
}

/// A vote against the config as a fault for the rules.
#[must_use]
pub fn fault(vote: &Vote) -> Fault {
    let mut fault = Fault::new(FaultKind::ConfigOutvoted)
        .at(Place::file(files::CONFIG).pointer(&*vote.pointer))
        .with("key", vote.pointer.trim_start_matches('/').replace('/', "."))
        .with("given", vote.given)
        .with("said", vote.config_value.clone())
        .with("voted", vote.voted_value.clone())
        .with("agree", vote.votes_for)
        .with("total", vote.votes_for.saturating_add(vote.votes_against));
    let named: Vec<String> = vote.evidence.iter().map(ToString::to_string).collect();
    fault = fault.with("names", named);
    fault.places.extend(vote.evidence.iter().map(|w| Place::tensor(&*w.tensor)));
    fault
}
