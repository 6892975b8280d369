//! Arguments of the command line, with their help texts.

use std::num::NonZeroU8;
use std::path::PathBuf;

use clap::builder::{PossibleValuesParser, TypedValueParser as _};
use clap::{Arg, Args, Parser, Subcommand, ValueEnum};
use clap_complete::Shell;

use super::pins::or_file;
use crate::check::Severity;
use crate::knowledge::loader::{parse_program, parse_requirement};
use crate::report::Format;

mod merge;

pub use merge::{BuildMergedArgs, ExtractArgs, InsertArgs, MergeAdapterArgs, VerifyArgs};

/// Validates, repairs and merges model checkpoint directories by reading their files; nothing of a model is run.
#[derive(Debug, Parser)]
#[command(name = "ckpt-doctor", version, propagate_version = true)]
pub struct Cli {
    /// The subcommand.
    #[command(subcommand)]
    pub command: Command,
    /// Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors
    /// (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name
    #[arg(long, value_name = "DIR", global = true)]
    pub rules: Option<PathBuf>,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Check checkpoint directories; with --fix, repair them
    Check(CheckArgs),
    /// Undo the latest repair of each checkpoint, byte for byte
    Undo(UndoArgs),
    /// Build one checkpoint from parts of two others
    #[command(visible_alias = "merge")]
    BuildMerged(BuildMergedArgs),
    /// Take a part out of a model, as a checkpoint of its own class
    Extract(ExtractArgs),
    /// Put a part into a model, such as a language model that was trained on text alone
    Insert(InsertArgs),
    /// Merge a LoRA of PEFT into the model that it was trained on
    MergeAdapter(MergeAdapterArgs),
    /// Compare a merged checkpoint with its manifest and, byte for byte, with its donors
    Verify(VerifyArgs),
    /// Summarise a checkpoint: tensors, model class, inferred config values
    Inspect(InspectArgs),
    /// Compare two checkpoints: tensors under one naming, config values, tokens and files
    #[command(visible_alias = "compare")]
    Diff(DiffArgs),
    /// Print the tensors that a model class expects, from its config alone
    Expect(ExpectArgs),
    /// Print the documentation of a rule or a recipe
    Explain(ExplainArgs),
    /// List the rules
    Rules(SettingsArgs),
    /// List the recipes of build-merged, with what each donor has to be
    Recipes(RecipesArgs),
    /// Write a settings file, ckpt-doctor.json5, with every key explained
    Init(InitArgs),
    /// Print the completions for a shell
    Completions(CompletionsArgs),
    /// Print a page of the manual
    Man(ManArgs),
}

/// Settings file selection.
#[derive(Debug, Args)]
#[command(next_help_heading = "Settings")]
pub struct SettingsArgs {
    /// Use this settings file instead of the nearest ckpt-doctor.json5 from the working directory upward
    #[arg(long, value_name = "FILE", conflicts_with = "isolated")]
    pub config: Option<PathBuf>,
    /// Use no settings file
    #[arg(long)]
    pub isolated: bool,
}

/// Hides the global option `--rules` in the help of a subcommand that does not use it.
fn hidden_rules() -> Arg {
    Arg::new("rules").long("rules").value_name("DIR").value_parser(clap::value_parser!(PathBuf)).hide(true)
}

/// Arguments of `init`.
#[derive(Debug, Args)]
#[command(arg(hidden_rules()))]
pub struct InitArgs {
    /// Directory to write the settings file to
    #[arg(value_name = "DIR", default_value = ".")]
    pub dir: PathBuf,
    /// Also write a .pre-commit-config.yaml
    #[arg(long)]
    pub pre_commit: bool,
}

