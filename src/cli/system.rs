//! What the command line asks the system, on Unix; `system_windows.rs` takes its place on Windows.

use rustix::process::{Resource, getrlimit};

/// Width of the terminal at standard output, in columns; `None` when it does not tell.
pub fn columns() -> Option<usize> {
    let size = rustix::termios::tcgetwinsize(std::io::stdout()).ok()?;
    (size.ws_col > 0).then_some(usize::from(size.ws_col))
}

/// Whether the terminal at standard output shows colours.
pub const fn shows_color() -> bool {
    true
}

/// Bytes of the stack of the main thread; `None` without a limit.
pub fn stack() -> Option<u64> {
    getrlimit(Resource::Stack).current
}
