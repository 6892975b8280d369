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

/// Copies every eightieth case to a directory of its own; not those with folders, which may hold further checkpoints.
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
    let is_alone = |dir: &PathBuf| !fs::read_dir(dir).unwrap().any(|entry| entry.unwrap().path().is_dir());
    (room, made.into_iter().map(|(_, dir)| dir).filter(is_alone).collect())
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

/// Every file below a directory except the state of repairs, with its bytes.
fn files(dir: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut all = Vec::new();
    let mut open = vec![dir.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(folder).unwrap().map(Result::unwrap) {
            let path = entry.path();
            match entry.file_type().unwrap() {
                kind if kind.is_dir() && entry.file_name() != ".ckpt-doctor" => open.push(path),
                kind if kind.is_file() => {
                    all.push((path.strip_prefix(dir).unwrap().to_owned(), fs::read(&path).unwrap()));
                }
                _ => (),
            }
        }
    }
    all.sort();
    all
}

#[test]
fn repairs_of_a_zoo_are_those_of_single_runs() {
    let (_room, together) = zoo();
    let (_other, alone) = zoo();
    let fix = ["--fix", "--unsafe-fixes", "--output-format", "json"];
    let report = json(&check(&together, &fix));
    let mut fixed = 0;
    for (at, (one, dir)) in together.iter().zip(&alone).enumerate() {
        let single = json(&check(std::slice::from_ref(dir), &fix));
        let [of_zoo, of_one] = [&report["checkpoints"][at], &single["checkpoints"][0]];
        assert_eq!(of_zoo["fixed"], of_one["fixed"], "{}", dir.display());
        assert_eq!(of_zoo["findings"].as_array().unwrap().len(), of_one["findings"].as_array().unwrap().len());
        assert!(files(one) == files(dir), "{}", dir.display());
        fixed += of_one["fixed"].as_array().map_or(0, Vec::len);
    }
    assert!(fixed > 0);
}

#[test]
fn differences_of_a_zoo_are_those_of_single_runs() {
    let (_room, dirs) = zoo();
    let [together, each] = [check(&dirs, &["--diff", "--unsafe-fixes"]), {
        let mut each = check(&dirs[..1], &["--diff", "--unsafe-fixes"]);
        for dir in &dirs[1..] {
            let one = check(std::slice::from_ref(dir), &["--diff", "--unsafe-fixes"]);
            each.stdout.extend(one.stdout);
            each.stderr.extend(one.stderr);
        }
        each
    }];
    assert!(!together.stdout.is_empty());
    assert_eq!(String::from_utf8_lossy(&together.stdout), String::from_utf8_lossy(&each.stdout));
    assert_eq!(String::from_utf8_lossy(&together.stderr), String::from_utf8_lossy(&each.stderr));
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

/// Repairs of a zoo, which is sent a signal: either the run, or the worker alone, once there is one.
#[cfg(target_os = "linux")]
fn repaired_until(signal: &str, is_for_the_run: bool) -> (TempDir, Vec<PathBuf>, Output) {
    let (room, dirs) = zoo();
    let mut command = program();
    command.args(["check", "--isolated", "--fix", "--unsafe-fixes", "--output-format", "json"]).args(&dirs);
    let mut run = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let worker = loop {
        assert!(run.try_wait().unwrap().is_none(), "the run ended before a worker was seen");
        if let Some(worker) = workers(run.id()).pop() {
            break worker;
        }
    };
    // Not before it has installed its handlers, which it does after it has read the rules.
    let ready = || fs::read_to_string(format!("/proc/{worker}/status")).is_ok_and(|status| handles(&status, 15));
    while !ready() {
        assert!(run.try_wait().unwrap().is_none(), "the run ended before its worker was ready");
    }
    let to = if is_for_the_run { run.id().to_string() } else { worker };
    let _status = Command::new("kill").args([signal, &to]).stderr(Stdio::null()).status().unwrap();
    (room, dirs, run.wait_with_output().unwrap())
}

/// Whether a process has a handler of the signal. Source: `proc_pid_status(5)`, `SigCgt`.
#[cfg(target_os = "linux")]
fn handles(status: &str, signal: u32) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap_or_default();
    u64::from_str_radix(mask.trim(), 16).is_ok_and(|mask| mask >> (signal - 1) & 1 == 1)
}

/// A run after another one completes what that began: every directory is as if nothing had happened.
#[cfg(target_os = "linux")]
fn assert_completed(dirs: &[PathBuf]) {
    let (_room, whole) = zoo();
    for zoo in [dirs, &whole] {
        check(zoo, &["--fix", "--unsafe-fixes"]);
    }
    for (one, other) in dirs.iter().zip(&whole) {
        assert!(files(one) == files(other), "{}", one.display());
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_signal_ends_the_repair_of_a_zoo() {
    let ended = || Some(repaired_until("-TERM", true)).filter(|(_, _, output)| output.status.code() == Some(143));
    let (_room, dirs, output) = (0..20).find_map(|_| ended()).expect("a run that is stopped");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.trim_end().ends_with(": interrupted; nothing was written"), "{said}");
    assert_completed(&dirs);
}

#[cfg(target_os = "linux")]
#[test]
fn a_worker_that_ends_in_a_repair_costs_one_directory() {
    for (signal, why) in [
        ("-TERM", "the process that repaired it was told to stop; nothing was written"),
        (
            "-KILL",
            "the process that checked it ended with SIGKILL, which the kernel sends when memory or time runs out; \
             what it wrote is finished or taken back by the next `check --fix` or `undo`",
        ),
    ] {
        let ended = || Some(repaired_until(signal, false)).filter(|(_, _, output)| output.status.code() == Some(2));
        let (_room, dirs, output) = (0..20).find_map(|_| ended()).expect("a worker that is stopped");
        let (unchecked, checked) = unchecked(&json(&output));
        assert_eq!((unchecked.len(), checked), (1, dirs.len() - 1), "{unchecked:#?}");
        assert!(unchecked[0].ends_with(why), "{unchecked:#?}");
        assert_completed(&dirs);
    }
}

#[test]
fn a_worker_answers_nobody_else() {
    for args in [&["--check-in-worker"] as &[&str], &["--check-in-worker", "rules"]] {
        let output = program().args(args).stdin(Stdio::null()).output().unwrap();
        assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(2), [].as_slice()), "{args:?}");
    }
}
