//! Fixes on every fixture: applied, applied again, and undone.

mod cli;
mod edits;
mod journal;
mod sarif;
mod wrapped;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::{Finding, Outcome, Safety, Severity, check};
use ckpt_doctor::checkpoint::{Checkpoint, ReadOptions};
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::surgery::RepairError;
use ckpt_doctor::surgery::repair::{Repair, plan};

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
    let outcome = check(&checkpoint, knowledge);
    (outcome.clone(), plan(&checkpoint, outcome, true, &|c| check(c, knowledge)))
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
/// An offered fix is applied, kept, and removes its finding; a finding whose fix cannot be applied offers none. The
/// remaining findings need a person.
fn repaired(dir: &Path, deep: bool, knowledge: &Knowledge) -> Result<Option<String>, String> {
    let before = seen(dir);
    let (outcome, repair) = planned(dir, deep, knowledge);
    if let Some(w) = repair.withdrawn.first() {
        return Err(format!("{} offers to {}, but is withdrawn: {}", w.code, w.title, w.reason));
    }
    if repair.changes.is_empty() {
        return match outcome.findings.iter().find(|f| is_automatic(f)) {
            Some(finding) => Err(format!("{} offers a fix that is not applied", finding.code)),
            None => Ok(None),
        };
    }
    let fixed = codes(repair.fixed.iter().map(|f| &f.code));
    match ckpt_doctor::surgery::journal::write(&repair, &|_| {}) {
        // FIFOs and links in a fixture are not repaired.
        Err(RepairError::Linked { .. }) => return Ok(Some(format!("{fixed} (linked)"))),
        other => assert!(other.map_err(|e| format!("writing: {e}"))?.is_none(), "every temporary file is removed"),
    }
    let (after, again) = planned(dir, deep, knowledge);
    if after.findings != repair.outcome.findings {
        return Err("the written checkpoint is not the planned one".to_owned());
    }
    if !again.changes.is_empty() {
        return Err(format!("a second run would change {} files", again.changes.len()));
    }
    if let Some(left) = after.findings.iter().find(|f| is_automatic(f)) {
        return Err(format!("{} remains: {}", left.code, left.message));
    }
    ckpt_doctor::surgery::journal::undo(dir).map_err(|e| format!("undo: {e}"))?;
    if seen(dir) != before {
        return Err("undo has not restored everything".to_owned());
    }
    let left = codes(after.findings.iter().filter(|f| f.severity != Severity::Info).map(|f| &f.code));
    Ok(Some(if left.is_empty() { fixed } else { format!("{fixed}, by hand: {left}") }))
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
