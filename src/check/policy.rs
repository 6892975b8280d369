//! What becomes of findings by the settings: other severities, silence, and what is accepted.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::engine::{self, Knowledge, Outcome};
use super::finding::{Accepted, Finding, Suppressed};
use crate::checkpoint::{Checkpoint, Fault, FaultKind};
use crate::knowledge::settings::{Policy, Suppression, absolute};

/// Regrades findings and sets those aside that are accepted.
pub(super) fn apply(policy: &Policy, checkpoint: &Checkpoint, outcome: &mut Outcome) {
    if policy.is_empty() {
        return;
    }
    for mut finding in std::mem::take(&mut outcome.findings) {
        let file = finding.locations.first().and_then(|l| l.file.as_deref());
        // One that speaks for others, which are not kept, may stand for another file.
        let alone = !finding.evidence.contains_key("more");
        match policy.grade(&checkpoint.root, file, &finding.code, finding.severity) {
            Some(severity) => finding.severity = severity,
            None if alone => continue,
            None => {}
        }
        let accepted = policy.suppression(&checkpoint.root, file, &finding.code).filter(|_| alone);
        match accepted.and_then(|number| policy.suppressions.get(number)) {
            Some(suppression) => {
                let accepted = Accepted { by: suppression.written.clone(), reason: Some(suppression.reason.clone()) };
                outcome.suppressed.push(Suppressed { finding, accepted });
            }
            None => outcome.findings.push(finding),
        }
    }
}

/// A finding for each suppression that had nothing to suppress, and which of the checkpoints to report it of.
///
/// Nothing is said of a suppression when a checkpoint that it is about may not have been looked at: `searched` are the
/// directories in which all were. Nor of one whose rules were not asked.
#[must_use]
pub fn unused(
    knowledge: &Knowledge,
    looked: &[(Arc<Checkpoint>, &Outcome)],
    searched: &[PathBuf],
) -> Vec<(usize, Finding)> {
    let mut found = Vec::new();
    for suppression in &knowledge.policy.suppressions {
        let asked = knowledge.rules.rules.iter().any(|r| suppression.codes.contains(&r.code));
        let used = |outcome: &Outcome| outcome.suppressed.iter().any(|s| s.accepted.by == suppression.written);
        let roots = looked.iter().map(|(checkpoint, _)| checkpoint.root.as_path());
        if !asked || looked.iter().any(|(_, o)| used(o)) || !is_covered(suppression, roots, searched) {
            continue;
        }
        let concerned = |c: &Checkpoint| suppression.concerns(&c.root, c.entries.keys().map(String::as_str));
        let at = looked.iter().position(|(checkpoint, _)| concerned(checkpoint)).unwrap_or(0);
        let Some((checkpoint, _)) = looked.get(at) else { continue };
        let fault = Fault::new(FaultKind::SuppressionUnused)
            .with("rule", suppression.rule.as_str())
            .with("path", suppression.path.as_deref().unwrap_or(""))
            .with("written", suppression.written.as_str())
            .with("reason", suppression.reason.as_str());
        found.extend(engine::report(knowledge, checkpoint, &[fault]).into_iter().map(|finding| (at, finding)));
    }
    found
}

/// Whether every checkpoint that a suppression is about was looked at.
fn is_covered<'p>(suppression: &Suppression, mut roots: impl Iterator<Item = &'p Path>, searched: &[PathBuf]) -> bool {
    let base = suppression.base();
    roots.any(|root| base.starts_with(absolute(root))) || searched.iter().any(|dir| base.starts_with(absolute(dir)))
}