/// Arguments of `completions`.
#[derive(Debug, Args)]
#[command(
    arg(hidden_rules()),
    after_help = "Files that the shells read:\n  \
bash        ~/.local/share/bash-completion/completions/ckpt-doctor\n  \
zsh         _ckpt-doctor in a directory of $fpath\n  \
fish        ~/.config/fish/completions/ckpt-doctor.fish\n  \
elvish      ~/.config/elvish/rc.elv, to append to\n  \
powershell  $PROFILE, to append to"
)]
pub struct CompletionsArgs {
    /// The shell
    #[arg(value_name = "SHELL")]
    pub shell: Shell,
}

/// Arguments of `man`.
#[derive(Debug, Args)]
#[command(arg(hidden_rules()), after_help = "To read a page: ckpt-doctor man check | man -l -")]
pub struct ManArgs {
    /// The command that the page describes; without it, the program
    #[arg(value_name = "COMMAND")]
    pub command: Option<String>,
}

/// Arguments of `expect`.
#[derive(Debug, Args)]
#[command(after_help = "Exit codes:\n  0  the tensors of every config were printed\n  \
1  a config failed: its architecture is unknown, or its values are not possible\n  \
2  a file could not be read")]
pub struct ExpectArgs {
    /// A config.json, a directory that contains one, or @FILE: one JSON object per line, with the config under "config"
    /// and, to override the config's own class, a class name under "class"
    #[arg(value_name = "CONFIG|DIR|@FILE", required = true)]
    pub configs: Vec<String>,
    /// Version of transformers that builds the class, as 4.57.3 or transformers==4.57.3, or @FILE for the one that a lock file
    /// pins; the nearest known version that has the class is used [default: the version that the config names]
    #[arg(long = "for", value_name = "transformers==VERSION", value_parser = or_file(parse_requirement))]
    pub target: Option<String>,
    /// Output format; in jsonl, a config that fails has an "error" and the others are still printed
    #[arg(long, alias = "format", value_name = "FMT", default_value = "text")]
    pub output_format: ExpectFormat,
}

/// Arguments of `inspect`.
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// A checkpoint directory, with or without a config.json, or a file of tensors (safetensors, or a pickle)
    #[arg(value_name = "PATH", default_value = ".")]
    pub path: PathBuf,
    /// Print the tree of modules to N levels, 0 for all; without it, as many as stay short. JSON has all
    #[arg(long, value_name = "N", conflicts_with = "tensors")]
    pub depth: Option<usize>,
    /// List the tensors, or those whose names match GLOB (`*` is any text): shape, dtype, bytes, and place in the files
    #[arg(long, value_name = "GLOB", num_args = 0..=1, require_equals = true, default_missing_value = "*")]
    pub tensors: Option<String>,
    /// Tokens of the cache whose memory is estimated [default: the longest input that the config names]
    #[arg(long, value_name = "TOKENS")]
    pub context: Option<u64>,
    /// Sequences of that cache
    #[arg(long, value_name = "N", default_value = "1")]
    pub batch: u64,
    /// Output.
    #[command(flatten)]
    pub output: InspectOutput,
}

/// Arguments of `diff`.
#[derive(Debug, Args)]
pub struct DiffArgs {
    /// The first checkpoint: a directory, or a file of tensors
    #[arg(value_name = "BEFORE")]
    pub before: PathBuf,
    /// The second one
    #[arg(value_name = "AFTER")]
    pub after: PathBuf,
    /// Compare all bytes of tensors that have the same type and shape, not only the first, middle and last ones
    #[arg(long)]
    pub bytes: bool,
    /// Compare all bytes, and measure tensors that differ; with =rank also the rank of the difference of two matrices
    #[arg(long, value_name = "WHAT", num_args = 0..=1, require_equals = true, default_missing_value = "values")]
    pub stats: Option<DiffStats>,
    /// Output.
    #[command(flatten)]
    pub output: InspectOutput,
}

/// What `diff --stats` measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DiffStats {
    /// Norm and largest value of the difference, and the cosine of the angle
    Values,
    /// These, and the rank of the difference
    Rank,
}

