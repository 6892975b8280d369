//! Exit codes.

/// No findings at or above `--fail-on`.
pub const CLEAN: u8 = 0;
/// Findings at or above `--fail-on`, or a merge that stopped.
pub const FINDINGS: u8 = 1;
/// The command could not run.
pub const FAILED: u8 = 2;
