//! Runs the program within limits, and reads its report.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// Result of a run.
pub struct Run {
    /// The exit code; `None` when a signal ended the run.
    pub code: Option<i32>,
    /// Seconds of CPU of the program.
    pub cpu: f64,
    pub report: Value,
    pub report_bytes: usize,
    /// The end of what was printed on standard error.
    pub errors: String,
}

/// Path of an optimised program for CI.
fn optimised() -> Option<std::ffi::OsString> {
    std::env::var_os("CKPT_DOCTOR_OPTIMISED")
}

/// A size: as given for an optimised program, and a fortieth for the test build.
pub fn large(size: usize) -> usize {
    if optimised().is_some() { size } else { size / 40 }
}

/// Limit of the address space, in mebibytes.
fn megabytes() -> u64 {
    if optimised().is_some() { 512 } else { 256 }
}

/// Runs `check` on a directory. The shell sets the limits, and prints the CPU time of the program afterwards.
pub fn check(dir: &Path, options: &[&str]) -> Run {
    let program = optimised().unwrap_or_else(|| env!("CARGO_BIN_EXE_ckpt-doctor").into());
    program_within(&program, dir, options)
}

fn program_within(program: &std::ffi::OsStr, dir: &Path, options: &[&str]) -> Run {
    let out = tempfile::TempDir::new().unwrap();
    let report = out.path().join("report.json");
    let script = format!(
        "ulimit -c 0; ulimit -v {}; ulimit -t 60; \"$0\" \"$@\" > /dev/null; code=$?; times; exit $code",
        megabytes() << 10
    );
    let output = Command::new("/bin/sh")
        .args(["-c", &script])
        .arg(program)
        .arg("check")
        .args(options)
        .arg(dir)
        .arg(format!("--report=json={}", report.display()))
        .env("XDG_STATE_HOME", crate::support::state())
        .output()
        .unwrap();
    let bytes = std::fs::read(&report).unwrap_or_default();
    let errors = String::from_utf8_lossy(&output.stderr);
    // Above 128 the shell states the signal that ended the program.
    let code = output.status.code().filter(|code| *code < 128);
    Run {
        code,
        cpu: cpu(&String::from_utf8_lossy(&output.stdout)),
        report: serde_json::from_slice(&bytes).unwrap_or_default(),
        report_bytes: bytes.len(),
        errors: errors.chars().rev().take(400).collect::<Vec<_>>().into_iter().rev().collect(),
    }
}

/// User and system time of the children in the output of `times`: the second line, `0m1.230000s 0m0.040000s`.
fn cpu(times: &str) -> f64 {
    let seconds = |time: &str| {
        let (minutes, seconds) = time.trim_end_matches('s').split_once('m').unwrap();
        minutes.parse::<f64>().unwrap() * 60.0 + seconds.parse::<f64>().unwrap()
    };
    times.lines().nth(1).map_or(f64::INFINITY, |line| line.split_whitespace().map(seconds).sum())
}
