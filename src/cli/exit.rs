//! Exit codes of all commands, with the conventions of ruff and cargo.

/// The command did its work, and nothing is at or above `--fail-on`.
pub const CLEAN: u8 = 0;
/// The command did its work, and there are findings at or above `--fail-on`.
pub const FINDINGS: u8 = 1;
/// The command did not do its work, or not all of it: wrong arguments, a path that could not be checked, or a merge that was
/// refused. It takes precedence over [`FINDINGS`].
pub const FAILED: u8 = 2;
