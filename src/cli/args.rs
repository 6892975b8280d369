//! What can be typed.

use std::path::PathBuf;

use ckpt_doctor::check::Severity;
use ckpt_doctor::knowledge::loader::asked;
use ckpt_doctor::report::Format;
use clap::{Args, Parser, Subcommand, ValueEnum};

/// Validates, repairs and merges model checkpoint directories from their files alone.
#[derive(Debug, Parser)]
#[command(name = "ckpt-doctor", version, propagate_version = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// A folder laid out as the program's own rules: checks/**/*.json5 are asked too; architectures/*.json5 are known too,
    /// or replace what has the same name
    #[arg(long, value_name = "DIR", global = true)]
    pub rules: Option<PathBuf>,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Check checkpoint directories
    Check(CheckArgs),
    /// Take back the latest repair of a checkpoint, byte for byte
    Undo(UndoArgs),
    /// Build one checkpoint from parts of two
    BuildMerged(BuildMergedArgs),
    /// Say what a checkpoint is: tensors, class, and the config values that the tensors show
    Inspect(InspectArgs),
    /// Print the tensors that a model class has, by its config alone
    Expect(ExpectArgs),
    /// Say all there is to say of one rule
    Explain(ExplainArgs),
    /// List the rules
    Rules(SettingsArgs),
    /// Write a ckpt-doctor.json5 with every key explained
    Init(InitArgs),
}

/// Which settings to go by.
#[derive(Debug, Args)]
pub struct SettingsArgs {
    /// This settings file, instead of the nearest ckpt-doctor.json5 in the folders above each checkpoint
    #[arg(long, value_name = "FILE", conflicts_with = "isolated")]
    pub config: Option<PathBuf>,
    /// No settings file
    #[arg(long)]
    pub isolated: bool,
}

/// Arguments of `init`.
#[derive(Debug, Args)]
pub struct InitArgs {
    /// Where to write it
    #[arg(value_name = "DIR", default_value = ".")]
    pub dir: PathBuf,
    /// Write a .pre-commit-config.yaml as well
    #[arg(long)]
    pub pre_commit: bool,
}

/// Arguments of `expect`.
#[derive(Debug, Args)]
#[command(after_help = "Exit codes: 0 all were built, 1 one could not be, 2 a file could not be read.")]
pub struct ExpectArgs {
    /// A config.json, a directory that has one, or @FILE: a JSON object a line, with the config in its `config` (and the
    /// class, where it is not the config's own, in its `class`)
    #[arg(value_name = "CONFIG|DIR|@FILE", required = true)]
    pub configs: Vec<String>,
    /// The version that builds it, as 4.57.3 or transformers==4.57.3; the nearest known one that has the class stands for
    /// it, and without this the one nearest to what the config names
    #[arg(long = "for", value_name = "LOADER", value_parser = asked)]
    pub version: Option<String>,
    /// text: a tensor a line; json: a list; jsonl: an object a line for each config, and those that fail say why
    #[arg(long, value_name = "FMT", default_value = "text")]
    pub output_format: ExpectFormat,
}

/// Arguments of `inspect`.
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// A checkpoint directory, with a config.json or without, or a .safetensors file
    #[arg(value_name = "PATH", default_value = ".")]
    pub path: PathBuf,
    /// full: for a terminal; json: complete
    #[arg(long, value_name = "FMT", default_value = "full")]
    pub output_format: InspectFormat,
    /// When to use colours
    #[arg(long, value_name = "WHEN", default_value = "auto")]
    pub color: Color,
}

/// Formats of `inspect`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum InspectFormat {
    /// For a terminal.
    Full,
    /// An object.
    Json,
}

/// Formats of `expect`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ExpectFormat {
    /// A tensor a line.
    Text,
    /// A list of objects.
    Json,
    /// An object a line.
    Jsonl,
}

/// Arguments of `explain`.
#[derive(Debug, Args)]
pub struct ExplainArgs {
    /// Code or name: IDX005, shard-missing
    #[arg(value_name = "RULE")]
    pub rule: String,
    /// Which settings to go by.
    #[command(flatten)]
    pub settings: SettingsArgs,
}

/// How and where to report, and what counts as a failure.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Format of the report on standard output
    #[arg(long, value_name = "FMT", default_value = "full", value_parser = parse_format)]
    pub output_format: Format,
    /// Also write the report to a file; may be given several times
    #[arg(long, value_name = "FMT=FILE", value_parser = parse_report)]
    pub report: Vec<(Format, PathBuf)>,
    /// Least severity that makes the exit code 1; default: error
    #[arg(long, value_name = "SEVERITY")]
    pub fail_on: Option<FailOn>,
    /// Exit with 0 whatever is found
    #[arg(long)]
    pub exit_zero: bool,
    /// When to use colours
    #[arg(long, value_name = "WHEN", default_value = "auto")]
    pub color: Color,
}

