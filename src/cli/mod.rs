//! The command line: arguments, settings, output and exit codes.

mod args;
mod baseline;
mod build_merged;
mod check;
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
mod unasked;
mod undo;

use std::process::ExitCode;

use ckpt_doctor::surgery::apply::ApplyError;
use ckpt_doctor::surgery::journal::JournalError;
use clap::Parser;

/// Exit code: no findings at or above `--fail-on`.
const CLEAN: u8 = 0;
/// Exit code: findings at or above `--fail-on`, or a merge that stopped.
const FINDINGS: u8 = 1;
/// Exit code: the command could not run.
const FAILED: u8 = 2;

/// Whether a signal ended the run.
fn interrupted(error: &anyhow::Error) -> bool {
    matches!(error.downcast_ref(), Some(JournalError::Apply(ApplyError::Interrupted)))
}

/// Runs the program.
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
        Err(error) if interrupted(&error) => {
            output::note("interrupted; nothing was written");
            ExitCode::from(signals::exit_code())
        }
        Err(error) => {
            // Names in an error may come from a checkpoint: nothing of them may reach the terminal raw.
            let lines: Vec<String> =
                error.chain().map(|e| ckpt_doctor::checkpoint::escape(&e.to_string(), 4000)).collect();
            output::note(&format!("error: {}", lines.join(": ")));
            ExitCode::from(FAILED)
        }
    }
}
