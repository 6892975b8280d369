//! Why a fix that was tried on the checkpoint in memory is not kept.
//!
//! The planned checkpoint is judged as any other one, for the same loaders. A fix is kept only if the findings that it names
//! are gone, and if no loader of the run does worse than before.

use std::collections::{BTreeMap, BTreeSet};

use super::unused::left_unused;
use crate::check::load::{LoadReport, SilentReason};
use crate::check::verdict::{LoadVerdict, PredictedLoad, is_program};
use crate::check::{Finding, Outcome, Severity};
use crate::knowledge::rule::Object;

const UNEXPECTED: &str = "unexpected";
/// What the lists of a load report hold, in their order.
const LISTS: [&str; 4] = ["missing", UNEXPECTED, "of another shape", "silently wrong"];

/// The reason for not keeping fixes together; `None` when they are kept. Called by the planner for each set of fixes that it
/// tries, with the findings that they are of.
pub(super) fn objection(before: &Outcome, after: &Outcome, made: &[Finding]) -> Option<String> {
    let worse =
        worse_verdict(before, after).or_else(|| longer_list(before, after)).or_else(|| new_error(before, after));
    let unused = || left_unused(before, after).map(|name| format!("{name} would stay in the file, unused"));
    worse.or_else(|| remaining(before, after, made)).or_else(unused)
}

/// Why the load after a repair does not prove a fix that rests on the description of a class: a vote for a config value, or
/// a rename. `None` when every leading loader takes all of its tensors from the checkpoint and leaves none over. Called
/// by the planner for a whole repair, because several such fixes may be needed for one complete load.
pub(super) fn unproven(after: &Outcome) -> Option<String> {
    let leading: Vec<&PredictedLoad> = after.verdicts.iter().filter(|load| load.leads).collect();
    if leading.is_empty() {
        return Some("no loader of the run was predicted after it".to_owned());
    }
    leading.into_iter().find_map(|load| match after.loads.iter().find(|report| report.loader == load.loader) {
        None => Some(format!("the load with transformers {} is not predicted after it", load.version())),
        Some(report) => incomplete(report),
    })
}

/// What keeps a load from being complete.
fn incomplete(report: &LoadReport) -> Option<String> {
    if report.raises.is_some() {
        return Some(format!("transformers {} would still raise", report.version()));
    }
    let [missing, unexpected, mismatched, _] = report.lengths();
    // Whether a tie overwrites anything shows in the bytes, which rules compare.
    let silent = report.silent.iter().filter(|silent| silent.reason != SilentReason::TiedOver).count();
    let lengths = [missing, unexpected, mismatched, silent];
    let (n, list) = lengths.into_iter().zip(LISTS).find(|(n, _)| *n > 0)?;
    Some(format!("{} would still be {list} with transformers {}", tensors(n), report.version()))
}

/// `1 tensor`, `12 tensors`.
fn tensors(n: usize) -> String {
    if n == 1 { "1 tensor".to_owned() } else { format!("{n} tensors") }
}

/// The object that a loader would open worse than before.
///
/// A model whose tensors were compared, which loads wrong and is not predicted after a fix, counts as worse: the fix took away
/// what the prediction rests on, so nothing shows that the load became right. Without a comparison there is none to lose: a
/// loader that raised before it, or one whose class is unknown and of which a rule alone said that it loads wrong.
fn worse_verdict(before: &Outcome, after: &Outcome) -> Option<String> {
    after.verdicts.iter().find_map(|load| {
        let was = PredictedLoad::of(&before.verdicts, &load.loader, load.stands_for.as_deref())?;
        let was_compared = before.loads.iter().any(|report| report.loader == load.loader);
        load.objects.iter().find_map(|object| {
            let old = was.objects.iter().find(|old| old.object == object.object);
            let old = old.map_or(LoadVerdict::NotPredicted, |old| old.verdict);
            let is_lost = was_compared
                && object.object == Object::Model
                && (old, object.verdict) == (LoadVerdict::LoadsWrong, LoadVerdict::NotPredicted);
            let is_worse = object.verdict > old || is_lost;
            is_worse.then(|| format!("the {} {} with {}", object.object.name(), would(object.verdict), loader(load)))
        })
    })
}

