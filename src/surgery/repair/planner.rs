//! Plans a repair in rounds of fixes.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::draft::{Made, RepairDraft};
use super::unused::left_unused;
use super::{Change, Content, Fixed, Repair, Withdrawn};
use crate::check::{Edit, Finding, Outcome, Severity};
use crate::checkpoint::Checkpoint;

/// Maximum number of rounds. A repair takes two or three; more indicate a cycle.
const ROUNDS: usize = 32;

/// Result of an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Settled {
    /// No fix could be applied.
    Nothing,
    /// Some fixes are applied and kept.
    Kept,
    /// One fix is withdrawn for good.
    Barred,
}

struct Planner<'a> {
    check: &'a dyn Fn(&Arc<Checkpoint>) -> Outcome,
    draft: RepairDraft,
    outcome: Outcome,
    fixed: Vec<Fixed>,
    withdrawn: Vec<Withdrawn>,
    /// Edits of withdrawn fixes, which are not tried again.
    barred: Vec<Vec<Edit>>,
}

/// Plans the repair of a checkpoint: all safe fixes, and with `unsafe_fixes` also the unsafe ones.
///
/// `check` runs the selected rules on a checkpoint; `outcome` is their result for this one.
#[must_use]
pub fn plan(
    checkpoint: &Arc<Checkpoint>,
    outcome: Outcome,
    unsafe_fixes: bool,
    check: &dyn Fn(&Arc<Checkpoint>) -> Outcome,
) -> Repair {
    let draft = RepairDraft::new(checkpoint);
    let mut planner = Planner { check, draft, outcome, fixed: Vec::new(), withdrawn: Vec::new(), barred: Vec::new() };
    let mut rounds = 0;
    while rounds < ROUNDS {
        match planner.settle(&planner.open(unsafe_fixes)) {
            Settled::Nothing => break,
            Settled::Kept => rounds = rounds.saturating_add(1),
            // At most as often as there are findings.
            Settled::Barred => {}
        }
    }
    let Planner { draft, outcome, fixed, withdrawn, .. } = planner;
    let texts = draft.texts.into_iter().map(|(name, text)| Change { name, new: Content::Text(text) });
    let shards =
        draft.shards.into_iter().map(|(name, shard)| Change { name, new: Content::Shard(Arc::unwrap_or_clone(shard)) });
    let mut changes: Vec<Change> = shards.chain(texts).collect();
    changes.sort_by(|a, b| a.name.cmp(&b.name));
    Repair { original: Arc::clone(checkpoint), outcome, fixed, withdrawn, changes }
}

impl Planner<'_> {
    /// The findings with fixes to try, in report order.
    fn open(&self, unsafe_fixes: bool) -> Vec<Finding> {
        let permitted = |f: &&Finding| {
            f.fix.as_ref().is_some_and(|fix| fix.is_permitted(unsafe_fixes) && !self.barred.contains(&fix.edits))
        };
        self.outcome.findings.iter().filter(permitted).cloned().collect()
    }

    /// Applies as many of these fixes as do not conflict.
    fn settle(&mut self, findings: &[Finding]) -> Settled {
        let mut draft = self.draft.clone();
        let mut made: Vec<Finding> = Vec::new();
        for finding in findings {
            let Some(fix) = &finding.fix else { continue };
            match draft.make(&fix.edits) {
                Made::All => made.push(finding.clone()),
                Made::Later if !made.is_empty() => {}
                // Edits that change nothing now, or conflict with each other, do so in later rounds too.
                Made::Later | Made::Nothing => self.withdraw(finding, "its edits cannot be made".to_owned()),
            }
        }
        if made.is_empty() {
            return Settled::Nothing;
        }
        let outcome = draft.finish().map(|()| (self.check)(draft.current()));
        let reason = match outcome {
            None => "its edits conflict".to_owned(),
            Some(outcome) => {
                let Some(reason) = objection(&self.outcome, &outcome, &made) else {
                    (self.draft, self.outcome) = (draft, outcome);
                    self.fixed.extend(made.iter().filter_map(fixed));
                    return Settled::Kept;
                };
                reason
            }
        };
        if let [one] = made.as_slice() {
            self.withdraw(one, reason);
            return Settled::Barred;
        }
        // Bisects the fixes until the harmful one is alone.
        let (first, second) = made.split_at(made.len() / 2);
        match self.settle(first) {
            Settled::Nothing => self.settle(second),
            settled => settled,
        }
    }

    fn withdraw(&mut self, finding: &Finding, reason: String) {
        let Some(fix) = &finding.fix else { return };
        self.barred.push(fix.edits.clone());
        self.withdrawn.push(Withdrawn { code: finding.code.clone(), title: fix.title().to_owned(), reason });
    }
}

/// The reason for not keeping these fixes together.
fn objection(before: &Outcome, after: &Outcome, made: &[Finding]) -> Option<String> {
    // Of several findings of one rule, some may be fixed and others remain: the next round handles the rest.
    let stays = |f: &&Finding| count(after, |g| g.code == f.code) >= count(before, |g| g.code == f.code);
    let unused = || left_unused(before, after).map(|name| format!("{name} would stay in the file, unused"));
    worse(before, after)
        .or_else(|| made.iter().find(stays).map(|_| "the finding would remain".to_owned()))
        .or_else(unused)
}

/// Number of findings of a kind, including those that are only counted.
fn count(outcome: &Outcome, kind: impl Fn(&Finding) -> bool) -> usize {
    outcome.findings.iter().filter(|f| kind(f)).fold(0, |n, f| n.saturating_add(f.count()))
}

/// The rule of an error that occurs more often than before.
fn worse(before: &Outcome, after: &Outcome) -> Option<String> {
    let errors = |outcome: &Outcome, code: &str| count(outcome, |f| f.severity == Severity::Error && f.code == code);
    let codes: BTreeSet<&str> = after.findings.iter().map(|f| f.code.as_str()).collect();
    let code = codes.into_iter().find(|code| errors(after, code) > errors(before, code))?;
    Some(format!("it would introduce {code}"))
}

fn fixed(finding: &Finding) -> Option<Fixed> {
    let fix = finding.fix.as_ref()?;
    Some(Fixed {
        code: finding.code.clone(),
        name: finding.name.clone(),
        file: finding.locations.first().and_then(|l| l.file.clone()),
        message: finding.message.clone(),
        safety: fix.safety,
        title: fix.title().to_owned(),
    })
}
