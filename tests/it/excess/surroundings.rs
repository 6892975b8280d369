//! The program in poor surroundings: it ends with a message and an exit code of its own.

use std::path::Path;
use std::process::Command;

use tempfile::TempDir;

use super::shape::Excess;
use crate::support::Draw;

/// What a shell does before it starts the program, and redirections.
const SURROUNDINGS: [(&str, &str); 12] = [
    ("ulimit -s 64", ""),
    ("ulimit -n 16", ""),
    ("ulimit -s 64; ulimit -n 16", ""),
    ("ulimit -f 0", "> report.txt"),
    ("ulimit -f 0", "2> errors.txt"),
    ("unset HOME XDG_STATE_HOME TERM LANG PATH", ""),
    ("export TERM=dumb", ""),
    (":", "<&-"),
    (":", ">&-"),
    (":", "2>&-"),
    (":", "<&- >&- 2>&-"),
    (":", "> /dev/full 2> /dev/full"),
];

#[test]
fn every_command_ends_with_a_code_of_its_own() {
    let dir = TempDir::new().unwrap();
    Excess::Nesting.write(dir.path(), 1, &mut Draw::new(1));
    let checkpoint = dir.path().to_str().unwrap();
    let commands: [&[&str]; 9] = [
        &["check", checkpoint],
        &["check", "--deep", checkpoint],
        &["check", "--fix", checkpoint],
        &["undo", checkpoint],
        &["inspect", checkpoint],
        &["expect", checkpoint],
        &["rules"],
        &["explain", "SAF001"],
        &["build-merged", "--vision", checkpoint, "--language", checkpoint, "--out", "out"],
    ];
    for (before, redirected) in SURROUNDINGS {
        for command in commands {
            let code = run(dir.path(), before, redirected, command);
            assert!(matches!(code, Some(0..=2)), "{before} {command:?} {redirected}: {code:?}");
        }
    }
}

/// The exit code of the program; above 128 for a signal.
fn run(dir: &Path, before: &str, redirected: &str, command: &[&str]) -> Option<i32> {
    let script = format!("ulimit -c 0; {before}; \"$0\" \"$@\" {redirected}");
    let shell = Command::new("/bin/sh")
        .args(["-c", &script, env!("CARGO_BIN_EXE_ckpt-doctor")])
        .args(command)
        .current_dir(dir)
        .env("XDG_STATE_HOME", crate::support::state())
        .output();
    shell.unwrap().status.code()
}
