//! Builds reports from the results of checks.

use std::collections::BTreeMap;

use super::model::{CheckpointReport, Counts, Role};
use crate::check::finding::{Accepted, Suppressed};
use crate::check::{Edit, Finding, Outcome};
use crate::checkpoint::Checkpoint;

impl CheckpointReport {
    /// The report on one checkpoint, with the path as given by the user.
    #[doc(hidden)]
    #[must_use]
    pub fn new(path: impl Into<String>, role: Option<Role>, checkpoint: &Checkpoint, outcome: &Outcome) -> Self {
        let counts = Counts::new(&outcome.findings);
        let mut sources = BTreeMap::new();
        let places = outcome.findings.iter().flat_map(|f| &f.locations).filter_map(|l| l.file.as_ref());
        let edits = outcome.findings.iter().filter_map(|f| f.fix.as_ref()).flat_map(|fix| &fix.edits);
        for file in places.chain(edits.filter_map(Edit::text_file)) {
            let document = checkpoint.document(file).and_then(|d| d.text.clone());
            let text = document.or_else(|| checkpoint.modules.get(file).and_then(|m| m.text.clone()));
            if let Some(text) = text {
                sources.insert(file.clone(), text);
            }
        }
        let bytes = checkpoint.tensors().fold(0_u64, |n, (_, t)| n.saturating_add(t.len()));
        Self {
            path: path.into(),
            role,
            architecture: outcome.architecture.clone(),
            verdict: counts.verdict(),
            counts,
            settings: None,
            findings: outcome.findings.clone(),
            suppressed: outcome.suppressed.clone(),
            loads: outcome.verdicts.clone(),
            fixed: Vec::new(),
            withdrawn: Vec::new(),
            fixing: None,
            sources,
            tensors: (checkpoint.tensors().count(), bytes),
        }
    }

    /// Suppresses findings for which `accepted` returns a reason; they are no longer counted.
    pub(crate) fn accept(&mut self, accepted: impl Fn(usize, &Finding) -> Option<Accepted>) {
        for (number, finding) in std::mem::take(&mut self.findings).into_iter().enumerate() {
            match accepted(number, &finding) {
                Some(accepted) => self.suppressed.push(Suppressed { finding, accepted }),
                None => self.findings.push(finding),
            }
        }
        self.counts = Counts::new(&self.findings);
        self.verdict = self.counts.verdict();
    }
}
