//! What the command line asks the system, on Windows.

use std::io;
use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::Duration;

/// Width of the terminal at standard output, in columns; `None` when it does not tell.
pub fn columns() -> Option<usize> {
    let (terminal_size::Width(width), _) = terminal_size::terminal_size_of(std::io::stdout())?;
    Some(usize::from(width))
}

/// Whether the terminal at standard output shows colours: Windows 10 and later do when they are asked to.
pub fn shows_color() -> bool {
    anstyle_query::windows::enable_ansi_colors() == Some(true)
}

/// Bytes of the stack of the main thread: what linkers reserve.
pub const fn stack() -> Option<u64> {
    Some(1 << 20)
}

/// What ended a process: `exit code 101`.
pub fn ended(status: ExitStatus) -> String {
    format!("exit code {}", status.code().unwrap_or_default())
}

/// The file of this program, to start it again.
pub fn program() -> io::Result<PathBuf> {
    std::env::current_exe()
}

/// Fails: limits of a process need a job object, which the standard library cannot make.
pub fn limit(_seconds: u64, _memory: u64) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Time of a processor that this process has taken: unknown, and nothing limits it.
pub const fn taken() -> Option<Duration> {
    None
}