/// Options for the output of `inspect` and `diff`.
#[derive(Debug, Args)]
pub struct InspectOutput {
    /// Output format
    #[arg(long, alias = "format", value_name = "FMT", default_value = "full")]
    pub output_format: InspectFormat,
    /// Also write the output to a file in any of these formats; may be repeated
    #[arg(long, value_name = "FMT=FILE", value_parser = parse_inspect_report)]
    pub report: Vec<(InspectFormat, PathBuf)>,
    /// When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`
    #[arg(long, value_name = "WHEN", default_value = "auto")]
    pub color: Color,
}

/// Formats of `inspect` and `diff`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum InspectFormat {
    /// For a terminal
    Full,
    /// One JSON object, complete
    Json,
    /// A page for a browser, in one file
    Html,
}

/// Formats of `verify`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum VerifyFormat {
    /// For a terminal
    Full,
    /// One JSON object, complete
    Json,
}

/// Formats of `expect`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ExpectFormat {
    /// One tensor per line
    Text,
    /// A list with one object per config
    Json,
    /// One object per line and config
    Jsonl,
}

/// Arguments of `explain`.
#[derive(Debug, Args)]
pub struct ExplainArgs {
    /// Code, name or family of rules (IDX005, shard-missing, IDX), name of a recipe, or the text of an error
    #[arg(value_name = "RULE|RECIPE|ERROR", required = true)]
    pub words: Vec<String>,
    /// Settings file selection.
    #[command(flatten)]
    pub settings: SettingsArgs,
}

/// Arguments of `recipes`.
#[derive(Debug, Args)]
pub struct RecipesArgs {
    /// Output format
    #[arg(long, alias = "format", value_name = "FMT", default_value = "text")]
    pub output_format: ListFormat,
}

/// Formats of `recipes`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ListFormat {
    /// For a terminal
    Text,
    /// One JSON object, complete
    Json,
}

/// Report formats, files and the exit code.
#[derive(Debug, Args)]
#[command(next_help_heading = "Output")]
pub struct ReportArgs {
    /// Format of the report on standard output
    #[arg(long, alias = "format", value_name = "FMT", default_value = "full", value_parser = formats())]
    pub output_format: Format,
    /// Also write the report to a file in any of these formats; may be repeated
    #[arg(long, value_name = "FMT=FILE", value_parser = parse_report)]
    pub report: Vec<(Format, PathBuf)>,
    /// Lowest severity that makes the exit code 1 [default: error]
    #[arg(long, value_name = "SEVERITY")]
    pub fail_on: Option<SeverityName>,
    /// Exit with 0 even if there are findings
    #[arg(long)]
    pub exit_zero: bool,
    /// When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`
    #[arg(long, value_name = "WHEN", default_value = "auto")]
    pub color: Color,
}

impl ReportArgs {
    /// Whether a report is made in this format.
    pub fn has(&self, format: Format) -> bool {
        self.output_format == format || self.report.iter().any(|(other, _)| *other == format)
    }
}

/// The baseline: findings that are accepted because they existed before.
#[derive(Debug, Args)]
#[command(next_help_heading = "Baseline")]
pub struct BaselineArgs {
    /// Do not count the findings listed in this file, and list those that no longer occur
    #[arg(long, value_name = "FILE")]
    pub baseline: Option<PathBuf>,
    /// Write the current findings to the baseline instead of comparing with it
    #[arg(long)]
    pub write_baseline: bool,
}

