//! Fixes on every fixture: made, made again, and undone.

#![allow(
    clippy::expect_used,
    clippy::indexing_slicing,
    clippy::disallowed_methods,
    clippy::arithmetic_side_effects,
    clippy::format_push_string,
    reason = "the input is this project's own, and a test that cannot go on says so"
)]

mod cli;
mod edits;
mod journal;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::{Knowledge, Outcome, Safety, check};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::surgery::journal::JournalError;
use ckpt_doctor::surgery::repair::{Repair, plan};

/// What can be seen of a directory: names, kinds, bytes, modes and times.
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

fn planned(dir: &Path, knowledge: &Knowledge) -> (Outcome, Repair) {
    let checkpoint = Arc::new(Checkpoint::open(dir).expect("a directory"));
    let outcome = check(&checkpoint, knowledge);
    (outcome.clone(), plan(&checkpoint, outcome, true, &|c| check(c, knowledge)))
}

/// What is wrong with the repair of one fixture, if anything is.
fn trouble(code: Option<&str>, dir: &Path, knowledge: &Knowledge) -> Result<String, String> {
    let before = seen(dir);
    let (outcome, repair) = planned(dir, knowledge);
    let fixable = |f: &&ckpt_doctor::check::Finding| {
        Some(f.code.as_str()) == code && f.fix.as_ref().is_some_and(|x| x.safety != Safety::Manual)
    };
    let promised = outcome.findings.iter().filter(fixable).count();
    let codes = repair.fixed.iter().map(|f| f.code.as_str()).collect::<Vec<_>>().join(" ");
    let withdrawn: Vec<String> = repair.withdrawn.iter().map(|w| format!("{}: {}", w.code, w.reason)).collect();
    let said = format!("{codes}{}{}", if withdrawn.is_empty() { "" } else { " | " }, withdrawn.join("; "));
    if repair.changes.is_empty() {
        return if promised > 0 && withdrawn.is_empty() {
            Err("a fix is promised and not made".to_owned())
        } else {
            Ok(said)
        };
    }
    match ckpt_doctor::surgery::journal::write(&repair, &mut |_| {}) {
        // FIFOs and links in a fixture are left alone.
        Err(JournalError::Linked { .. }) => return Ok(format!("{said} (linked)")),
        other => other.map_err(|e| format!("writing: {e}"))?,
    }
    let (after, again) = planned(dir, knowledge);
    if after.findings != repair.outcome.findings {
        return Err("the written checkpoint is not the planned one".to_owned());
    }
    if !again.changes.is_empty() {
        return Err(format!("a second run would change {} files", again.changes.len()));
    }
    if withdrawn.is_empty() && after.findings.iter().any(|f| fixable(&f)) {
        return Err("a fix is left over".to_owned());
    }
    ckpt_doctor::surgery::journal::undo(dir).map_err(|e| format!("undo: {e}"))?;
    if seen(dir) != before {
        return Err("undo has not restored everything".to_owned());
    }
    Ok(said)
}

#[test]
fn every_fixture_is_repaired_once_and_undone() {
    let knowledge = support::knowledge();
    let tried = support::on_every_case(&knowledge, |_, case, dir| trouble(case.code.as_deref(), dir, &knowledge));
    let wrong: Vec<String> =
        tried.iter().filter_map(|(case, result)| Some(format!("{}: {}", case.name, result.as_ref().err()?))).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    let made: Vec<String> = tried
        .iter()
        .filter_map(|(case, result)| Some((case, result.as_ref().ok()?)))
        .filter(|(_, said)| !said.is_empty())
        .map(|(case, said)| format!("{}: {said}", case.name))
        .collect();
    assert!(made.len() > 40, "{}", made.join("\n"));
}
