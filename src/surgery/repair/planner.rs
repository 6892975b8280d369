//! Plans a repair in rounds of fixes.

use std::sync::Arc;

use super::draft::{Made, RepairDraft};
use super::objection::{objection, unproven};
use super::{Change, Content, Fixed, Repair, Withdrawn};
use crate::check::{Edit, Finding, Outcome};
use crate::checkpoint::Checkpoint;

/// Maximum number of rounds. A repair takes two or three; more indicate a cycle.
const ROUNDS: usize = 32;
/// Maximum number of planned checkpoints that one repair judges, so that no directory costs more than this many checks. Fixes
/// that are refused are found by bisection; a repair of a thousand findings with one such fix takes a dozen.
const TRIALS: usize = 64;
/// Maximum number of findings whose fixes a check tries for its offers alone; a directory with more has been damaged as a whole.
const OFFERED: usize = 64;

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

/// Runs rules on a planned checkpoint.
type CheckFn<'a> = &'a dyn Fn(&Arc<Checkpoint>) -> Outcome;

struct Planner<'a> {
    check: CheckFn<'a>,
    draft: RepairDraft,
    outcome: Outcome,
    /// Findings whose fixes are applied.
    made: Vec<Finding>,
    /// Findings whose fixes are not tried again, with the reasons.
    barred: Vec<(Finding, String)>,
    /// Planned checkpoints that may still be judged.
    trials: usize,
}

/// Plans the repair of a checkpoint: all safe fixes, and with `unsafe_fixes` also the unsafe ones.
///
/// `check` runs the selected rules on a checkpoint; `outcome` is the result for this one.
#[must_use]
pub fn plan(checkpoint: &Arc<Checkpoint>, outcome: Outcome, unsafe_fixes: bool, check: CheckFn<'_>) -> Repair {
    let draft = RepairDraft::new(checkpoint);
    let start = (draft.clone(), outcome.clone());
    let mut planner = Planner { check, draft, outcome, made: Vec::new(), barred: Vec::new(), trials: TRIALS };
    planner.run(unsafe_fixes);
    while planner.bar_unproven() {
        (planner.draft, planner.outcome) = start.clone();
        planner.made.clear();
        planner.run(unsafe_fixes);
    }
    let Planner { draft, outcome, made, barred, .. } = planner;
    let texts = draft.texts.into_iter().map(|(name, text)| Change { name, new: Content::Text(text) });
    let shards =
        draft.shards.into_iter().map(|(name, shard)| Change { name, new: Content::Shard(Arc::unwrap_or_clone(shard)) });
    let mut changes: Vec<Change> = shards.chain(texts).collect();
    changes.sort_by(|a, b| a.name.cmp(&b.name));
    Repair {
        original: Arc::clone(checkpoint),
        outcome,
        fixed: made.iter().filter_map(fixed).collect(),
        withdrawn: barred.into_iter().filter_map(|(finding, reason)| withdrawn(finding, reason)).collect(),
        changes,
    }
}

/// The result of a check whose fixes were tried: one that would be withdrawn is not offered, and its finding says why. Called
/// for the reports of users, with the same `check` as [`plan`] and with the result of the selected rules as `outcome`.
/// A trial costs several checks, so where there are many findings and no fix rests on a vote, they are offered untried: they
/// are tried before they are applied.
#[must_use]
pub fn tried(checkpoint: &Arc<Checkpoint>, mut outcome: Outcome, check: CheckFn<'_>) -> Outcome {
    let fixes = || outcome.findings.iter().filter_map(|f| f.fix.as_ref()).filter(|fix| fix.is_permitted(true));
    let is_large = outcome.findings.len() > OFFERED || outcome.findings.iter().any(|f| f.hidden > 0);
    if fixes().next().is_none() || is_large && !fixes().any(|fix| fix.needs_whole_load) {
        return outcome;
    }
    for withdrawn in plan(checkpoint, outcome.clone(), true, check).withdrawn {
        let is_of = |finding: &&mut Finding| {
            finding.code == withdrawn.code && finding.fix.as_ref().is_some_and(|fix| fix.edits == withdrawn.edits)
        };
        for finding in outcome.findings.iter_mut().filter(is_of) {
            finding.fix = finding.fix.take().map(|fix| fix.withheld(&withdrawn.reason));
        }
    }
    outcome
}

