//! Hints for subcommands that people know from other tools.

use clap::error::{ContextKind, ContextValue, Error, ErrorKind};

/// Words that are not subcommands, and the command line that does what they suggest.
const COMMANDS: [(&str, &str); 6] = [
    ("diff", "check --diff"),
    ("fix", "check --fix"),
    ("lint", "check"),
    ("repair", "check --fix"),
    ("validate", "check"),
    ("verify", "check"),
];

/// Adds `tip: run 'ckpt-doctor check --fix'` to the error for `ckpt-doctor fix`.
pub fn explained(mut error: Error) -> Error {
    let Some(ContextValue::String(word)) = error.get(ContextKind::InvalidSubcommand) else { return error };
    let known = COMMANDS.iter().find(|(name, _)| error.kind() == ErrorKind::InvalidSubcommand && name == word);
    if let Some((_, instead)) = known {
        let tip = format!("run 'ckpt-doctor {instead}'");
        error.remove(ContextKind::SuggestedSubcommand);
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip.into()]));
    }
    error
}
