//! Builds reports from the results of checks.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::model::{CheckpointReport, Counts, Role};
use crate::check::finding::{Accepted, Suppressed};
use crate::check::{Edit, Finding, Outcome, Severity};
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
            if let Some(text) = checkpoint.text(file) {
                sources.insert(file.clone(), Arc::clone(text));
            }
        }
        let listed = checkpoint.shards.values().fold(0_u64, |sum, shard| sum.saturating_add(shard.count()));
        let (mut parameters, mut bytes) = (0_u64, 0_u64);
        for (_, tensor) in checkpoint.tensors() {
            let elements = tensor.shape.iter().fold(1_u64, |n, dim| n.saturating_mul(*dim));
            parameters = parameters.saturating_add(elements);
            bytes = bytes.saturating_add(tensor.len());
        }
        let text = |pointer: &str| checkpoint.config()?.pointer(pointer)?.as_str().map(str::to_owned);
        Self {
            path: path.into(),
            role,
            class: text("/architectures/0").or_else(|| text("/_class_name")),
            architecture: outcome.architecture.clone(),
            tensors: usize::try_from(listed).unwrap_or(usize::MAX),
            parameters,
            bytes,
            verdict: counts.verdict(),
            counts,
            settings: None,
            overrides: None,
            findings: by_severity(&outcome.findings),
            suppressed: outcome.suppressed.clone(),
            loads: outcome.verdicts.clone(),
            contents: checkpoint.contents.to_vec(),
            fixed: Vec::new(),
            withdrawn: Vec::new(),
            fixing: None,
            sources,
        }
    }

    /// Whether nothing about it is printed with `--quiet`: it has no findings but notes, and nothing was fixed.
    pub(crate) fn is_quiet(&self) -> bool {
        self.findings.iter().all(Finding::is_note) && self.fixed.is_empty() && self.withdrawn.is_empty()
    }

    /// Whether settings, options or a baseline changed what is reported.
    pub(crate) const fn is_governed(&self) -> bool {
        self.overrides.is_some() || !self.suppressed.is_empty()
    }

    /// Adds a finding that the run made, which points into no document.
    #[cfg_attr(not(feature = "cli"), allow(dead_code, reason = "only the program looks for unused suppressions"))]
    pub(crate) fn add(&mut self, finding: Finding) {
        self.findings.push(finding);
        self.findings = by_severity(&self.findings);
        self.counts = Counts::new(&self.findings);
        self.verdict = self.counts.verdict();
    }

    /// Removes findings below this severity; they stay in `counts`. Returns their number.
    pub(crate) fn hide_below(&mut self, least: Severity) -> usize {
        let all = self.findings.iter().map(Finding::count).fold(0, usize::saturating_add);
        self.findings.retain(|finding| finding.severity >= least);
        all.saturating_sub(self.findings.iter().map(Finding::count).fold(0, usize::saturating_add))
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

/// The findings with errors first, then warnings, then information; otherwise in their order.
fn by_severity(findings: &[Finding]) -> Vec<Finding> {
    let mut sorted = findings.to_vec();
    sorted.sort_by_key(|finding| std::cmp::Reverse(finding.severity));
    sorted
}