impl Planner<'_> {
    /// Applies fixes until none is left.
    fn run(&mut self, unsafe_fixes: bool) {
        let mut rounds = 0;
        while rounds < ROUNDS {
            match self.settle(&self.open(unsafe_fixes)) {
                Settled::Nothing => break,
                Settled::Kept => rounds = rounds.saturating_add(1),
                // At most as often as there are findings.
                Settled::Barred => {}
            }
        }
    }

    /// The findings with fixes to try, in report order.
    fn open(&self, unsafe_fixes: bool) -> Vec<Finding> {
        let permitted = |f: &&Finding| {
            f.fix.as_ref().is_some_and(|fix| fix.is_permitted(unsafe_fixes) && !self.is_barred(&f.code, &fix.edits))
        };
        self.outcome.findings.iter().filter(permitted).cloned().collect()
    }

    fn is_barred(&self, code: &str, edits: &[Edit]) -> bool {
        let is_same = |f: &Finding| f.code == code && f.fix.as_ref().is_some_and(|fix| fix.edits == edits);
        self.barred.iter().any(|(finding, _)| is_same(finding))
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
                Made::Later | Made::Nothing => self.bar(finding, "its edits cannot be made".to_owned()),
            }
        }
        if made.is_empty() {
            return Settled::Nothing;
        }
        let Err(reason) = self.try_out(draft, &made) else { return Settled::Kept };
        if let [one] = made.as_slice() {
            self.bar(one, reason);
            return Settled::Barred;
        }
        // Bisects the fixes until the harmful one is alone.
        let (first, second) = made.split_at(made.len() / 2);
        match self.settle(first) {
            Settled::Nothing => self.settle(second),
            settled => settled,
        }
    }

    /// Keeps these fixes if the checkpoint with them is better, and no load of it is worse; otherwise tells why not.
    fn try_out(&mut self, mut draft: RepairDraft, made: &[Finding]) -> Result<(), String> {
        draft.finish().ok_or("its edits conflict")?;
        self.trials = self.trials.checked_sub(1).ok_or("too many fixes were tried before it")?;
        let outcome = (self.check)(draft.current());
        if let Some(reason) = objection(&self.outcome, &outcome, made) {
            return Err(reason);
        }
        (self.draft, self.outcome) = (draft, outcome);
        self.made.extend_from_slice(made);
        Ok(())
    }

    fn bar(&mut self, finding: &Finding, reason: String) {
        self.barred.push((finding.clone(), reason));
    }

    /// Bars the applied fixes that need a complete load as their proof, if the repair does not lead to one; returns whether
    /// there are any.
    fn bar_unproven(&mut self) -> bool {
        let needs_proof = |f: &&Finding| f.fix.as_ref().is_some_and(|fix| fix.needs_whole_load);
        let open: Vec<Finding> = self.made.iter().filter(needs_proof).cloned().collect();
        let Some(reason) = unproven(&self.outcome).filter(|_| !open.is_empty()) else { return false };
        for finding in &open {
            self.bar(finding, reason.clone());
        }
        true
    }
}

fn fixed(finding: &Finding) -> Option<Fixed> {
    let fix = finding.fix.as_ref()?;
    Some(Fixed {
        code: finding.code.clone(),
        name: finding.name.clone(),
        file: fix.files().first().cloned().or_else(|| finding.locations.first().and_then(|l| l.file.clone())),
        message: finding.message.clone(),
        safety: fix.safety,
        title: fix.title().to_owned(),
    })
}

fn withdrawn(finding: Finding, reason: String) -> Option<Withdrawn> {
    let fix = finding.fix?;
    Some(Withdrawn { code: finding.code, title: fix.title().to_owned(), reason, edits: fix.edits })
}