/// Arguments of `check`.
#[derive(Debug, Args)]
#[command(after_help = "Exit codes:\n  0  no findings at or above --fail-on\n  \
1  findings at or above --fail-on; with --diff, a fix would change something\n  \
2  a path could not be checked (missing, without a checkpoint, unreadable), or wrong argument; the other paths are \
reported, and 2 takes precedence over 1")]
#[expect(clippy::struct_excessive_bools, reason = "one for each flag of the command")]
pub struct CheckArgs {
    /// Checkpoint directories, directories that contain checkpoints, or files of checkpoints
    #[arg(value_name = "PATH", default_value = ".")]
    pub paths: Vec<PathBuf>,
    /// Predict the load for these versions: 4.57, transformers==4.57.3, or all; peft==0.13.2 for adapters; vllm, mlx-lm and
    /// llama.cpp for what is known of them; @FILE for those that a lock file, pyproject.toml or requirements file pins; may be
    /// repeated [default: the version that wrote config.json, and the newest known of each major version]
    #[arg(long = "for", value_name = "VERSION", value_delimiter = ',', value_parser = or_file(parse_program))]
    pub versions: Vec<String>,
    /// As --for, for the versions of transformers and PEFT that this Python interpreter has: it is started to list them, and
    /// nothing of a model is run
    #[arg(long, value_name = "PYTHON")]
    pub for_python: Option<PathBuf>,
    /// Also read the bytes of every tensor, to find NaN, infinity, trailing zeros and tied weights that differ
    #[arg(long)]
    pub deep: bool,
    /// As --deep, and show smallest and largest value, mean, root mean square, zeros and denormals of each tensor (formats
    /// full and json)
    #[arg(long)]
    pub stats: bool,
    /// Also hash the files whose hash the Hub cache, a local download or git recorded, to find changed ones
    #[arg(long)]
    pub hash: bool,
    /// Accept checkpoints without weights, such as copies of the documents alone; their load is not predicted
    #[arg(long)]
    pub metadata_only: bool,
    /// Read files through symbolic links that lead into this directory; may be repeated. Other links out of a checkpoint are
    /// not followed, except into the Hub cache
    #[arg(long, value_name = "DIR")]
    pub follow_links: Vec<PathBuf>,
    /// The base model of the adapters. Without it, they are compared with the one beside them, with one among the paths, or with
    /// one that was downloaded from the Hub
    #[arg(long, value_name = "DIR")]
    pub base: Option<PathBuf>,
    /// Directories that are checked at once, each by a process of its own [default: one for each processor, at most 16]
    #[arg(short, long, value_name = "N")]
    pub jobs: Option<NonZeroU8>,
    /// Run only these rules: codes, prefixes of codes (JSN) or names, comma-separated
    #[arg(long, value_name = "RULE", value_delimiter = ',', help_heading = "Rule selection")]
    pub select: Vec<String>,
    /// Run these rules in addition to those that the settings select
    #[arg(long, value_name = "RULE", value_delimiter = ',', help_heading = "Rule selection")]
    pub extend_select: Vec<String>,
    /// Skip these rules; if --select and --ignore both match a rule, the longer selector wins
    #[arg(long, value_name = "RULE", value_delimiter = ',', help_heading = "Rule selection")]
    pub ignore: Vec<String>,
    /// Settings file selection.
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// The baseline.
    #[command(flatten)]
    pub baseline: BaselineArgs,
    /// What to fix, and where to write it.
    #[command(flatten)]
    pub fix: FixArgs,
    /// Report formats and the exit code.
    #[command(flatten)]
    pub report: ReportArgs,
    /// Count the findings of each rule instead of showing them (formats full, concise and json)
    #[arg(long, help_heading = "Output")]
    pub statistics: bool,
    /// Lowest severity that is reported; the exit code depends on --fail-on alone [default: info]
    #[arg(long, value_name = "SEVERITY", help_heading = "Output")]
    pub min_severity: Option<SeverityName>,
    /// Print findings only: neither the table, checkpoints without findings nor the summary (formats full and concise); rows
    /// with findings only (format table)
    #[arg(short, long, help_heading = "Output", conflicts_with_all = ["statistics", "verbose"])]
    pub quiet: bool,
    /// Explain why each skipped rule was skipped
    #[arg(short, long, help_heading = "Output")]
    pub verbose: bool,
}

