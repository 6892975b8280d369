//! Applies settings to findings: severities, ignored rules, suppressions.

use super::finding::{Accepted, Suppressed};
use super::outcome::Outcome;
use crate::checkpoint::Checkpoint;
use crate::knowledge::settings::Policy;

/// Regrades findings and sets those aside that are accepted.
pub(super) fn apply_policy(policy: &Policy, checkpoint: &Checkpoint, outcome: &mut Outcome) {
    if policy.is_empty() {
        return;
    }
    for mut finding in std::mem::take(&mut outcome.findings) {
        let file = finding.locations.first().and_then(|l| l.file.as_deref());
        // A finding that also counts hidden ones, which may be in other files, stays.
        let alone = finding.hidden == 0;
        match policy.grade(checkpoint.source.path(), file, &finding.code, finding.severity) {
            Some(severity) => finding.severity = severity,
            None if alone => continue,
            None => {}
        }
        let accepted = policy.suppression(checkpoint.source.path(), file, &finding.code).filter(|_| alone);
        match accepted.and_then(|number| policy.suppressions.get(number)) {
            Some(suppression) => {
                let accepted = Accepted { by: suppression.written.clone(), reason: Some(suppression.reason.clone()) };
                outcome.suppressed.push(Suppressed { finding, accepted });
            }
            None => outcome.findings.push(finding),
        }
    }
}
