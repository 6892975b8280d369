//! Exit codes.

/// Nothing at or above `--fail-on`.
pub const CLEAN: u8 = 0;
/// Findings at or above `--fail-on`, or a merge that stopped.
pub const FINDINGS: u8 = 1;
/// It could not be tried.
pub const FAILED: u8 = 2;
