//! The check of every case from memory alone, compared with that of its directory.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::checkpoint::{Checkpoint, MemoryFiles, ReadOptions, Source};
use ckpt_doctor::knowledge::Knowledge;

use crate::support::change::Change;
use crate::support::{Case, knowledge, on_every_case};

/// What files in memory cannot express in a case.
fn inexpressible(case: &Case) -> Option<&'static str> {
    // The rule for files that were changed after their download.
    let time = case.code.as_deref().filter(|code| *code == "SAF025").map(|_| "times of changes");
    time.or_else(|| {
        case.changes.iter().find_map(|change| match change {
            Change::Link { .. } => Some("symbolic links"),
            Change::Fifo(_) => Some("FIFOs"),
            // Of a hole without an end, the reader reports that it was never written.
            Change::Sparse { .. } => Some("holes"),
            _ => None,
        })
    })
}

/// The files of a directory, hidden ones included.
fn in_memory(dir: &Path) -> Source {
    let mut files: Vec<(String, Vec<u8>)> = Vec::new();
    let mut pending = vec![String::new()];
    while let Some(folder) = pending.pop() {
        for entry in fs::read_dir(dir.join(&folder)).expect("a folder") {
            let entry = entry.expect("an entry");
            // No reader opens a file of another name.
            let Ok(name) = entry.file_name().into_string() else { continue };
            let (path, kind) = (format!("{folder}{name}"), entry.file_type().expect("a kind"));
            assert!(kind.is_file() || kind.is_dir(), "{path}");
            if kind.is_dir() {
                files.push((format!("{path}/"), Vec::new()));
                pending.push(format!("{path}/"));
            } else {
                files.push((path, fs::read(entry.path()).expect("a file")));
            }
        }
    }
    Source::Memory(MemoryFiles::new(dir, files))
}

/// All that was read, and the result of the check.
fn checked(source: Source, case: &Case, knowledge: &Knowledge) -> (String, String) {
    let mut checkpoint = Checkpoint::read(source).expect("files");
    if case.deep {
        checkpoint.read_contents(ReadOptions { stats: true, ..ReadOptions::default() }, &|_| {});
        checkpoint.check_hashes(&|_| {});
    }
    let checkpoint = Arc::new(checkpoint);
    let outcome = check_for(&checkpoint, knowledge, &RunOptions::for_versions(&case.loaders));
    let Checkpoint { entries, contents, nested, .. } = &*checkpoint;
    let faults: Vec<_> = checkpoint.all_faults().collect();
    (format!("{entries:#?}\n{nested:#?}\n{contents:#?}\n{faults:#?}"), format!("{outcome:#?}"))
}

/// The first line in which two texts differ.
fn difference(one: &str, other: &str) -> Option<String> {
    let mut pairs = one.lines().zip(other.lines());
    let pair = pairs.find(|(one, other)| one != other).map(|(one, other)| format!("{} / {}", one.trim(), other.trim()));
    pair.or_else(|| (one.len() != other.len()).then(|| "one text is longer".to_owned()))
}

#[test]
fn files_in_memory_have_the_findings_of_their_directory() {
    let knowledge = knowledge();
    let compared = on_every_case(&knowledge, |_, case, dir| {
        if let Some(reason) = inexpressible(case) {
            return Err(reason);
        }
        let (read, outcome) = checked(Source::open(dir).expect("a directory"), case, &knowledge);
        let (read_in_memory, outcome_in_memory) = checked(in_memory(dir), case, &knowledge);
        Ok(difference(&read, &read_in_memory).or_else(|| difference(&outcome, &outcome_in_memory)))
    });
    let (mut wrong, mut left_out) = (Vec::new(), BTreeMap::<&str, usize>::new());
    for (case, compared) in &compared {
        match compared {
            Ok(None) => {}
            Ok(Some(difference)) => wrong.push(format!("{}: {difference}", case.name)),
            Err(reason) => *left_out.entry(reason).or_default() += 1,
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    let sum: usize = left_out.values().sum();
    println!("{left_out:?} of {} cases are left out", compared.len());
    assert!(sum * 20 < compared.len(), "{sum} cases are left out");
}