/// Findings that were there before.
#[derive(Debug, Args)]
pub struct BaselineArgs {
    /// Do not count the findings in this file, and say which of them are gone
    #[arg(long, value_name = "FILE")]
    pub baseline: Option<PathBuf>,
    /// Write what is found to the baseline, instead of comparing with it
    #[arg(long)]
    pub write_baseline: bool,
}

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Checkpoint directories, directories that hold some, or files of checkpoints
    #[arg(value_name = "PATH", default_value = ".")]
    pub paths: Vec<PathBuf>,
    /// Versions to predict the load for; default: the one that wrote config.json, and the newest known
    #[arg(long = "for", value_name = "transformers==VERSION", value_parser = asked)]
    pub versions: Vec<String>,
    /// Also read the bytes of every tensor: NaN and infinity, ends of zeros, tied matrices that differ, hub checksums
    #[arg(long)]
    pub deep: bool,
    /// Only these rules: codes, starts of codes (JSN), or names; comma-separated
    #[arg(long, value_name = "RULE", value_delimiter = ',')]
    pub select: Vec<String>,
    /// These rules as well as those that the settings select
    #[arg(long, value_name = "RULE", value_delimiter = ',')]
    pub extend_select: Vec<String>,
    /// All but these rules; where both name one, the longer word wins
    #[arg(long, value_name = "RULE", value_delimiter = ',')]
    pub ignore: Vec<String>,
    /// What was there before.
    #[command(flatten)]
    pub baseline: BaselineArgs,
    /// Count findings by rule instead of showing them (full, concise and json)
    #[arg(long)]
    pub statistics: bool,
    /// Say of each rule that was not asked why
    #[arg(short, long)]
    pub verbose: bool,
    /// Which settings to go by.
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// What to do about findings.
    #[command(flatten)]
    pub fix: FixArgs,
    /// How to report.
    #[command(flatten)]
    pub report: ReportArgs,
}

/// What `check` does about findings.
#[derive(Debug, Args)]
#[command(next_help_heading = "Fixes")]
#[allow(clippy::struct_excessive_bools, reason = "each is a switch of its own on the command line")]
pub struct FixArgs {
    /// Make the safe fixes; `undo` takes them back
    #[arg(long)]
    pub fix: bool,
    /// Count unsafe fixes as well: they change what a loader would compute
    #[arg(long)]
    pub unsafe_fixes: bool,
    /// Show what the fixes would change and write nothing; the exit code is 1 if there is anything
    #[arg(long, conflicts_with_all = ["output", "fix_only"])]
    pub diff: bool,
    /// Make the fixes, and neither say what is left nor fail because of it
    #[arg(long)]
    pub fix_only: bool,
    /// Exit with 1 if anything was fixed, even if nothing is left
    #[arg(long)]
    pub exit_non_zero_on_fix: bool,
    /// Leave the checkpoint alone and make a repaired copy here, with links to the files that stay; needs --fix
    #[arg(long, value_name = "DIR")]
    pub output: Option<PathBuf>,
}

/// Arguments of `undo`.
#[derive(Debug, Args)]
#[command(after_help = "Exit codes: 0 undone, 2 there was nothing to undo, or a file has changed since.")]
pub struct UndoArgs {
    /// The checkpoint that `check --fix` has repaired
    #[arg(value_name = "DIR", default_value = ".")]
    pub path: PathBuf,
}

/// Arguments of `build-merged`.
#[derive(Debug, Args)]
#[command(after_help = "Without --recipe the donors' architectures choose it.\n\
Exit codes: 0 the merged checkpoint is written and sound, 1 a donor or a seam stopped it, 2 it could not be tried.")]
pub struct BuildMergedArgs {
    /// A merge.json5 that names recipe, donors, options and out
    #[arg(value_name = "MERGE_FILE", conflicts_with_all = ["recipe", "donor", "vision", "language"])]
    pub file: Option<PathBuf>,
    /// Recipe: a name, or a JSON5 file
    #[arg(long, value_name = "NAME|FILE")]
    pub recipe: Option<String>,
    /// Donor in a role; may be given several times
    #[arg(long, value_name = "ROLE=DIR", value_parser = parse_pair)]
    pub donor: Vec<(String, String)>,
    /// Short for --donor vision=DIR
    #[arg(long, value_name = "DIR")]
    pub vision: Option<PathBuf>,
    /// Short for --donor language=DIR
    #[arg(long, value_name = "DIR")]
    pub language: Option<PathBuf>,
    /// Directory to make: must not exist, or be empty
    #[arg(long, value_name = "DIR", required_unless_present = "file")]
    pub out: Option<PathBuf>,
    /// Option of the recipe; may be given several times
    #[arg(long, value_name = "OPTION=VALUE", value_parser = parse_pair)]
    pub set: Vec<(String, String)>,
    /// Stop before anything is written
    #[arg(long)]
    pub dry_run: bool,
    /// Record the SHA-256 of every byte of the donors, not only of documents and headers
    #[arg(long)]
    pub hash: bool,
    /// How to report.
    #[command(flatten)]
    pub report: ReportArgs,
}

/// Least severity that fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FailOn {
    /// Anything at all.
    Info,
    /// Warnings and errors.
    Warning,
    /// Errors.
    Error,
}

impl FailOn {
    /// The severity it names.
    pub const fn severity(self) -> Severity {
        match self {
            Self::Info => Severity::Info,
            Self::Warning => Severity::Warning,
            Self::Error => Severity::Error,
        }
    }
}

/// When to use colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Color {
    /// On a terminal.
    Auto,
    /// Always.
    Always,
    /// Never.
    Never,
}

fn parse_format(word: &str) -> Result<Format, String> {
    word.parse().map_err(|e: ckpt_doctor::report::UnknownFormat| e.to_string())
}

fn parse_pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() && !value.is_empty() => Ok((name.to_owned(), value.to_owned())),
        _ => Err("write it as NAME=VALUE".to_owned()),
    }
}

fn parse_report(text: &str) -> Result<(Format, PathBuf), String> {
    let (format, file) = parse_pair(text).map_err(|_| "write it as FMT=FILE".to_owned())?;
    Ok((parse_format(&format)?, PathBuf::from(file)))
}
