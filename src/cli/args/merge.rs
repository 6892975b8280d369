//! Arguments of the commands that write a merged checkpoint, and of the one that verifies it.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::{Color, ReportArgs, VerifyFormat, hidden_rules, parse_pair};
use crate::checkpoint::HashAlgorithm;
use crate::cli::pins::or_file;
use crate::knowledge::loader::parse_requirement_or_all;

/// Arguments of `build-merged`.
#[derive(Debug, Args)]
#[command(disable_help_flag = true)]
#[command(after_help = "Without --recipe, the architectures of the donors determine the recipe.\n\n\
Exit codes:\n  0  the merged checkpoint is written (or, with --dry-run, planned) without findings at or above --fail-on\n  \
1  the merged checkpoint is written (or planned), and has findings at or above --fail-on\n  \
2  the merge was refused because of a donor, a seam or the plan, or it failed, or wrong argument")]
pub struct BuildMergedArgs {
    /// A merge file (JSON5) with the recipe, donors, options and output directory
    #[arg(value_name = "MERGE_FILE", conflicts_with_all = ["recipe", "donor", "vision", "language"])]
    pub file: Option<PathBuf>,
    /// Name of a recipe (see `ckpt-doctor recipes`), or a JSON5 file
    #[arg(long, value_name = "NAME|FILE")]
    pub recipe: Option<String>,
    /// Print the text of the recipe, and do nothing else
    #[arg(long, requires = "recipe")]
    pub print_recipe: bool,
    /// Print help; with --recipe, print the donors and options of the recipe
    #[arg(short, long)]
    pub help: bool,
    /// Checkpoint that supplies the parts of a role; may be repeated
    #[arg(long, value_name = "ROLE=DIR", value_parser = parse_pair)]
    pub donor: Vec<(String, String)>,
    /// Short for --donor vision=DIR
    #[arg(long, value_name = "DIR")]
    pub vision: Option<PathBuf>,
    /// Short for --donor language=DIR
    #[arg(long, value_name = "DIR")]
    pub language: Option<PathBuf>,
    /// Output directory; it must not exist, or be empty
    #[arg(long, value_name = "DIR", required_unless_present_any = ["file", "print_recipe", "help"])]
    pub out: Option<PathBuf>,
    /// What is merged and reported.
    #[command(flatten)]
    pub how: MergeArgs,
}

/// Arguments of `verify`.
#[derive(Debug, Args)]
#[command(
    arg(hidden_rules()),
    after_help = "Exit codes:\n  0  everything is equal\n  1  a file or tensor differs, is missing, or is not in the manifest\n  \
2  the manifest or a file could not be read, or not everything could be verified"
)]
pub struct VerifyArgs {
    /// A directory that build-merged wrote
    #[arg(value_name = "DIR", default_value = ".")]
    pub path: PathBuf,
    /// Recompute the tensors that were made from this donor, and compare them byte for byte; may be repeated
    #[arg(long, value_name = "ROLE=DIR", value_parser = parse_pair)]
    pub donor: Vec<(String, String)>,
    /// Output format
    #[arg(long, alias = "format", value_name = "FMT", default_value = "full")]
    pub output_format: VerifyFormat,
    /// When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`
    #[arg(long, value_name = "WHEN", default_value = "auto")]
    pub color: Color,
}

/// Arguments of `extract`.
#[derive(Debug, Args)]
#[command(after_help = "This is `build-merged --recipe extract`.\n\nExit codes: those of build-merged")]
pub struct ExtractArgs {
    /// The model
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
    /// Name of the part, such as language or vision, or the JSON pointer of its config
    #[arg(long, value_name = "PART")]
    pub part: String,
    /// Output directory; it must not exist, or be empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What is merged and reported.
    #[command(flatten)]
    pub how: MergeArgs,
}

/// Arguments of `insert`.
#[derive(Debug, Args)]
#[command(after_help = "This is `build-merged --recipe insert`.\n\nExit codes: those of build-merged")]
pub struct InsertArgs {
    /// The model; it is not changed
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
    /// Name of the part, such as language or vision, or the JSON pointer of its config
    #[arg(long, value_name = "PART")]
    pub part: String,
    /// The part as a checkpoint of its own
    #[arg(long, value_name = "DIR")]
    pub from: PathBuf,
    /// Output directory; it must not exist, or be empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What is merged and reported.
    #[command(flatten)]
    pub how: MergeArgs,
}

