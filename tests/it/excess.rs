//! Laws on directories with too much of everything: memory, time and the report are bounded for the whole checkpoint, and
//! what was not read is said.
//!
//! A seed makes the directories: each one exceeds what published checkpoints have in one respect, or in several. The program
//! checks it within limits of address space and CPU. The sizes are those of the optimised program, and a part of them for the
//! test build.

mod bombs;
mod limits;
mod run;
mod shape;
mod surroundings;

use std::fmt::Write as _;

use crate::support::Draw;
use run::{Run, check};
use serde_json::Value;
use shape::{Excess, Made};
use tempfile::TempDir;

/// Largest report of one checkpoint, in bytes.
const REPORT: usize = 16 << 20;

/// Problems of the report of a directory.
fn complaints(run: &Run, Made { tensors, names }: Made) -> Vec<String> {
    let mut complaints = Vec::new();
    let mut hold = |is: bool, what: String| {
        if !is {
            complaints.push(what);
        }
    };
    hold(run.code == Some(0) || run.code == Some(1), format!("exit {:?}: {}", run.code, run.errors));
    hold(run.report_bytes <= REPORT, format!("a report of {} bytes", run.report_bytes));
    let checkpoint = &run.report["checkpoints"][0];
    let findings = || checkpoint["findings"].as_array().into_iter().flatten();
    let loads = || checkpoint["loads"].as_array().into_iter().flatten();
    hold(checkpoint["tensors"] == tensors, format!("{} tensors are counted of {tensors}", checkpoint["tensors"]));
    if findings().any(|finding| finding["code"] == "FIL011") {
        hold(checkpoint["verdict"] == "error", "what was not read is no error".to_owned());
        let is_predicted = |load: &Value| !load["tensors"].is_null() || load["verdict"] == "loads";
        hold(!loads().any(is_predicted), "a load is predicted from a part".to_owned());
    } else {
        for report in loads().map(|load| &load["tensors"]).filter(|report| !report.is_null()) {
            let listed = report["unexpected"].as_array().map_or(0, Vec::len) as u64;
            let count = listed + report["unlisted"]["unexpected"].as_u64().unwrap_or(0);
            hold(count == names, format!("{count} of {names} tensors are unexpected"));
        }
        // Loaders that differ in other lists have a finding each.
        let own = findings().filter(|finding| finding["code"] == "ARC004");
        for count in own.map(|finding| finding["evidence"]["count"].clone()) {
            hold(count == names, format!("ARC004 counts {count} of {names} tensors"));
        }
    }
    complaints
}

#[test]
fn every_excess_is_bounded_and_counted() {
    let mut draw = Draw::new(20);
    let mut wrong = String::new();
    for shape in Excess::ALL {
        let dir = TempDir::new().unwrap();
        let made = shape.write(dir.path(), run::large(1_000), &mut draw);
        let run = check(dir.path(), &[]);
        for complaint in complaints(&run, made) {
            let _ = writeln!(wrong, "{shape:?}: {complaint}");
        }
    }
    assert!(wrong.is_empty(), "\n{wrong}");
}

/// Four times the bytes take less than seven times the CPU, apart from the start of the program.
#[test]
fn time_is_linear_in_the_bytes() {
    let mut wrong = String::new();
    for shape in Excess::ALL {
        let cpu = [1, 4].map(|times| {
            let dir = TempDir::new().unwrap();
            shape.write(dir.path(), times * run::large(100), &mut Draw::new(7));
            let run = check(dir.path(), &[]);
            assert!(matches!(run.code, Some(0 | 1)), "{shape:?} ×{times}: {:?} {}", run.code, run.errors);
            run.cpu
        });
        if cpu[1] > 7.0 * cpu[0] + 0.5 {
            let _ = writeln!(wrong, "{shape:?}: {cpu:?} seconds");
        }
    }
    assert!(wrong.is_empty(), "\n{wrong}");
}

/// A hole is not read: a shard of four terabytes without a stored byte of data takes no time, and its zeros count as such.
#[test]
fn holes_are_not_read() {
    let dir = TempDir::new().unwrap();
    shape::sparse(dir.path(), 1 << 42);
    let run = check(dir.path(), &["--deep"]);
    assert!(matches!(run.code, Some(0 | 1)), "{:?} {}", run.code, run.errors);
    let findings = run.report["checkpoints"][0]["findings"].as_array().unwrap().clone();
    assert!(findings.iter().any(|finding| finding["code"] == "SAF022"), "{findings:?}");
}
