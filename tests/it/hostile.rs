//! A corpus of hostile and damaged checkpoints, with the verdict of the program on each.
//!
//! The rows are hazards from published models, and upstream's own attacks and crash reports: C the container, P index
//! and paths, D download state, J JSON, X code from the model, F file system. A few lines of code write a case. The
//! program checks it in a process of its own: within limits of CPU and memory, without opening a file outside the
//! checkpoint, starting a program or writing a byte. The verdicts are kept as a snapshot.

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
mod templates;
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
    /// Codes that must be among the findings; if empty, no finding may be above info.
    wanted: Vec<&'static str>,
    /// Part of a place that a finding of each code must name: a file, a tensor, a pointer.
    at: &'static str,
    make: Box<dyn Fn(&Dir) + Send + Sync>,
}

/// A case that must be reported.
fn case(
    row: &'static str,
    name: impl Into<String>,
    wanted: &'static str,
    at: &'static str,
    make: impl Fn(&Dir) + Send + Sync + 'static,
) -> Case {
    Case { row, name: name.into(), wanted: wanted.split_whitespace().collect(), at, make: Box::new(make) }
}

/// A case with any findings: only the limits are tested. The table of verdicts records the findings.
fn bounded(row: &'static str, name: impl Into<String>, make: impl Fn(&Dir) + Send + Sync + 'static) -> Case {
    case(row, name, ANYTHING, "", make)
}

/// In place of codes: any findings are allowed.
const ANYTHING: &str = "*";

/// A case that is unusual but valid.
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
        templates::cases,
        sound::cases,
    ] {
        cases.extend(part());
    }
    cases
}

/// Runs all cases in parallel, and returns the results in order.
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
fn every_hazard_is_checked() {
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

/// Each row that `check` must report has a case.
#[test]
fn every_row_has_a_case() {
    let rows = [("C", 1..=15), ("P", 1..=9), ("D", 1..=6), ("J", 1..=8), ("X", 1..=4), ("F", 1..=5), ("F", 13..=13)];
    // Hazards that need the weights read (D5: their hash) or a file that changes during the read (F2, F3) have tests
    // elsewhere.
    let elsewhere = ["D5", "F2", "F3"];
    let cases = cases();
    for (letter, numbers) in rows {
        for row in numbers.map(|n| format!("{letter}{n}")).filter(|row| !elsewhere.contains(&row.as_str())) {
            assert!(cases.iter().any(|c| c.row == row), "no case of row {row}");
        }
    }
}