/// Arguments of `merge-adapter`.
#[derive(Debug, Args)]
#[command(after_help = "This is `build-merged --recipe merge-adapter`.\n\nExit codes: those of build-merged")]
pub struct MergeAdapterArgs {
    /// The model that the adapter was trained on
    #[arg(value_name = "BASE")]
    pub base: PathBuf,
    /// The adapter: a directory with `adapter_config.json` and `adapter_model.safetensors`
    #[arg(value_name = "ADAPTER")]
    pub adapter: PathBuf,
    /// Output directory; it must not exist, or be empty
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What is merged and reported.
    #[command(flatten)]
    pub how: MergeArgs,
}

/// What all commands that write a merged checkpoint have in common.
#[derive(Debug, Args)]
pub struct MergeArgs {
    /// Set an option of the recipe; may be repeated
    #[arg(long, value_name = "OPTION=VALUE", value_parser = parse_pair)]
    pub set: Vec<(String, String)>,
    /// Version of transformers that the result is for: 4.57, transformers==4.57.3, all, or @FILE for what a lock file pins; may
    /// be repeated. The result is checked for it, and options whose default depends on the version follow it
    #[arg(long = "for", value_name = "VERSION", value_delimiter = ',', value_parser = or_file(parse_requirement_or_all))]
    pub versions: Vec<String>,
    /// Let errors of this rule, in a donor or the result, not stop the merge; they are reported, and the exit code is 1 for one in
    /// the result. May be repeated
    #[arg(long, value_name = "RULE", value_delimiter = ',')]
    pub tolerate: Vec<String>,
    /// Plan and check the merge, and write nothing
    #[arg(long)]
    pub dry_run: bool,
    /// With --dry-run: write the plan, every tensor with its shard and source, to this file as JSON
    #[arg(long, value_name = "FILE", requires = "dry_run")]
    pub plan: Option<PathBuf>,
    /// Algorithm of the digests of tensors in the manifest, with which `ckpt-doctor verify` compares the result
    #[arg(long, value_name = "ALGORITHM", default_value = "blake3")]
    pub hash: HashName,
    /// Record the SHA-256 of whole donor files in the manifest, not only of documents and shard headers
    #[arg(long)]
    pub hash_donors: bool,
    /// Report formats and the exit code.
    #[command(flatten)]
    pub report: ReportArgs,
}

impl ExtractArgs {
    /// The same as a merge.
    #[must_use]
    pub fn into_merge(self) -> BuildMergedArgs {
        let donor = vec![("model".to_owned(), self.dir.display().to_string())];
        self.how.into_merge("extract", self.out, Some(self.part), donor)
    }
}

impl InsertArgs {
    /// The same as a merge.
    #[must_use]
    pub fn into_merge(self) -> BuildMergedArgs {
        let dirs = [("model", self.dir), ("part", self.from)];
        let donor = dirs.map(|(role, dir)| (role.to_owned(), dir.display().to_string())).to_vec();
        self.how.into_merge("insert", self.out, Some(self.part), donor)
    }
}

impl MergeAdapterArgs {
    /// The same as a merge.
    #[must_use]
    pub fn into_merge(self) -> BuildMergedArgs {
        let dirs = [("base", self.base), ("adapter", self.adapter)];
        let donor = dirs.map(|(role, dir)| (role.to_owned(), dir.display().to_string())).to_vec();
        self.how.into_merge("merge-adapter", self.out, None, donor)
    }
}

impl MergeArgs {
    /// A merge of these donors, each by its role, with a recipe of the program; of a part, if it takes one.
    fn into_merge(
        mut self,
        recipe: &str,
        out: PathBuf,
        part: Option<String>,
        donor: Vec<(String, String)>,
    ) -> BuildMergedArgs {
        self.set.extend(part.map(|part| ("part".to_owned(), part)));
        BuildMergedArgs {
            file: None,
            recipe: Some(recipe.to_owned()),
            print_recipe: false,
            help: false,
            donor,
            vision: None,
            language: None,
            out: Some(out),
            how: self,
        }
    }
}

/// Algorithm of digests as an argument.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum HashName {
    /// No digests; the donors are needed to verify the result
    None,
    /// BLAKE3
    Blake3,
    /// SHA-256
    Sha256,
}

impl HashName {
    /// The algorithm of this name.
    pub const fn algorithm(self) -> HashAlgorithm {
        match self {
            Self::None => HashAlgorithm::None,
            Self::Blake3 => HashAlgorithm::Blake3,
            Self::Sha256 => HashAlgorithm::Sha256,
        }
    }
}
