//! Plans a repair in rounds of fixes.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::draft::{Made, RepairDraft};
use super::{Change, Content, Fixed, Repair, Withdrawn};
use crate::check::{Edit, Finding, Outcome, Severity};
use crate::checkpoint::Checkpoint;

/// Most rounds. A repair takes two or three; what takes more goes in circles.
const ROUNDS: usize = 32;

/// How far an attempt came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Settled {
    /// No fix could be made.
    Nothing,
    /// Some are made and kept.
    Kept,
    /// One is barred for good.
    Barred,
}

struct Planner<'a> {
    check: &'a dyn Fn(&Arc<Checkpoint>) -> Outcome,
    draft: RepairDraft,
    outcome: Outcome,
    fixed: Vec<Fixed>,
    withdrawn: Vec<Withdrawn>,
    /// Edits that are not tried again.
    barred: Vec<Vec<Edit>>,
}

/// Plans the repair of a checkpoint: all safe fixes, and the unsafe ones too if they are asked for.
///
/// `check` judges a checkpoint, with the rules that were chosen; `outcome` is what it says of this one.
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
            // There are no more of these than findings.
            Settled::Barred => {}
        }
    }
    let Planner { draft, outcome, fixed, withdrawn, .. } = planner;
    let planned = Arc::clone(draft.current());
    let texts = draft.texts.into_iter().map(|(name, text)| Change { name, new: Content::Text(text) });
    let shards =
        draft.shards.into_iter().map(|(name, shard)| Change { name, new: Content::Shard(Arc::unwrap_or_clone(shard)) });
    let mut changes: Vec<Change> = shards.chain(texts).collect();
    changes.sort_by(|a, b| a.name.cmp(&b.name));
    Repair { original: Arc::clone(checkpoint), planned, outcome, fixed, withdrawn, changes }
}

impl Planner<'_> {
    /// The findings whose fixes may be tried, in the order of the report.
    fn open(&self, unsafe_fixes: bool) -> Vec<Finding> {
        let permitted = |f: &&Finding| {
            f.fix.as_ref().is_some_and(|fix| fix.is_permitted(unsafe_fixes) && !self.barred.contains(&fix.edits))
        };
        self.outcome.findings.iter().filter(permitted).cloned().collect()
    }

    /// Makes as many of these fixes as get along with one another.
    fn settle(&mut self, findings: &[Finding]) -> Settled {
        let mut draft = self.draft.clone();
        let mut made: Vec<Finding> = Vec::new();
        for finding in findings {
            let Some(fix) = &finding.fix else { continue };
            match draft.make(&fix.edits) {
                Made::All => made.push(finding.clone()),
                Made::Later if !made.is_empty() => {}
                // What changes nothing now, or stands in its own way, does so later too.
                Made::Later | Made::Nothing => self.withdraw(finding, "its edits cannot be made here".to_owned()),
            }
        }
        if made.is_empty() {
            return Settled::Nothing;
        }
        let outcome = draft.finish().map(|()| (self.check)(draft.current()));
        let reason = match outcome {
            None => "its edits do not fit together".to_owned(),
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
        // Half of them at a time, until the one that does harm stands alone.
        let (first, second) = made.split_at(made.len() / 2);
        match self.settle(first) {
            Settled::Nothing => self.settle(second),
            settled => settled,
        }
    }

    fn withdraw(&mut self, finding: &Finding, reason: String) {
        let Some(fix) = &finding.fix else { return };
        self.barred.push(fix.edits.clone());
        self.withdrawn.push(Withdrawn { code: finding.code.clone(), title: fix.title.clone(), reason });
    }
}

/// Why these fixes cannot be kept together.
fn objection(before: &Outcome, after: &Outcome, made: &[Finding]) -> Option<String> {
    // Of findings that look alike some may go and some stay: the next round has those that stay.
    let stays = |f: &&Finding| count(after, |g| g.code == f.code) >= count(before, |g| g.code == f.code);
    worse(before, after).or_else(|| made.iter().find(stays).map(|_| "the finding would remain".to_owned()))
}

/// How many findings there are of a kind, those that are only counted included.
fn count(outcome: &Outcome, kind: impl Fn(&Finding) -> bool) -> u64 {
    let unshown = |f: &Finding| f.evidence.get("more").and_then(serde_json::Value::as_u64).unwrap_or(0);
    outcome.findings.iter().filter(|f| kind(f)).fold(0, |n, f| n.saturating_add(1).saturating_add(unshown(f)))
}

/// The code of an error that there are more of than before.
fn worse(before: &Outcome, after: &Outcome) -> Option<String> {
    let of = |outcome: &Outcome, code: &str| count(outcome, |f| f.severity == Severity::Error && f.code == code);
    let codes: BTreeSet<&str> = after.findings.iter().map(|f| f.code.as_str()).collect();
    let code = codes.into_iter().find(|code| of(after, code) > of(before, code))?;
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
        title: fix.title.clone(),
    })
}
