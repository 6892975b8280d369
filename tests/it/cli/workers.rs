//! Zoos are checked in workers: their reports are those of single runs, and the death of one costs one directory.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use serde_json::Value;
use tempfile::TempDir;

use crate::support::{knowledge, on_cases, program};

/// Copies a directory with its folders and links.
fn copy_all(from: &Path, to: &Path) {
    assert!(Command::new("cp").arg("-a").args([from, to]).status().unwrap().success());
}

/// Copies every eightieth case to a directory of its own.
fn zoo() -> (TempDir, Vec<PathBuf>) {
    let room = TempDir::new().unwrap();
    let names: Vec<String> = crate::support::cases().into_iter().map(|case| case.name).step_by(80).collect();
    let made = on_cases(
        &knowledge(),
        |name| names.iter().any(|n| n == name),
        |_, case, dir| {
            let copy = room.path().join(case.name.replace('/', "-"));
            copy_all(dir, &copy);
            copy
        },
    );
    (room, made.into_iter().map(|(_, dir)| dir).collect())
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {output:?}"))
}

fn check(dirs: &[PathBuf], more: &[&str]) -> Output {
    program().args(["check", "--isolated", "--color", "never"]).args(more).args(dirs).output().unwrap()
}

#[test]
fn reports_of_a_zoo_are_those_of_single_runs() {
    let (_room, dirs) = zoo();
    assert!(dirs.len() > 5, "{}", dirs.len());
    for more in [&["--output-format", "json"] as &[&str], &["--output-format", "json", "--deep", "--stats"]] {
        let together = json(&check(&dirs, more));
        for (dir, checkpoint) in dirs.iter().zip(together["checkpoints"].as_array().unwrap()) {
            let alone = json(&check(std::slice::from_ref(dir), more));
            assert_eq!(alone["checkpoints"][0], *checkpoint, "{}", dir.display());
        }
    }
    // Formats for people and for CI have fields that JSON has not.
    for format in ["full", "github"] {
        let together = check(&dirs, &["--output-format", format]);
        let together = String::from_utf8(together.stdout).unwrap();
        for dir in &dirs {
            let alone = check(std::slice::from_ref(dir), &["--output-format", format]);
            let alone = String::from_utf8(alone.stdout).unwrap();
            let name = dir.to_str().unwrap();
            // The totals of the run are others.
            let own: Vec<&str> = alone.lines().take_while(|line| !line.starts_with("Found ")).collect();
            let missing: Vec<&&str> = own
                .iter()
                .filter(|line| line.contains(name) || line.contains("-->") || line.contains('|'))
                .filter(|line| !together.contains(**line))
                .collect();
            assert!(missing.is_empty(), "{format}: {missing:#?}\n{together}");
        }
    }
}

#[test]
fn the_number_of_workers_changes_no_byte() {
    let (_room, dirs) = zoo();
    for format in ["full", "sarif", "json"] {
        let one = check(&dirs, &["--jobs", "1", "--output-format", format]);
        let four = check(&dirs, &["--jobs", "4", "--output-format", format]);
        assert_eq!((one.status.code(), &one.stdout, &one.stderr), (four.status.code(), &four.stdout, &four.stderr));
    }
}

/// Splits the report into the directories without one and the others.
fn unchecked(report: &Value) -> (Vec<String>, usize) {
    let line = |one: &Value| format!("{}: {}", one["path"].as_str().unwrap(), one["reason"].as_str().unwrap());
    let unchecked = report["unchecked"].as_array().map(|list| list.iter().map(line).collect()).unwrap_or_default();
    (unchecked, report["checkpoints"].as_array().unwrap().len())
}

/// The workers of a process.
#[cfg(target_os = "linux")]
fn workers(parent: u32) -> Vec<String> {
    let mut all = Vec::new();
    for task in fs::read_dir(format!("/proc/{parent}/task")).into_iter().flatten().flatten() {
        let list = fs::read_to_string(task.path().join("children")).unwrap_or_default();
        all.extend(list.split_whitespace().map(str::to_owned));
    }
    let is_worker = |pid: &String| {
        fs::read(format!("/proc/{pid}/cmdline"))
            .is_ok_and(|line| String::from_utf8_lossy(&line).contains("--check-in-worker"))
    };
    all.retain(is_worker);
    all
}

#[cfg(target_os = "linux")]
#[test]
fn a_killed_worker_costs_one_directory() {
    let (room, dirs) = zoo();
    let document = room.path().join("report.json");
    let killed = || {
        let mut command = program();
        command.args(["check", "--isolated", "--jobs", "2", "--report"]).arg(format!("json={}", document.display()));
        let mut run = command.args(&dirs).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let victim = loop {
            assert!(run.try_wait().unwrap().is_none(), "the run ended before a worker was seen");
            if let Some(victim) = workers(run.id()).pop() {
                break victim;
            }
        };
        // It may have ended meanwhile.
        let _status = Command::new("kill").args(["-9", &victim]).stderr(Stdio::null()).status().unwrap();
        run.wait_with_output().unwrap()
    };
    // On a busy machine the worker may be through when it is killed: then every directory has its report.
    let output =
        (0..20).map(|_| killed()).find(|output| output.status.code() != Some(1)).expect("a worker that is killed");
    let (unchecked, checked) = unchecked(&serde_json::from_slice(&fs::read(&document).unwrap()).unwrap());
    assert_eq!(output.status.code(), Some(2));
    assert_eq!((unchecked.len(), checked), (1, dirs.len() - 1), "{unchecked:#?}");
    let why = "the process that checked it ended with SIGKILL, which the kernel sends when memory or time runs out";
    assert!(unchecked[0].ends_with(why), "{unchecked:#?}");
    assert_eq!(String::from_utf8_lossy(&output.stderr).trim(), format!("error: {}", unchecked[0]));
}

#[cfg(target_os = "linux")]
#[test]
fn a_worker_that_runs_out_of_memory_costs_one_directory() {
    let (room, mut dirs) = zoo();
    dirs.truncate(4);
    let large = room.path().join("large");
    copy_all(&dirs[0], &large);
    fs::write(large.join("tokenizer.json"), format!("{{\"model\": [{}0]}}", "{\"a\":\"b\"},".repeat(2_000_000)))
        .unwrap();
    dirs.insert(2, large.clone());
    let script = "ulimit -c 0; ulimit -v 262144; exec \"$0\" \"$@\"";
    let mut command = Command::new("/bin/sh");
    command.args(["-c", script, env!("CARGO_BIN_EXE_ckpt-doctor"), "check", "--isolated", "--output-format", "json"]);
    let output = command.args(&dirs).env("XDG_STATE_HOME", crate::support::state()).output().unwrap();
    let (unchecked, checked) = unchecked(&json(&output));
    assert_eq!((output.status.code(), checked), (Some(2), 4), "{unchecked:#?}");
    let expected =
        format!("{}: the process that checked it ended with SIGABRT: memory allocation of ", large.display());
    assert!(unchecked.len() == 1 && unchecked[0].starts_with(&expected), "{unchecked:#?}");
}

#[test]
fn a_worker_answers_nobody_else() {
    for args in [&["--check-in-worker"] as &[&str], &["--check-in-worker", "rules"]] {
        let output = program().args(args).stdin(Stdio::null()).output().unwrap();
        assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(2), [].as_slice()), "{args:?}");
    }
}
