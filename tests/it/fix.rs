//! Fixes on every fixture: applied, applied again, and undone.

mod cli;
mod edits;
mod elsewhere;
mod foreign;
mod journal;
mod named;
mod sarif;
mod wrapped;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::load::LoadReport;
use ckpt_doctor::check::{Finding, Outcome, Safety, Severity, check};
use ckpt_doctor::checkpoint::{Checkpoint, ReadOptions};
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::surgery::RepairError;
use ckpt_doctor::surgery::repair::{Repair, Withdrawn, plan, tried};

/// The state of a directory: names, kinds, bytes, modes and times.
fn seen(dir: &Path) -> BTreeMap<String, (u32, i64, i64, Vec<u8>)> {
    let mut seen = BTreeMap::new();
    for entry in fs::read_dir(dir).expect("a directory") {
        let path = entry.expect("an entry").path();
        let meta = fs::symlink_metadata(&path).expect("metadata");
        let bytes =
            if meta.is_file() && meta.len() < 1 << 26 { fs::read(&path).unwrap_or_default() } else { Vec::new() };
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        seen.insert(name, (meta.mode(), meta.mtime(), meta.mtime_nsec(), bytes));
    }
    seen
}

fn planned(dir: &Path, deep: bool, knowledge: &Knowledge) -> (Outcome, Repair) {
    let mut checkpoint = Checkpoint::open(dir).expect("a directory");
    if deep {
        checkpoint.read_contents(ReadOptions::default(), &|_| {});
    }
    let checkpoint = Arc::new(checkpoint);
    let (outcome, judge) = (check(&checkpoint, knowledge), |c: &Arc<Checkpoint>| check(c, knowledge));
    let repair = plan(&checkpoint, outcome.clone(), true, &judge);
    (tried(&checkpoint, outcome, &judge), repair)
}

/// The codes of these findings, with a count if more than one.
fn codes<'f>(codes: impl Iterator<Item = &'f String>) -> String {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for code in codes {
        *counts.entry(code).or_default() += 1;
    }
    let words = counts.into_iter().map(|(code, n)| if n == 1 { code.to_owned() } else { format!("{code}×{n}") });
    words.collect::<Vec<_>>().join(" ")
}

fn is_automatic(finding: &Finding) -> bool {
    finding.fix.as_ref().is_some_and(|fix| fix.safety != Safety::Manual)
}

/// Repairs one fixture and describes the result in a line; `None` without fixes.
///
/// An offered fix is applied, kept, and removes its finding; a finding whose fix was tried and withdrawn offers none. The
/// remaining findings need a person. No load is worse afterwards.
fn repaired(dir: &Path, deep: bool, knowledge: &Knowledge) -> Result<Option<String>, String> {
    let before = seen(dir);
    let (outcome, repair) = planned(dir, deep, knowledge);
    let is_offered = |w: &&Withdrawn| outcome.findings.iter().any(|f| f.code == w.code && is_automatic(f));
    if let Some(w) = repair.withdrawn.iter().find(is_offered) {
        return Err(format!("{} offers to {}, but is withdrawn: {}", w.code, w.title, w.reason));
    }
    if let Some(w) = repair.withdrawn.iter().find(|w| w.reason.starts_with("its edits")) {
        return Err(format!("{} has edits that cannot be made: {}", w.code, w.title));
    }
    let withheld: Vec<String> = repair.withdrawn.iter().map(|w| format!("withheld {}: {}", w.code, w.reason)).collect();
    let withheld = withheld.join("; ");
    if repair.changes.is_empty() {
        return match outcome.findings.iter().find(|f| is_automatic(f)) {
            Some(finding) => Err(format!("{} offers a fix that is not applied", finding.code)),
            None => Ok(Some(withheld).filter(|text| !text.is_empty())),
        };
    }
    let fixed = codes(repair.fixed.iter().map(|f| &f.code));
    match ckpt_doctor::surgery::journal::write(&repair, &crate::support::user(), &|_| {}) {
        // FIFOs and links in a fixture are not repaired.
        Err(RepairError::Linked { .. }) => return Ok(Some(format!("{fixed} (linked)"))),
        other => {
            let written = other.map_err(|e| format!("writing: {e}"))?;
            assert!(written.leftover.is_none(), "every temporary file is removed");
            assert_eq!(written.unsigned, None);
        }
    }
    let (after, again) = planned(dir, deep, knowledge);
    if without_fixes(&after.findings) != without_fixes(&repair.outcome.findings) {
        return Err("the written checkpoint is not the planned one".to_owned());
    }
    if let Some(worse) = worse(&outcome, &after) {
        return Err(worse);
    }
    if !again.changes.is_empty() {
        return Err(format!("a second run would change {} files", again.changes.len()));
    }
    if let Some(left) = after.findings.iter().find(|f| is_automatic(f)) {
        return Err(format!("{} remains: {}", left.code, left.message));
    }
    ckpt_doctor::surgery::journal::undo(dir, &crate::support::own()).map_err(|e| format!("undo: {e}"))?;
    if seen(dir) != before {
        return Err("undo has not restored everything".to_owned());
    }
    let left = codes(after.findings.iter().filter(|f| f.severity != Severity::Info).map(|f| &f.code));
    let done = if left.is_empty() { fixed } else { format!("{fixed}, by hand: {left}") };
    Ok(Some([done, withheld].into_iter().filter(|text| !text.is_empty()).collect::<Vec<_>>().join("; ")))
}

fn without_fixes(findings: &[Finding]) -> Vec<Finding> {
    findings.iter().map(|finding| Finding { fix: None, ..finding.clone() }).collect()
}

/// What a loader does worse after a repair than before it. Written apart from the program's own comparison.
fn worse(before: &Outcome, after: &Outcome) -> Option<String> {
    for (was, is) in before.verdicts.iter().zip(&after.verdicts).filter(|(was, is)| was.loader == is.loader) {
        for object in &is.objects {
            let old = was.objects.iter().find(|old| old.object == object.object);
            if old.is_some_and(|old| old.verdict < object.verdict) {
                return Some(format!("{}: {:?} is {:?} after the repair", is.loader, object.object, object.verdict));
            }
        }
        let (Some(was), Some(is)) = (&was.tensors, &is.tensors) else { continue };
        let of = |load: &LoadReport| [&load.missing, &load.unexpected].map(Vec::len);
        let others = |load: &LoadReport| [load.mismatched.len(), load.silent.len()];
        let grown = std::iter::zip([of(was), others(was)].concat(), [of(is), others(is)].concat());
        let sum = |load: &LoadReport| [of(load), others(load)].concat().iter().sum::<usize>();
        let is_better = sum(is) < sum(was) && others(is) <= others(was) && is.missing.len() <= was.missing.len();
        if was.raises.is_none() && !is_better && grown.into_iter().any(|(was, is)| is > was) {
            return Some(format!("{}: more tensors are wrong after the repair", is.loader));
        }
    }
    None
}

#[test]
fn every_fixture_is_repaired_once_and_undone() {
    let knowledge = crate::support::knowledge();
    let tried = crate::support::on_every_case(&knowledge, |_, case, dir| repaired(dir, case.deep, &knowledge));
    let wrong: Vec<String> =
        tried.iter().filter_map(|(case, result)| Some(format!("{}: {}", case.name, result.as_ref().err()?))).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    let line = |(case, result): &(crate::support::Case, Result<Option<String>, String>)| {
        Some(format!("{}: {}", case.name, result.as_ref().ok()?.as_ref()?))
    };
    snapshot!("fix-fixed", tried.iter().filter_map(line).collect::<Vec<_>>().join("\n"));
}
