//! Faults of the readers on hostile, damaged and unusual input.
//!
//! Each table lists bytes with the exact set of expected fault kinds; an empty set means that unusual input is valid.

use std::collections::BTreeSet;

use ckpt_doctor::checkpoint::{Checkpoint, Fault, FaultKind, FaultSource};

#[cfg(unix)]
mod contents;
#[cfg(unix)]
mod directories;
mod documents;
mod modules;
mod pickles;
mod properties;
mod shards;
mod tokenizers;

/// One row of a table.
struct Case {
    label: &'static str,
    expected: Vec<FaultKind>,
    faults: Vec<Fault>,
}

impl Case {
    fn new(label: &'static str, expected: &[FaultKind], faults: Vec<Fault>) -> Self {
        Self { label, expected: expected.to_vec(), faults }
    }
}

/// A checkpoint with one file.
fn open_with(name: &str, bytes: &[u8]) -> Checkpoint {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join(name), bytes).unwrap();
    Checkpoint::open(dir.path()).unwrap()
}

/// Compares all rows, and reports every difference at once.
fn hold(cases: &[Case]) {
    let mut wrong = Vec::new();
    for case in cases {
        let found: BTreeSet<_> = case.faults.iter().map(|f| f.kind).collect();
        let expected: BTreeSet<_> = case.expected.iter().copied().collect();
        if found != expected {
            wrong.push(format!("{}: expected {expected:?}, found {found:?}", case.label));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
#[cfg(unix)]
fn every_kind_of_a_reader_is_produced_by_some_case() {
    let tables = [
        &documents::CASES,
        &shards::CASES,
        &contents::CASES,
        &modules::CASES,
        &tokenizers::CASES,
        &directories::CASES,
        &pickles::CASES,
    ];
    let produced: BTreeSet<_> = tables.iter().flat_map(|t| t.iter()).flat_map(|c| &c.faults).map(|f| f.kind).collect();
    let readers = FaultKind::ALL.iter().copied().filter(|kind| kind.source() == FaultSource::Reader);
    assert_eq!(produced, readers.collect());
}