/// A verdict as what would happen.
const fn would(verdict: LoadVerdict) -> &'static str {
    match verdict {
        LoadVerdict::Loads => "would load",
        LoadVerdict::NotPredicted => "would no longer be predicted",
        LoadVerdict::LoadsWrong => "would load wrong",
        LoadVerdict::Raises => "would raise",
    }
}

/// `transformers 5.23.0`, or another program with its version.
fn loader(load: &PredictedLoad) -> String {
    if is_program(&load.loader) { load.version() } else { format!("transformers {}", load.version()) }
}

/// A list of a load report that would be longer than before. Tensors may become unexpected where more of the others become
/// right: those of a part whose other tensors are lost. A load that raised before it compared tensors has no lists.
fn longer_list(before: &Outcome, after: &Outcome) -> Option<String> {
    let all = |report: &LoadReport| report.lengths().into_iter().fold(0, usize::saturating_add);
    after.loads.iter().find_map(|report| {
        let was = before.loads.iter().find(|was| was.loader == report.loader && was.raises.is_none())?;
        let is_allowed = |list: &str| list == UNEXPECTED && all(report) < all(was);
        let mut lengths = was.lengths().into_iter().zip(report.lengths()).zip(LISTS);
        let ((_, n), list) = lengths.find(|((old, new), list)| new > old && !is_allowed(list))?;
        Some(format!("{} would be {list} with transformers {}", tensors(n), report.version()))
    })
}

/// The rule of an error that would occur more often than before.
fn new_error(before: &Outcome, after: &Outcome) -> Option<String> {
    let errors = |outcome: &Outcome, code: &str| count(outcome, |f| f.severity == Severity::Error && f.code == code);
    let codes: BTreeSet<&str> = after.findings.iter().map(|f| f.code.as_str()).collect();
    let code = codes.into_iter().find(|code| errors(after, code) > errors(before, code))?;
    Some(format!("it would introduce {code}"))
}

/// A finding that would remain: there would be no fewer of its rule, or itself would still be there.
///
/// Findings are counted by rule, because a fix may change the figures in the message of a finding that stays.
fn remaining(before: &Outcome, after: &Outcome, made: &[Finding]) -> Option<String> {
    let mut fixed: BTreeMap<&str, usize> = BTreeMap::new();
    for finding in made {
        let of_code = fixed.entry(finding.code.as_str()).or_default();
        *of_code = of_code.saturating_add(1);
    }
    let of_code = |outcome: &Outcome, code: &str| count(outcome, |f| f.code == code);
    let stays = fixed.iter().any(|(code, n)| of_code(after, code) > of_code(before, code).saturating_sub(*n));
    stays.then(|| "the finding would remain".to_owned())
}

/// Number of findings of a kind, including those that are only counted.
fn count(outcome: &Outcome, kind: impl Fn(&Finding) -> bool) -> usize {
    outcome.findings.iter().filter(|f| kind(f)).fold(0, |n, f| n.saturating_add(f.count()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::verdict::ObjectVerdict;

    /// An outcome with one loader, whose model has this verdict; with a load report if its tensors were compared.
    fn outcome(verdict: LoadVerdict, is_compared: bool) -> Outcome {
        let report = LoadReport { loader: "4.57.6".to_owned(), ..LoadReport::default() };
        let object = ObjectVerdict { object: Object::Model, verdict, why: None, findings: BTreeSet::new() };
        let load = PredictedLoad {
            loader: report.loader.clone(),
            stands_for: None,
            leads: true,
            verdict,
            objects: vec![object],
            tensors: None,
        };
        let loads = if is_compared { vec![report] } else { Vec::new() };
        Outcome { verdicts: vec![load], loads, ..Outcome::default() }
    }

    #[test]
    fn a_comparison_that_a_fix_takes_away_is_a_loss() {
        let after = outcome(LoadVerdict::NotPredicted, false);
        let reason = |before, is_compared| objection(&outcome(before, is_compared), &after, &[]);
        let lost = "the model would no longer be predicted with transformers 4.57.6";
        assert_eq!(reason(LoadVerdict::LoadsWrong, true).as_deref(), Some(lost));
        assert_eq!(reason(LoadVerdict::LoadsWrong, false), None);
        assert_eq!(reason(LoadVerdict::Raises, true), None);
    }
}
