//! Reports, repairs and undoes the failure modes in `fixtures/failure-modes.json5`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use crate::support::project;
use ckpt_doctor::check::finding::{Finding, Severity};
use ckpt_doctor::check::{Outcome, check};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::knowledge::source;
use ckpt_doctor::surgery::journal;
use ckpt_doctor::surgery::repair::plan;
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Modes {
    modes: Vec<Mode>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mode {
    #[serde(rename = "mode")]
    pub name: String,
    /// Codes of the rules that report the failure.
    #[serde(default)]
    pub rules: Vec<String>,
    /// Names of cases below `fixtures/rules`.
    cases: Vec<String>,
    /// Rules whose warnings may remain after the repair.
    #[serde(default)]
    left: Vec<String>,
    /// The part of the failure that files do not show.
    #[serde(default)]
    pub unseen: String,
}

pub fn modes() -> Vec<Mode> {
    let path = "fixtures/failure-modes.json5";
    let text = fs::read_to_string(project().join(path)).expect("text");
    source::parse::<Modes>(path, &text).unwrap_or_else(|e| panic!("{e}")).modes
}

fn files(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(dir).expect("a directory").map(|e| e.expect("an entry"));
    let named = entries.map(|e| (e.file_name().to_string_lossy().into_owned(), e.path()));
    named.filter(|(_, path)| path.is_file()).map(|(name, path)| (name, fs::read(path).expect("a file"))).collect()
}

fn looked(dir: &Path, knowledge: &Knowledge) -> (Arc<Checkpoint>, Outcome) {
    let checkpoint = Arc::new(Checkpoint::open(dir).expect("a directory"));
    let outcome = check(&checkpoint, knowledge);
    (checkpoint, outcome)
}

fn shown(findings: &[Finding]) -> String {
    let mut out = String::new();
    for f in findings {
        let _ = write!(out, "\n    {} {} {}", f.code, f.severity.name(), f.message);
    }
    out
}

/// Checks, repairs and undoes one case; the error names the failed step.
fn round_trip(code: &str, left: &[String], dir: &Path, knowledge: &Knowledge) -> Result<(), String> {
    let before = files(dir);
    let (checkpoint, broken) = looked(dir, knowledge);
    if !broken.findings.iter().any(|f| f.code == code) {
        return Err(format!("{code} is silent{}", shown(&broken.findings)));
    }
    let repair = plan(&checkpoint, broken, true, &|c| check(c, knowledge));
    journal::write(&repair, &crate::support::user(), &|_| {}).map_err(|e| format!("writing: {e}"))?;
    let (_, repaired) = looked(dir, knowledge);
    let loud =
        |f: &Finding| f.severity > Severity::Info && !(f.severity == Severity::Warning && left.contains(&f.code));
    if repaired.findings.iter().any(|f| f.code == code || loud(f)) {
        return Err(format!("not clean after the repair{}", shown(&repaired.findings)));
    }
    if files(dir) == before {
        return Err("nothing was written".to_owned());
    }
    journal::undo(dir, &crate::support::own()).map_err(|e| format!("undo: {e}"))?;
    if files(dir) != before {
        return Err("undo has not restored every byte".to_owned());
    }
    Ok(())
}

#[test]
fn each_mode_is_reported_repaired_and_undone() {
    let modes = modes();
    let wanted: Vec<&str> = modes.iter().flat_map(|m| &m.cases).map(String::as_str).collect();
    let knowledge = crate::support::knowledge();
    let taken = |case: &str| wanted.contains(&case);
    let tried = crate::support::on_cases(&knowledge, taken, |_, case, dir| {
        let left = modes.iter().find(|m| m.cases.contains(&case.name)).map_or(&[][..], |m| &m.left);
        round_trip(case.code.as_deref().unwrap_or_default(), left, dir, &knowledge)
    });
    let wrong: Vec<String> =
        tried.iter().filter_map(|(case, result)| Some(format!("{}: {}", case.name, result.as_ref().err()?))).collect();
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
    assert_eq!(tried.len(), wanted.len(), "every case of the list is one of fixtures/rules, once");
}

#[test]
fn a_mode_without_a_case_states_the_reason() {
    let modes = modes();
    for mode in &modes {
        assert!(!mode.cases.is_empty() || !mode.unseen.is_empty(), "{}", mode.name);
        let reported = |case: &String| mode.rules.iter().any(|code| case.starts_with(code.as_str()));
        assert!(mode.cases.iter().all(reported), "{}: a case of a rule that the mode does not name", mode.name);
    }
    let numbered = (1..=11).filter(|n| modes.iter().any(|m| m.name.starts_with(&format!("{n} ")))).count();
    assert_eq!(numbered, 11, "the eleven modes of docs/decisions.md");
}
