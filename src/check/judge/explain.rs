//! The fourth stage: causes of what a load report lists. One wrong prefix or config value explains many tensors.

use super::predict::{Prediction, finished};
use super::{Inputs, class_key, remembered};
use crate::check::load::{self, LoadReport, Moved};
use crate::check::votes::{self, Explanation, Vote};
use crate::checkpoint::Fault;

/// A prediction with the causes of what it lists.
pub(super) struct ExplainedLoad<'a> {
    pub(super) prediction: Prediction<'a>,
    /// A fault for each prefix under which tensors of the class are stored.
    pub(super) prefixes: Vec<Fault>,
    /// The config values that explain the report, and what would remain if they and the prefixes were corrected; `None`
    /// when nothing is explained.
    pub(super) explanation: Option<Explanation>,
}

impl ExplainedLoad<'_> {
    /// Version of the loader.
    pub(super) const fn loader(&self) -> &'static str {
        self.prediction.target.loader.version()
    }

    /// The config values that explain the report.
    pub(super) fn votes(&self) -> Option<&[Vote]> {
        self.explanation.as_ref().map(|explained| explained.votes.as_slice())
    }

    /// The part of the report that has no known cause.
    pub(super) fn unexplained(&self) -> Option<&LoadReport> {
        self.explanation.as_ref().map(|explained| &explained.rest).or(self.prediction.report.as_ref())
    }
}

/// Looks for causes of each prediction.
pub(super) fn explain<'a>(inputs: &Inputs<'_>, predictions: Vec<Prediction<'a>>) -> Vec<ExplainedLoad<'a>> {
    predictions.into_iter().map(|prediction| explain_one(inputs, prediction)).collect()
}

/// The prefixes and values that explain a report, see [`ExplainedLoad`].
pub(super) type FoundCauses = (Vec<Fault>, Option<Explanation>);

fn explain_one<'a>(inputs: &Inputs<'_>, prediction: Prediction<'a>) -> ExplainedLoad<'a> {
    let Prediction { target, architecture, report, .. } = &prediction;
    // A quantised tensor has the shape that its scheme packs it into, which no config value explains.
    let is_searched = target.leads && inputs.is_plain() && inputs.stored.is_searchable();
    let Some(report) = report.as_ref().filter(|_| is_searched) else {
        return ExplainedLoad { prediction, prefixes: Vec::new(), explanation: None };
    };
    let key = class_key(*architecture);
    let (prefixes, mut explanation) = remembered(&inputs.memo.causes, key, || search(inputs, &prediction, report));
    if let Some(explanation) = &mut explanation {
        explanation.rest.stands_for.clone_from(&target.stands_for);
    }
    ExplainedLoad { prediction, prefixes, explanation }
}

fn search(inputs: &Inputs<'_>, prediction: &Prediction<'_>, report: &LoadReport) -> FoundCauses {
    let Prediction { architecture, expected, .. } = prediction;
    let moved = load::moved(&inputs.knowledge.wrappers, *architecture, inputs.config, expected, inputs.stored, report);
    // Tensors under another prefix load nowhere, but their shapes still imply config values.
    let (class, stored, moved_report) =
        moved.as_ref().map_or((expected, inputs.stored, report), |m| (&m.expected, &m.stored, &m.report));
    let explanation = votes::explain(*architecture, inputs.config, class, stored, moved_report);
    let (explanation, prefixes) = match (explanation, moved) {
        (explanation, None) => (explanation, Vec::new()),
        (Some(explanation), Some(moved)) => (Some(explanation), moved.faults),
        (None, Some(Moved { report, faults, .. })) => (Some(Explanation { votes: Vec::new(), rest: report }), faults),
    };
    let explanation =
        explanation.map(|Explanation { votes, rest }| Explanation { votes, rest: finished(inputs.checkpoint, rest) });
    (prefixes, explanation)
}

/// The votes of all loads; for each config value, those of the first load.
pub(super) fn distinct_votes(loads: &[ExplainedLoad<'_>]) -> Vec<Vote> {
    let mut votes: Vec<Vote> = Vec::new();
    for vote in loads.iter().filter_map(|load| load.explanation.as_ref()).flat_map(|e| &e.votes) {
        if votes.iter().all(|v| v.pointer != vote.pointer) {
            votes.push(vote.clone());
        }
    }
    votes
}
