//! Suppressions that suppressed nothing.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::evaluate;
use super::finding::Finding;
use super::outcome::Outcome;
use crate::checkpoint::{Checkpoint, Fault, FaultKind};
use crate::knowledge::Knowledge;
use crate::knowledge::settings::{Policy, Suppression, absolute};

/// What became of one suppression in one checkpoint.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SuppressionUse {
    /// Whether it suppressed a finding.
    used: bool,
    /// Whether it names this checkpoint or a file of it.
    concerned: bool,
    /// What is reported for this checkpoint if it suppressed nothing in any.
    unused: Vec<Finding>,
}

/// The suppressions of the settings, in their order, as one checkpoint used them.
#[must_use]
pub fn suppression_uses(
    knowledge: &Knowledge,
    policy: &Policy,
    checkpoint: &Checkpoint,
    outcome: &Outcome,
) -> Vec<SuppressionUse> {
    let of = |suppression: &Suppression| {
        let used = outcome.suppressed.iter().any(|s| s.accepted.by == suppression.written);
        let names = checkpoint.entries.keys().map(String::as_str);
        let fault = || {
            Fault::new(FaultKind::SuppressionUnused)
                .with("rule", suppression.rule.as_str())
                .with("path", suppression.path.as_deref().unwrap_or(""))
                .with("written", suppression.written.as_str())
                .with("reason", suppression.reason.as_str())
        };
        SuppressionUse {
            used,
            concerned: suppression.concerns(checkpoint.source.path(), names),
            unused: if used { Vec::new() } else { evaluate::report(knowledge, checkpoint, &[fault()]) },
        }
    };
    policy.suppressions.iter().map(of).collect()
}

/// A finding for each suppression that suppressed nothing, with the index of the checkpoint to report it for.
///
/// `looked` are the checkpoints under one settings file, with the uses that [`suppression_uses`] found, and `searched` the
/// directories in which every checkpoint was checked. A suppression is passed over when its rules were not run, or when it may
/// apply to a checkpoint elsewhere.
#[must_use]
pub fn unused_suppressions(
    knowledge: &Knowledge,
    policy: &Policy,
    looked: &[(&Path, &[SuppressionUse])],
    searched: &[PathBuf],
) -> Vec<(usize, Finding)> {
    let mut found = Vec::new();
    for (number, suppression) in policy.suppressions.iter().enumerate() {
        let asked = knowledge.rules.rules.iter().any(|r| suppression.codes.contains(&r.code));
        let uses: Vec<&SuppressionUse> = looked.iter().filter_map(|(_, uses)| uses.get(number)).collect();
        let roots = looked.iter().map(|(root, _)| *root);
        if !asked || uses.iter().any(|one| one.used) || !is_covered(suppression, roots, searched) {
            continue;
        }
        let at = uses.iter().position(|one| one.concerned).unwrap_or(0);
        found.extend(uses.get(at).into_iter().flat_map(|one| &one.unused).map(|finding| (at, finding.clone())));
    }
    found
}

/// Whether every checkpoint that a suppression is about was looked at.
fn is_covered<'p>(suppression: &Suppression, mut roots: impl Iterator<Item = &'p Path>, searched: &[PathBuf]) -> bool {
    let base = suppression.base();
    roots.any(|root| base.starts_with(absolute(root))) || searched.iter().any(|dir| base.starts_with(absolute(dir)))
}
