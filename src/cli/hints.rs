//! Hints for mistyped options, and for subcommands that people know from other tools.

use std::path::Path;

use crate::knowledge::source::nearest;
use clap::CommandFactory as _;
use clap::error::{ContextKind, ContextValue, Error, ErrorKind};

use super::args::Cli;

/// Words that people type for a command, and what does it here; `None` for what nothing here does, so that no similar word is
/// offered.
const COMMANDS: [(&[&str], Option<&str>); 13] = [
    (
        &[
            "analyse", "analyze", "audit", "diagnose", "doctor", "examine", "lint", "load", "loads", "scan", "test",
            "validate", "zoo",
        ],
        Some("check"),
    ),
    (&["fix", "format", "heal", "repair"], Some("check --fix")),
    (&["cmp", "delta"], Some("diff")),
    (
        &[
            "cat", "describe", "dump", "estimate", "head", "header", "headers", "info", "keys", "list", "ls", "mem",
            "memory", "params", "print", "shapes", "show", "size", "stat", "stats", "summary", "tensors", "tree",
            "view", "vram",
        ],
        Some("inspect"),
    ),
    (&["combine", "graft", "join", "mix"], Some("build-merged")),
    (&["lora", "merge-lora", "merge-peft"], Some("merge-adapter")),
    (&["slice", "split", "take"], Some("extract")),
    (&["replace", "swap"], Some("insert")),
    (&["restore", "revert", "rollback"], Some("undo")),
    (&["docs", "rule", "why"], Some("explain")),
    (&["config", "settings"], Some("init")),
    (&["version"], Some("--version")),
    (&["convert", "download", "pull", "push", "quantise", "quantize", "upload"], None),
];

/// Options that people type, with an option that does it and how it is passed. The first whose option the command has is offered.
const OPTIONS: [(&str, &str, &str); 16] = [
    ("--json", "output-format", "--output-format json"),
    ("--sarif", "report", "--output-format sarif"),
    ("--markdown", "report", "--output-format markdown"),
    ("-f", "output-format", "--output-format"),
    ("-o", "out", "--out"),
    ("-o", "output-format", "--output-format"),
    ("--output", "out", "--out"),
    ("--output", "output-format", "--output-format"),
    ("--out", "output", "--output"),
    ("--strict", "fail-on", "--fail-on warning"),
    ("--dry-run", "diff", "--diff"),
    ("--apply", "fix", "--fix"),
    ("--autofix", "fix", "--fix"),
    ("--write", "fix", "--fix"),
    ("--unsafe", "unsafe-fixes", "--fix --unsafe-fixes"),
    ("--no-color", "color", "--color never"),
];

/// Adds `tip: run 'ckpt-doctor check --fix'` to the error for `ckpt-doctor fix`, and a similar option to the error for an
/// unknown one, such as `--fix` for `--fxi`.
pub fn explained(mut error: Error) -> Error {
    match (error.kind(), error.get(ContextKind::InvalidSubcommand), error.get(ContextKind::InvalidArg)) {
        (ErrorKind::InvalidSubcommand, Some(ContextValue::String(word)), _) => {
            let known = COMMANDS.iter().find(|(words, _)| words.contains(&word.as_str())).map(|(_, instead)| *instead);
            let instead = match known {
                Some(instead) => instead.map(str::to_owned),
                None if word.contains('/') || Path::new(word).exists() => Some(format!("check {word}")),
                None => return error,
            };
            error.remove(ContextKind::SuggestedSubcommand);
            if let Some(instead) = instead {
                let tip = format!("run 'ckpt-doctor {instead}'");
                error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip.into()]));
            }
        }
        (ErrorKind::UnknownArgument, _, Some(ContextValue::String(word))) => {
            if let Some(option) = option_for(word) {
                error.remove(ContextKind::Suggested);
                error.insert(ContextKind::SuggestedArg, ContextValue::String(option));
            }
        }
        _ => {}
    }
    error
}

/// The option of the given subcommand that does what `word` asks for, or else the one that is most similar.
fn option_for(word: &str) -> Option<String> {
    let cli = Cli::command();
    let command = std::env::args().skip(1).find_map(|argument| cli.find_subcommand(argument))?;
    let options: Vec<&str> = command.get_arguments().filter_map(clap::Arg::get_long).collect();
    let known = OPTIONS.iter().find(|(typed, option, _)| *typed == word && options.contains(option));
    known.map(|(_, _, instead)| (*instead).to_owned()).or_else(|| {
        let options: Vec<String> = options.iter().map(|option| format!("--{option}")).collect();
        nearest(word, options.iter().map(String::as_str)).map(str::to_owned)
    })
}
