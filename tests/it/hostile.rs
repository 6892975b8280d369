//! A corpus of hostile and damaged checkpoints, and what the program says of each.
//!
//! The rows are hazards seen in published models, upstream's own attacks and crash reports: C the container, P index and
//! paths, D download state, J JSON, X code from the model, F file system. A case is written by a few lines of code and
//! judged by the program itself, in a process of its own: within limits of CPU and memory, without a file opened beside
//! the checkpoint, a program started or a byte written. The verdicts are kept as a snapshot.

mod code;
mod container;
mod donors;
mod downloads;
mod json;
mod paths;
mod place;
mod run;
mod sound;
mod system;
mod values;

use std::fmt::Write as _;
use std::sync::Mutex;

use place::Dir;
use run::Bench;

/// One case.
pub struct Case {
    /// Row of the hazards: `C1`.
    row: &'static str,
    name: String,
    /// Codes that have to be among the findings; for none, there must be none above info.
    wanted: Vec<&'static str>,
    /// Part of the place that a finding of each code has to name: a file, a tensor, a pointer.
    at: &'static str,
    make: Box<dyn Fn(&Dir) + Send + Sync>,
}

/// A case that has to be reported.
fn case(
    row: &'static str,
    name: impl Into<String>,
    wanted: &'static str,
    at: &'static str,
    make: impl Fn(&Dir) + Send + Sync + 'static,
) -> Case {
    Case { row, name: name.into(), wanted: wanted.split_whitespace().collect(), at, make: Box::new(make) }
}

/// A case whose findings are as the table of verdicts has them: what matters is that it ends, within the limits.
fn bounded(row: &'static str, name: impl Into<String>, make: impl Fn(&Dir) + Send + Sync + 'static) -> Case {
    case(row, name, ANYTHING, "", make)
}

/// Stands for the codes of a case that may have any, or none.
const ANYTHING: &str = "*";

/// A case that is odd and right.
fn clean(row: &'static str, name: impl Into<String>, make: impl Fn(&Dir) + Send + Sync + 'static) -> Case {
    case(row, name, "", "", make)
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for part in [
        container::cases,
        paths::cases,
        downloads::cases,
        json::cases,
        values::cases,
        code::cases,
        system::cases,
        sound::cases,
    ] {
        cases.extend(part());
    }
    cases
}

/// Runs every case, some at a time, and returns the verdicts in order.
fn judge<T: Send>(cases: &[Case], judge: impl Fn(&Bench, usize, &Case) -> T + Sync) -> Vec<T> {
    let bench = Bench::new();
    let pending = Mutex::new(cases.iter().enumerate());
    let done = Mutex::new(Vec::new());
    let work = || {
        loop {
            let Some((number, case)) = pending.lock().unwrap().next() else { return };
            let verdict = judge(&bench, number, case);
            done.lock().unwrap().push((number, verdict));
        }
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(8);
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(work);
        }
    });
    let mut done = done.into_inner().unwrap();
    done.sort_by_key(|(number, _)| *number);
    done.into_iter().map(|(_, verdict)| verdict).collect()
}

#[test]
fn every_hazard_gets_its_verdict() {
    let cases = cases();
    assert!(cases.len() >= 250, "{} cases", cases.len());
    let verdicts = judge(&cases, |bench, number, case| bench.judge(number, &*case.make));
    let mut wrong = String::new();
    let mut table = String::new();
    for (case, verdict) in cases.iter().zip(&verdicts) {
        let Case { row, name, .. } = case;
        let _ = writeln!(table, "{row:<4}{name:<44} {} {}", verdict.exit(), verdict.codes());
        let complaints = verdict.complaints(&case.wanted, case.at);
        if !complaints.is_empty() {
            let _ = writeln!(wrong, "{row} {name}: {}\n    {}", complaints.join("; "), verdict.shown());
        }
    }
    assert!(wrong.is_empty(), "\n{wrong}");
    snapshot!("hostile-verdicts", table);
}

/// The rows that say what `check` must report: each has a case.
#[test]
fn every_row_has_a_case() {
    let rows = [("C", 1..=15), ("P", 1..=9), ("D", 1..=6), ("J", 1..=8), ("X", 1..=4), ("F", 1..=5), ("F", 13..=13)];
    // What needs the weights read (D5: their hash) or a file that changes meanwhile (F2, F3) is tested elsewhere.
    let elsewhere = ["D5", "F2", "F3"];
    let cases = cases();
    for (letter, numbers) in rows {
        for row in numbers.map(|n| format!("{letter}{n}")).filter(|row| !elsewhere.contains(&row.as_str())) {
            assert!(cases.iter().any(|c| c.row == row), "no case of row {row}");
        }
    }
}
