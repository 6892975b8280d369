//! What README.md shows is what comes out.

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;
use std::{env, fs};

/// A command and the output that README.md shows for it.
struct Shown<'a> {
    command: &'a str,
    output: Vec<&'a str>,
}

/// The commands of all `console` blocks, in order.
fn shown(readme: &str) -> Vec<Shown<'_>> {
    let mut all: Vec<Shown> = Vec::new();
    let mut within = false;
    for line in readme.lines() {
        match line.strip_prefix("```") {
            Some(kind) => within = kind == "console",
            None if !within => {}
            None => match (line.strip_prefix("$ "), all.last_mut()) {
                (Some(command), _) => all.push(Shown { command, output: Vec::new() }),
                (None, Some(last)) => last.output.push(line),
                (None, None) => panic!("a console block starts with its output: {line}"),
            },
        }
    }
    all
}

/// Whether `real` is what is shown; a line `...` stands for any number of lines.
fn fits(shown: &[&str], real: &[&str]) -> bool {
    match shown.split_first() {
        None => real.is_empty(),
        Some((&"...", rest)) => (0..=real.len()).any(|skip| real.get(skip..).is_some_and(|real| fits(rest, real))),
        Some((first, rest)) => {
            real.split_first().is_some_and(|(line, real)| line.trim_end() == *first && fits(rest, real))
        }
    }
}

#[test]
fn the_readme_shows_what_comes_out() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let readme = fs::read_to_string(root.join("README.md")).unwrap();
    let place = tempfile::tempdir().unwrap();
    // As in a fresh clone after the first build: fixtures and a target directory.
    let copied = Command::new("cp").arg("-r").arg(root.join("fixtures")).arg(place.path()).status().unwrap();
    assert!(copied.success());
    fs::create_dir(place.path().join("target")).unwrap();
    let program = Path::new(env!("CARGO_BIN_EXE_ckpt-doctor")).parent().unwrap();
    let path = env::join_paths([program.to_owned()].into_iter().chain(env::split_paths(&env::var_os("PATH").unwrap())))
        .unwrap();

    let all = shown(&readme);
    assert!(all.iter().any(|s| s.command.starts_with("ckpt-doctor check")), "the tour is gone");
    let mut differences = String::new();
    for Shown { command, output } in all {
        let ran = Command::new("sh").args(["-c", command]).current_dir(&place).env("PATH", &path).output().unwrap();
        let real = String::from_utf8(ran.stdout).unwrap();
        if !fits(&output, &real.lines().collect::<Vec<_>>()) {
            let _ok = writeln!(differences, "$ {command}\n{real}{}", String::from_utf8_lossy(&ran.stderr));
        }
    }
    assert!(differences.is_empty(), "README.md shows something else for\n{differences}");
}
