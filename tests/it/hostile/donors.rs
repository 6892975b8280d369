//! The same cases as donors: files of a case replace those of a donor for `build-merged`, with twice the memory limit
//! for two checkpoints.
//!
//! The expectation is the same for all: the run ends within the limits, states the reason for stopping, and leaves
//! neither a target nor other files, with the donor unchanged; or the merge is written and sound.

use std::ffi::OsStr;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use serde_json::Value;
use tempfile::TempDir;

use super::place::{Dir, SHARD};
use super::run::{Bench, optimised};
use super::{Case, cases, judge};
use crate::support;

/// A role in a merge, the donor in it, and the donor's shard that the single shard of a case replaces.
const ROLES: [(&str, &str, &str); 2] = [
    ("vision", "spatialvla-tiny", "model-00003-of-00005.safetensors"),
    ("language", "llava3d-tiny", "model-00001-of-00002.safetensors"),
];

/// Files at the start of each case: unchanged ones are not part of the case.
static BASES: LazyLock<TempDir> = LazyLock::new(|| {
    let bases = TempDir::new().unwrap();
    Dir::new(&bases.path().join("small")).small();
    Dir::new(&bases.path().join("llama")).llama();
    bases
});

fn donor(name: &str) -> PathBuf {
    support::project().join("fixtures/donors").join(name)
}

/// Compares a file with the bases: `Ok` if a base has it, otherwise the Llama's file of this name, if any.
fn base_of(path: &Path) -> Result<(), Option<Vec<u8>>> {
    let meta = fs::symlink_metadata(path).unwrap();
    if !meta.is_file() || meta.len() > 1 << 20 {
        return Err(None);
    }
    let Ok(bytes) = fs::read(path) else { return Err(None) };
    let mut llama = None;
    for base in ["small", "llama"] {
        let same = BASES.path().join(base).join("outer/checkpoint").join(path.file_name().unwrap());
        match fs::read(same) {
            Ok(known) if known == bytes => return Ok(()),
            Ok(known) => llama = Some(known),
            Err(_) => {}
        }
    }
    Err(llama)
}

/// Copies members that differ between two objects into a third.
fn members(bytes: &[u8], base: &[u8], donor: &[u8]) -> Option<Vec<u8>> {
    let [Value::Object(case), Value::Object(base), Value::Object(mut own)] =
        [bytes, base, donor].map(|bytes| serde_json::from_slice(bytes).unwrap_or_default())
    else {
        return None;
    };
    // A document without common keys replaces the whole document.
    if !case.iter().any(|(key, value)| base.get(key) == Some(value)) {
        return None;
    }
    own.extend(case.into_iter().filter(|(key, value)| base.get(key) != Some(value)));
    serde_json::to_vec_pretty(&Value::Object(own)).ok()
}

/// Copies the changes of a case into a donor.
fn graft(case: &Dir, donor: &Dir, shard: &str) {
    let mut entries: Vec<_> = fs::read_dir(&case.root).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        let name = path.file_name().unwrap();
        let target = donor.root.join(if name == SHARD { OsStr::new(shard) } else { name });
        let Err(base) = base_of(&path) else { continue };
        if let Some(base) = base
            && let Ok(own) = fs::read(&target)
            && let Some(bytes) = members(&fs::read(&path).unwrap(), &base, &own)
        {
            fs::write(target, bytes).unwrap();
        } else {
            let _ = fs::remove_file(&target);
            fs::rename(path, target).unwrap();
        }
    }
}

/// Runs one merge; returns the row of the table and the problems.
fn merge(bench: &Bench, number: usize, case: &Case, role: usize) -> (String, Vec<String>) {
    let (name, sound, shard) = ROLES[role];
    let room = bench.room(&format!("{number}-{name}"));
    let built = Dir::new(&room.join("case"));
    (case.make)(&built);
    let dir = Dir::new(&room.join("donor"));
    support::copy(&donor(sound), &dir.root);
    graft(&built, &dir, shard);
    let (other, partner, _) = ROLES[1 - role];
    let into = room.join("into");
    fs::create_dir(&into).unwrap();
    let [own, partner, out] = [&dir.root, &donor(partner), &into.join("merged")].map(|p| p.clone().into_os_string());
    let [role, other] = [name, other].map(|role| format!("--{role}"));
    let args: [&OsStr; 7] =
        ["build-merged".as_ref(), role.as_ref(), &own, other.as_ref(), &partner, "--out".as_ref(), &out];
    let verdict = bench.watch(&room, &dir, 2, &args);
    let mut complaints = verdict.conduct();
    let mut left: Vec<_> = fs::read_dir(&into).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.sort();
    match verdict.exit().as_str() {
        "0" if left != ["merged"] => complaints.push(format!("it is written, and there is {left:?}")),
        "1" | "2" if !left.is_empty() => complaints.push(format!("it stops, and there is {left:?}")),
        "0" | "1" | "2" => {}
        other => complaints.push(format!("exit {other}")),
    }
    let text = verdict.text();
    let why = text.lines().find(|line| line.starts_with("error")).unwrap_or_default();
    let why = why.replace(room.to_str().unwrap(), "");
    let row = format!("{name:<9}{} {} {why}", verdict.exit(), verdict.codes());
    if !complaints.is_empty() {
        complaints.push(verdict.shown());
    }
    // A case may have removed permissions that prevent its deletion.
    let _ = fs::remove_dir_all(&room);
    (row.trim_end().to_owned(), complaints)
}

#[test]
fn a_hostile_donor_is_refused_or_harmless() {
    // The test build takes a second per merge, so it runs one case in ten; CI runs all with an optimised program.
    let all = optimised().is_some();
    let cases: Vec<Case> = cases().into_iter().step_by(if all { 1 } else { 10 }).collect();
    // Roles alternate, because cases of a row are similar.
    let results = judge(&cases, |bench, number, case| merge(bench, number, case, number % ROLES.len()));
    let (mut table, mut wrong) = (String::new(), String::new());
    for (case, (row, complaints)) in cases.iter().zip(results) {
        let Case { row: hazard, name, .. } = case;
        let _ = writeln!(table, "{hazard:<4}{name:<44} {row}");
        if !complaints.is_empty() {
            let _ = writeln!(wrong, "{hazard} {name}: {}", complaints.join("\n    "));
        }
    }
    assert!(wrong.is_empty(), "\n{wrong}");
    if all {
        snapshot!("hostile-donors", table);
    }
}
