//! Fixes in reports: marks at fixable findings, the fixes made in each checkpoint, the closing line.

use std::fmt::Write as _;

use super::format::{fixed, name, plural};
use super::model::{CheckpointReport, Fixing, Report};
use crate::check::{Finding, Safety};

/// `[*] `, as in ruff, for a finding that `--fix` can fix.
pub(super) fn mark(finding: &Finding, fixing: Option<Fixing>) -> &'static str {
    let permitted = |fixing: Fixing| finding.fix.as_ref().is_some_and(|fix| fix.is_permitted(fixing.unsafe_fixes));
    // After `--fix`, fixes of remaining findings were tried and withdrawn; `section` lists them.
    if fixing.is_some_and(|fixing| !fixing.made && permitted(fixing)) { "[*] " } else { "" }
}

/// The fixes applied to a checkpoint, and those that were rolled back.
pub(super) fn section(checkpoint: &CheckpointReport) -> String {
    fixed(checkpoint).iter().fold(String::new(), |out, line| out + "  " + line + "\n")
}

/// The number of fixes that were applied or can be applied; `None` without fixes.
pub(super) fn closing(report: &Report) -> Option<String> {
    let fixing = report.checkpoints.iter().find_map(|c| c.fixing)?;
    let fixes = || report.checkpoints.iter().flat_map(|c| &c.findings).filter_map(|f| f.fix.as_ref());
    let permitted = fixes().filter(|fix| fix.is_permitted(fixing.unsafe_fixes)).count();
    let hidden = fixes().filter(|fix| fix.safety == Safety::Unsafe).count();
    let hidden = if fixing.unsafe_fixes { 0 } else { hidden };
    if fixing.made {
        let fixed: usize = report.checkpoints.iter().map(|c| c.fixed.len()).sum();
        let remaining: usize = report.checkpoints.iter().map(|c| c.findings.len()).sum();
        let more = if hidden > 0 { format!("; {hidden} more with --unsafe-fixes") } else { String::new() };
        return Some(format!("{fixed} fixed, {remaining} remaining{more}"));
    }
    let option = if fixing.unsafe_fixes { "--fix --unsafe-fixes" } else { "--fix" };
    match (permitted, hidden) {
        (0, 0) => None,
        (0, hidden) => Some(format!("{hidden} fixable with {option} --unsafe-fixes")),
        (n, 0) => Some(format!("[*] {n} fixable with {option}")),
        (n, hidden) => Some(format!("[*] {n} fixable with {option}; {hidden} more with --unsafe-fixes")),
    }
}

/// The fixes that were applied, for `--fix-only`.
#[must_use]
pub fn made(checkpoints: &[CheckpointReport]) -> String {
    let mut out = String::new();
    for checkpoint in checkpoints.iter().filter(|c| !c.fixed.is_empty() || !c.withdrawn.is_empty()) {
        let _ok = writeln!(out, "{}", name(&checkpoint.path));
        out.push_str(&section(checkpoint));
    }
    let fixed: usize = checkpoints.iter().map(|c| c.fixed.len()).sum();
    let _ok = writeln!(out, "{fixed} fixed in {}", plural(checkpoints.len(), "checkpoint"));
    out
}

/// The number of fixes shown by `--diff`.
#[must_use]
pub fn would(fixed: usize, files: usize) -> String {
    match fixed {
        0 => "No fixes available".to_owned(),
        n => format!(
            "Would make {} in {}",
            if n == 1 { "1 fix".to_owned() } else { format!("{n} fixes") },
            plural(files, "file")
        ),
    }
}
