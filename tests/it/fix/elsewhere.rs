//! The faults of the fixtures in other checkpoints: the author of a rule does not choose what its fix meets.
//!
//! `CKPT_DOCTOR_ON_BASES=FOLDER cargo test --test it fix::elsewhere` takes the directories in FOLDER instead of the bases, and only
//! writes the cases, as `FOLDER/BASE/cases/NAME`; `tests/peer/restored.py` calls it with models of real classes.

use std::collections::BTreeMap;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use ckpt_doctor::knowledge::Knowledge;

use super::repaired;
use crate::support::change::Change;
use crate::support::{BASES, Case, Draw, base, change, knowledge};

/// The cases of rules that have a fix with edits. A directory of another name or with a pipe is about the directory.
fn mendable(knowledge: &Knowledge) -> Vec<Case> {
    let has_edits = |case: &Case| {
        let rule = knowledge.rules.all().find(|rule| Some(&rule.code) == case.code.as_ref());
        rule.is_some_and(|rule| rule.fixes.iter().any(|fix| !fix.edits.is_empty()))
    };
    let is_plain = |change: &Change| !matches!(change, Change::Directory(_) | Change::Fifo(_) | Change::Link { .. });
    let cases = crate::support::cases().into_iter();
    cases.filter(|case| case.settings.is_none() && has_edits(case) && case.changes.iter().all(is_plain)).collect()
}

/// Makes a case of another base; `None` where its changes have nothing to change.
fn made(case: &Case, base: &Path, room: &Path) -> Option<PathBuf> {
    catch_unwind(AssertUnwindSafe(|| change::make(&case.name, base, &case.changes, room))).ok()
}

#[test]
fn a_fix_ends_its_finding_in_any_checkpoint() {
    let knowledge = knowledge();
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let cases = mendable(&knowledge);
    if let Some(folder) = std::env::var_os("CKPT_DOCTOR_ON_BASES") {
        return write_all(&cases, Path::new(&folder));
    }
    let bases: BTreeMap<&str, PathBuf> = base::make_all(&room.path().join("bases"), BASES, &knowledge);
    let (mut tried, mut broken) = (0, Vec::new());
    for (number, case) in cases.iter().enumerate() {
        let mut draw = Draw::new(crate::laws::seed(number as u64));
        for _ in 0..crate::laws::cases(1) {
            let base = draw.one(BASES);
            let place = room.path().join("case");
            if let Some(dir) = made(case, &bases[base], &place) {
                tried += 1;
                let name = format!("{} on {base}", case.name);
                broken.extend(repaired(&dir, case.deep, &knowledge).err().map(|why| format!("{name}: {why}")));
            }
            let _ = fs::remove_dir_all(&place);
        }
    }
    println!("{tried} checkpoints of {} cases", cases.len());
    assert!(tried > cases.len() / 3, "{tried} of {}", cases.len());
    assert!(broken.is_empty(), "{} broken:\n{}", broken.len(), broken.join("\n"));
}

fn write_all(cases: &[Case], folder: &Path) {
    for base in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
        for case in cases {
            let room = base.join("cases").join(case.name.replace('/', "-"));
            if made(case, &base.join("sound"), &room).is_none() {
                let _ = fs::remove_dir_all(&room);
            }
        }
    }
}
