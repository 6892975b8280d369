//! `completions` and `man`: texts that are generated from the arguments.

use anyhow::Context as _;
use clap::{Command, CommandFactory as _};
use clap_complete::Shell;

use super::args::{Cli, CompletionsArgs, ManArgs};
use super::exit::CLEAN;
use super::output;

/// Runs `completions`: prints the completions for a shell.
pub fn completions(args: &CompletionsArgs) -> anyhow::Result<u8> {
    let mut text = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "ckpt-doctor", &mut text);
    let mut text = String::from_utf8(text)?;
    if args.shell == Shell::Bash {
        // clap_complete 4.6 writes two spellings of a name with a hyphen: https://github.com/clap-rs/clap/issues/6421
        text = text.replace("ckpt__subcmd__doctor__", "ckpt__doctor__");
    }
    output::print(&text)?;
    Ok(CLEAN)
}

/// Runs `man`: prints the page of the program or of one command, in roff.
pub fn man(args: &ManArgs) -> anyhow::Result<u8> {
    let mut text = Vec::new();
    let source = concat!("ckpt-doctor ", env!("CARGO_PKG_VERSION"));
    clap_mangen::Man::new(described(args.command.as_deref())?).source(source).render(&mut text)?;
    output::print(&String::from_utf8(text)?)?;
    Ok(CLEAN)
}

/// The program, or one of its commands.
fn described(name: Option<&str>) -> anyhow::Result<Command> {
    let mut program = Cli::command().disable_help_subcommand(true);
    program.build();
    let Some(name) = name else { return Ok(program) };
    program.find_subcommand(name).cloned().with_context(|| format!("unknown command: {name}"))
}
