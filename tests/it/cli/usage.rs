//! Help texts, tips for mistyped words, and paths as given by the user.

use std::fmt::Write as _;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Output;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::project;

fn doctor(dir: &Path, args: &[&str]) -> Output {
    crate::support::program().args(args).current_dir(dir).env_remove("COLUMNS").output().unwrap()
}

#[test]
fn every_command_has_its_help() {
    let mut all = String::new();
    let commands = [
        "",
        "check",
        "undo",
        "build-merged",
        "inspect",
        "diff",
        "expect",
        "explain",
        "rules",
        "recipes",
        "init",
        "completions",
        "man",
    ];
    for command in commands {
        let args: Vec<&str> = [command, "-h"].into_iter().filter(|arg| !arg.is_empty()).collect();
        let output = doctor(project(), &args);
        assert!(output.status.success());
        let _ok = writeln!(all, "$ ckpt-doctor {}\n{}", args.join(" "), String::from_utf8(output.stdout).unwrap());
    }
    snapshot!("help", all);
}

#[test]
fn completions_are_printed_for_every_shell() {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let output = doctor(project(), &["completions", shell]);
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success());
        for word in ["build-merged", "unsafe-fixes", "merge"] {
            assert!(text.contains(word), "{word} is missing for {shell}");
        }
    }
    let bash = String::from_utf8(doctor(project(), &["completions", "bash"]).stdout).unwrap();
    let states = bash.lines().filter_map(|line| line.trim().strip_prefix("cmd=\"")?.strip_suffix('"'));
    for state in states.filter(|state| !state.is_empty()) {
        assert!(bash.contains(&format!("\n        {state})\n")), "no words for {state}");
    }

    let output = doctor(project(), &["man", "cmp"]);
    assert_eq!(String::from_utf8(output.stderr).unwrap(), "error: unknown command: cmp\n");
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn words_that_people_type_lead_to_the_right_command() {
    let cases = [
        "fix",
        "validate",
        "scan",
        "cmp",
        "info",
        "ls",
        "tree",
        "combine",
        "lora",
        "split",
        "swap",
        "revert",
        "why",
        "memory",
        "load",
        "settings",
        "version",
        "convert",
        "download",
        "fixtures/donors/llava3d-tiny",
        "chekc",
        "check --fxi",
        "check --json",
        "inspect --json",
        "check --sarif",
        "check -o",
        "extract -o",
        "insert --output",
        "check --strict",
        "check --dry-run",
        "check --apply",
        "undo --json",
    ];
    let mut all = String::new();
    for typed in cases {
        let output = doctor(project(), &typed.split(' ').collect::<Vec<_>>());
        assert_eq!(output.status.code(), Some(2), "{typed}");
        let errors = String::from_utf8(output.stderr).unwrap();
        let lines = errors.lines().filter(|line| line.starts_with("error:") || line.contains("tip:"));
        let _ok = writeln!(all, "$ ckpt-doctor {typed}\n{}\n", lines.collect::<Vec<_>>().join("\n"));
    }
    snapshot!("tips", all);
}

/// The record of a dry run.
fn planned(dir: &Path, file: &str) -> Value {
    let output = doctor(dir, &["merge", file, "--dry-run", "--format", "json"]);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {output:?}"));
    report["merge"].clone()
}

#[test]
fn paths_of_a_merge_file_are_printed_in_their_short_form() {
    let merge = planned(project(), "fixtures/merge.json5");
    assert_eq!(merge["out"], "merged-tiny");
    assert_eq!(merge["donors"]["vision"], "fixtures/donors/spatialvla-tiny");

    // `link/../merged` is beside the target of the link, not beside the link.
    let work = TempDir::new().unwrap();
    fs::create_dir_all(work.path().join("real/deep")).unwrap();
    symlink("real/deep", work.path().join("link")).unwrap();
    let donor = |name: &str| project().join("fixtures/donors").join(name);
    let file = json!({
        "donors": { "vision": donor("spatialvla-tiny"), "language": donor("llava3d-tiny") },
        "out": "../merged",
    });
    fs::write(work.path().join("real/deep/merge.json5"), file.to_string()).unwrap();
    assert_eq!(planned(work.path(), "link/merge.json5")["out"], "link/../merged");
    assert_eq!(planned(work.path(), "real/deep/merge.json5")["out"], "real/merged");
}

/// Standard output is no terminal here, which has no colours unless they are forced.
#[test]
fn the_environment_forces_colours_or_forbids_them() {
    let donor = project().join("fixtures/donors/llava3d-tiny");
    for (variables, args, is_colored) in [
        (&[][..], &[][..], false),
        (&[("FORCE_COLOR", "1")], &[], true),
        (&[("FORCE_COLOR", "0")], &[], false),
        (&[("FORCE_COLOR", "")], &[], false),
        (&[("CLICOLOR_FORCE", "1"), ("TERM", "dumb")], &[], true),
        (&[("FORCE_COLOR", "1"), ("NO_COLOR", "1")], &[], false),
        (&[("FORCE_COLOR", "1")], &["--color", "never"], false),
        (&[("NO_COLOR", "1")], &["--color", "always"], true),
    ] {
        let mut command = crate::support::program();
        command.env_remove("NO_COLOR").envs(variables.iter().copied()).arg("check").arg(&donor).args(args);
        let shown = command.output().unwrap().stdout;
        assert_eq!(shown.contains(&b'\x1b'), is_colored, "{variables:?} {args:?}");
    }
}