/// What `check` fixes, and where it writes.
#[derive(Debug, Args)]
#[command(next_help_heading = "Fixes")]
#[allow(clippy::struct_excessive_bools, reason = "each is a switch of its own on the command line")]
pub struct FixArgs {
    /// Apply the safe fixes; `ckpt-doctor undo` restores the originals
    #[arg(long)]
    pub fix: bool,
    /// Also apply (or, without --fix, mark) the unsafe fixes: they change values or tensor names that a loader reads
    #[arg(long)]
    pub unsafe_fixes: bool,
    /// Show the changes that the fixes would make, and write nothing
    #[arg(long, conflicts_with_all = ["output", "fix_only"])]
    pub diff: bool,
    /// Apply the fixes as --fix does, but neither report the remaining findings nor fail because of them
    #[arg(long)]
    pub fix_only: bool,
    /// Exit with 1 if anything was fixed, even if no finding remains
    #[arg(long)]
    pub exit_non_zero_on_fix: bool,
    /// With --fix: write a repaired copy to this directory and leave the checkpoint unchanged; files without changes
    /// become hard links to the originals (on another file system, copies or, above 64 MiB, symbolic links)
    #[arg(long, value_name = "DIR")]
    pub output: Option<PathBuf>,
    /// With --fix: also finish or roll back an interrupted repair that you did not begin in this directory, such as one in a
    /// copy. Its journal decides which files are written, so know where the directory comes from
    #[arg(long, conflicts_with_all = ["output", "diff"])]
    pub adopt_journal: bool,
}

/// Arguments of `undo`.
#[derive(Debug, Args)]
#[command(
    arg(hidden_rules()),
    after_help = "Exit codes:\n  0  the repair was undone\n  2  there is no repair to undo, it is not \
yours, or a file has changed since the repair"
)]
pub struct UndoArgs {
    /// Checkpoints that `check --fix` repaired, or directories that contain them
    #[arg(value_name = "PATH", default_value = ".")]
    pub paths: Vec<PathBuf>,
    /// Also undo a repair that you did not make in this directory, such as one in a copy. Its journal decides which files are
    /// written, so know where the directory comes from. For one checkpoint alone
    #[arg(long)]
    pub adopt_journal: bool,
}

/// Severity as an argument.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SeverityName {
    /// All findings
    Info,
    /// Warnings and errors
    Warning,
    /// Errors only
    Error,
}

impl SeverityName {
    /// The severity of this name.
    pub const fn severity(self) -> Severity {
        match self {
            Self::Info => Severity::Info,
            Self::Warning => Severity::Warning,
            Self::Error => Severity::Error,
        }
    }
}

/// When to print colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Color {
    /// On a terminal
    Auto,
    /// Always
    Always,
    /// Never
    Never,
}

/// Accepts the names of report formats, and lists them in the help.
fn formats() -> impl clap::builder::TypedValueParser<Value = Format> {
    PossibleValuesParser::new(Format::ALL.map(Format::name)).try_map(|word| word.parse::<Format>())
}

fn parse_format(word: &str) -> Result<Format, String> {
    word.parse().map_err(|e: crate::report::UnknownFormat| e.to_string())
}

fn parse_pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() && !value.is_empty() => Ok((name.to_owned(), value.to_owned())),
        _ => Err("expected NAME=VALUE".to_owned()),
    }
}

fn parse_inspect_report(text: &str) -> Result<(InspectFormat, PathBuf), String> {
    let (format, file) = parse_pair(text).map_err(|_| "expected FMT=FILE".to_owned())?;
    let known = InspectFormat::value_variants().iter().filter_map(InspectFormat::to_possible_value);
    let known: Vec<String> = known.map(|value| value.get_name().to_owned()).collect();
    let format = InspectFormat::from_str(&format, false)
        .map_err(|_| format!("`{format}` is not an output format; known are {}", known.join(", ")))?;
    Ok((format, PathBuf::from(file)))
}

fn parse_report(text: &str) -> Result<(Format, PathBuf), String> {
    let (format, file) = parse_pair(text).map_err(|_| "expected FMT=FILE".to_owned())?;
    Ok((parse_format(&format)?, PathBuf::from(file)))
}
