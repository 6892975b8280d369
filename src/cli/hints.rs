//! Hints for mistyped options, and for subcommands that people know from other tools.

use crate::knowledge::source::nearest;
use clap::CommandFactory as _;
use clap::error::{ContextKind, ContextValue, Error, ErrorKind};

use super::args::Cli;

/// Commands of other tools, and the equivalent command line.
const COMMANDS: [(&str, &str); 6] = [
    ("diff", "check --diff"),
    ("fix", "check --fix"),
    ("lint", "check"),
    ("repair", "check --fix"),
    ("validate", "check"),
    ("verify", "check"),
];

/// Adds `tip: run 'ckpt-doctor check --fix'` to the error for `ckpt-doctor fix`, and a similar option to the error for an
/// unknown one, such as `--fix` for `--fxi`.
pub fn explained(mut error: Error) -> Error {
    match (error.kind(), error.get(ContextKind::InvalidSubcommand), error.get(ContextKind::InvalidArg)) {
        (ErrorKind::InvalidSubcommand, Some(ContextValue::String(word)), _) => {
            if let Some((_, instead)) = COMMANDS.iter().find(|(name, _)| name == word) {
                let tip = format!("run 'ckpt-doctor {instead}'");
                error.remove(ContextKind::SuggestedSubcommand);
                error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip.into()]));
            }
        }
        (ErrorKind::UnknownArgument, _, Some(ContextValue::String(word))) => {
            if let Some(option) = similar_option(word) {
                error.remove(ContextKind::Suggested);
                error.insert(ContextKind::SuggestedArg, ContextValue::String(option));
            }
        }
        _ => {}
    }
    error
}

/// The option of the given subcommand that is most similar to `word`.
fn similar_option(word: &str) -> Option<String> {
    let cli = Cli::command();
    let command = std::env::args().skip(1).find_map(|argument| cli.find_subcommand(argument))?;
    let options: Vec<String> =
        command.get_arguments().filter_map(|option| Some(format!("--{}", option.get_long()?))).collect();
    nearest(word, options.iter().map(String::as_str)).map(str::to_owned)
}
