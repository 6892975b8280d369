//! The command line: arguments, settings, output and exit codes.

mod args;
mod baseline;
mod build_merged;
mod check;
mod exit;
mod expect;
mod fix;
mod hints;
mod init;
mod inspect;
mod library;
mod output;
mod rules;
mod settings;
mod signals;
mod skipped;

mod undo;

use std::process::ExitCode;

use clap::Parser;

use crate::merge::PipelineError;
use crate::surgery::{ApplyError, RepairError};

/// Whether a signal ended the run.
fn interrupted(error: &anyhow::Error) -> bool {
    matches!(error.downcast_ref(), Some(RepairError::Apply(ApplyError::Interrupted)))
        || matches!(error.downcast_ref(), Some(PipelineError::Apply(ApplyError::Interrupted)))
}

/// Runs the program.
#[must_use]
pub fn main() -> ExitCode {
    let args::Cli { command, rules } = args::Cli::try_parse().unwrap_or_else(|error| hints::explained(error).exit());
    let result = match &command {
        args::Command::Check(args) => check::run(args, rules.as_deref()),
        args::Command::Undo(args) => undo::run(args),
        args::Command::Inspect(args) => inspect::run(args, rules.as_deref()),
        args::Command::Expect(args) => expect::run(args, rules.as_deref()),
        args::Command::BuildMerged(args) => build_merged::run(args, rules.as_deref()),
        args::Command::Explain(args) => rules::explain(args, rules.as_deref()),
        args::Command::Rules(args) => rules::list(args, rules.as_deref()),
        args::Command::Init(args) => init::run(args),
    };
    match result {
        Ok(code) => ExitCode::from(code),
        Err(error) => {
            // Names in an error may come from a checkpoint, so they are escaped.
            let causes: Vec<String> = error.chain().map(|e| output::safe(&e.to_string())).collect();
            let causes = causes.join(": ");
            if interrupted(&error) {
                output::note(&causes);
                ExitCode::from(signals::exit_code())
            } else {
                output::note(&format!("error: {causes}"));
                ExitCode::from(exit::FAILED)
            }
        }
    }
}
