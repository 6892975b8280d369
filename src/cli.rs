//! The command line: arguments, settings, output and exit codes.

mod args;
mod baseline;
mod build_merged;
mod check;
mod diff;
mod exit;
mod expect;
mod fix;
mod generate;
mod hints;
mod init;
mod inspect;
mod interpreter;
mod library;
mod look;
mod output;
mod paths;
mod pins;
mod progress;
mod recipes;
mod renderer;
mod rules;
mod settings;
#[cfg_attr(windows, path = "cli/signals_windows.rs")]
mod signals;
mod skipped;
mod stack;
#[cfg_attr(windows, path = "cli/system_windows.rs")]
mod system;
mod undo;
mod verify;
#[cfg_attr(windows, path = "cli/workers_windows.rs")]
mod workers;

use std::ffi::OsString;
use std::path::Path;
use std::process::ExitCode;

use clap::Parser;

use crate::check::render_elsewhere;
use crate::merge::PipelineError;
use crate::surgery::{ApplyError, CAN_WRITE, RepairError};

/// Whether a signal ended the run.
fn interrupted(error: &anyhow::Error) -> bool {
    matches!(error.downcast_ref(), Some(RepairError::Apply(ApplyError::Interrupted)))
        || matches!(error.downcast_ref(), Some(PipelineError::Apply(ApplyError::Interrupted)))
}

/// The causes of an error, escaped: names in it may come from a checkpoint.
fn causes(error: &anyhow::Error) -> String {
    let causes: Vec<String> = error.chain().map(|e| output::safe(&e.to_string())).collect();
    causes.join(": ")
}

/// The first option that is also the name of an existing file. A repository may have a file `--baseline=known.json`, and a
/// hook or a shell glob passes its name like any other.
fn file_as_option(args: impl Iterator<Item = OsString>, exists: impl Fn(&Path) -> bool) -> Option<OsString> {
    let mut options = args.take_while(|arg| arg != "--").filter(|arg| arg.as_encoded_bytes().starts_with(b"-"));
    options.find(|arg| exists(Path::new(arg)))
}

/// The name of a command that writes a checkpoint, for the refusal where none can be written.
const fn writer(command: &args::Command) -> Option<&'static str> {
    use args::Command;
    match command {
        Command::Check(args) if args.fix.writes() => Some("check --fix"),
        Command::BuildMerged(args) if !args.help && !args.print_recipe => Some("build-merged"),
        Command::Extract(_) => Some("extract"),
        Command::Insert(_) => Some("insert"),
        Command::MergeAdapter(_) => Some("merge-adapter"),
        Command::Undo(_) => Some("undo"),
        _ => None,
    }
}

/// Runs the program.
#[must_use]
pub fn main() -> ExitCode {
    stack::with_room(run)
}

fn run() -> ExitCode {
    signals::fail_at_file_size_limit();
    let mark = std::env::args_os().nth(1);
    if mark.as_deref().is_some_and(|mark| mark == renderer::ARGUMENT) {
        return ExitCode::from(renderer::main());
    }
    render_elsewhere(renderer::render);
    if mark.as_deref().is_some_and(|mark| mark == workers::ARGUMENT) {
        let args = std::env::args_os();
        return ExitCode::from(workers::main(args.enumerate().filter(|(n, _)| *n != 1).map(|(_, arg)| arg)));
    }
    if let Some(name) = file_as_option(std::env::args_os().skip(1), Path::exists) {
        let name = output::safe(&name.to_string_lossy());
        output::note(&format!("error: {name} is also the name of a file; write -- before file names"));
        return ExitCode::from(exit::FAILED);
    }
    let args::Cli { command, rules } = args::Cli::try_parse().unwrap_or_else(|error| hints::explained(error).exit());
    if let Some(name) = writer(&command).filter(|_| !CAN_WRITE) {
        output::note(&format!("error: {name} writes checkpoints, which needs Linux or macOS; on Windows use WSL"));
        return ExitCode::from(exit::FAILED);
    }
    let result = match command {
        args::Command::Check(args) => check::run(args, rules.as_deref()),
        args::Command::Undo(args) => undo::run(&args),
        args::Command::Inspect(args) => inspect::run(&args, rules.as_deref()),
        args::Command::Diff(args) => diff::run(&args, rules.as_deref()),
        args::Command::Expect(args) => expect::run(&args, rules.as_deref()),
        args::Command::BuildMerged(args) => build_merged::run(&args, rules.as_deref()),
        args::Command::Verify(args) => verify::run(&args),
        args::Command::Explain(args) => rules::explain(&args, rules.as_deref()),
        args::Command::Rules(args) => rules::list(&args, rules.as_deref()),
        args::Command::Recipes(args) => recipes::list(&args, rules.as_deref()),
        args::Command::Init(args) => init::run(&args),
        args::Command::Completions(args) => generate::completions(&args),
        args::Command::Man(args) => generate::man(&args),
        args::Command::Extract(args) => build_merged::run(&args.into_merge(), rules.as_deref()),
        args::Command::Insert(args) => build_merged::run(&args.into_merge(), rules.as_deref()),
        args::Command::MergeAdapter(args) => build_merged::run(&args.into_merge(), rules.as_deref()),
    };
    match result {
        Ok(code) => ExitCode::from(code),
        Err(error) => {
            let causes = causes(&error);
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

#[cfg(test)]
mod tests {
    use std::ffi::OsString;
    use std::path::Path;

    use clap::Parser as _;

    use super::{args, file_as_option, writer};

    #[test]
    fn commands_that_write_checkpoints_are_known() {
        let name = |args: &str| {
            let args = ["ckpt-doctor"].into_iter().chain(args.split(' '));
            writer(&args::Cli::try_parse_from(args).expect("arguments").command)
        };
        assert_eq!(name("check --fix a"), Some("check --fix"));
        assert_eq!(name("check --fix-only a"), Some("check --fix"));
        assert_eq!(name("undo a"), Some("undo"));
        assert_eq!(name("build-merged --vision a --language b --out c"), Some("build-merged"));
        assert_eq!(name("extract a --part language --out c"), Some("extract"));
        assert_eq!(name("insert a --part language --from b --out c"), Some("insert"));
        for reader in ["check a", "check --fix --diff a", "build-merged --recipe insert --help", "verify a", "init"] {
            assert_eq!(name(reader), None, "{reader}");
        }
    }

    #[test]
    fn names_of_files_are_no_options() {
        let found = |args: &[&str]| {
            let args = args.iter().map(OsString::from);
            let there = |path: &Path| ["--fix", "--report=json=x.json", "a"].iter().any(|name| path == Path::new(name));
            file_as_option(args, there).map(|arg| arg.to_string_lossy().into_owned())
        };
        assert_eq!(found(&["check", "a", "--report=json=x.json"]).as_deref(), Some("--report=json=x.json"));
        assert_eq!(found(&["check", "--fix"]).as_deref(), Some("--fix"));
        assert_eq!(found(&["check", "--diff", "a", "--", "--fix"]), None);
    }
}
