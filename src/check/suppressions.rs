//! Suppressions that suppressed nothing.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::evaluate;
use super::finding::Finding;
use super::outcome::Outcome;
use crate::checkpoint::{Checkpoint, Fault, FaultKind};
use crate::knowledge::Knowledge;
use crate::knowledge::settings::{Suppression, absolute};

/// A finding for each suppression that suppressed nothing, with the index of the checkpoint to report it for.
///
/// `looked` are the checkpoints under one settings file and `searched` the directories in which every checkpoint was
/// checked. A suppression is passed over when its rules were not run, or when it may apply to a checkpoint elsewhere.
#[must_use]
pub fn unused_suppressions(
    knowledge: &Knowledge,
    looked: &[(Arc<Checkpoint>, &Outcome)],
    searched: &[PathBuf],
) -> Vec<(usize, Finding)> {
    let mut found = Vec::new();
    for suppression in &knowledge.policy.suppressions {
        let asked = knowledge.rules.rules.iter().any(|r| suppression.codes.contains(&r.code));
        let used = |outcome: &Outcome| outcome.suppressed.iter().any(|s| s.accepted.by == suppression.written);
        let roots = looked.iter().map(|(checkpoint, _)| checkpoint.source.path());
        if !asked || looked.iter().any(|(_, o)| used(o)) || !is_covered(suppression, roots, searched) {
            continue;
        }
        let concerned = |c: &Checkpoint| suppression.concerns(c.source.path(), c.entries.keys().map(String::as_str));
        let at = looked.iter().position(|(checkpoint, _)| concerned(checkpoint)).unwrap_or(0);
        let Some((checkpoint, _)) = looked.get(at) else { continue };
        let fault = Fault::new(FaultKind::SuppressionUnused)
            .with("rule", suppression.rule.as_str())
            .with("path", suppression.path.as_deref().unwrap_or(""))
            .with("written", suppression.written.as_str())
            .with("reason", suppression.reason.as_str());
        found.extend(evaluate::report(knowledge, checkpoint, &[fault]).into_iter().map(|finding| (at, finding)));
    }
    found
}

/// Whether every checkpoint that a suppression is about was looked at.
fn is_covered<'p>(suppression: &Suppression, mut roots: impl Iterator<Item = &'p Path>, searched: &[PathBuf]) -> bool {
    let base = suppression.base();
    roots.any(|root| base.starts_with(absolute(root))) || searched.iter().any(|dir| base.starts_with(absolute(dir)))
}
