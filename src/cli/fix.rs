//! `check --fix`, `--diff` and `--output`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::bail;
use serde::{Deserialize, Serialize};

use super::args::FixArgs;
use super::output;
use super::progress::Meter;
use crate::check::Outcome;
use crate::checkpoint::journal::StateFolder;
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, escape};
use crate::report::diff;
use crate::report::model::{Fixed, Withdrawn};
use crate::surgery::repair::{Repair, plan};
use crate::surgery::{ApplyError, Leftover, Recovered, Recovery, RepairError, RepairWritten, Trust, journal, overlay};

/// Judges a checkpoint on which fixes are tried.
type CheckFn<'a> = &'a dyn Fn(&Arc<Checkpoint>) -> Outcome;

impl FixArgs {
    /// Whether this run writes repairs.
    pub const fn writes(&self) -> bool {
        (self.fix || self.fix_only) && !self.diff
    }

    /// Rejects invalid combinations of options.
    pub fn refuse(&self, checkpoints: usize) -> anyhow::Result<()> {
        if self.output.is_some() && !self.writes() {
            bail!("--output requires --fix");
        }
        if self.adopt_journal && !self.writes() {
            bail!("--adopt-journal requires --fix");
        }
        if self.output.is_some() && checkpoints > 1 {
            bail!("--output accepts one checkpoint, but {checkpoints} were found");
        }
        Ok(())
    }
}

/// Finishes or rolls back a repair that was interrupted, before the checkpoint is checked.
pub fn recover(args: &FixArgs, dir: &Path) -> anyhow::Result<()> {
    if args.writes() && args.output.is_none() {
        let recovery = journal::recover(dir, &Trust { user: StateFolder::of_user(), adopts: args.adopt_journal })?;
        show_recovery(dir, &recovery);
        warn(recovery.leftover.as_ref());
    }
    Ok(())
}

/// Says what became of an interrupted repair, file by file. `undo` calls it, too.
pub fn show_recovery(dir: &Path, recovery: &Recovery) {
    let done = match recovery.outcome {
        None => return,
        Some(Recovered::Finished) => "finished",
        Some(Recovered::RolledBack) => "rolled back",
    };
    output::note(&format!("{}: {done} an interrupted repair", escape(&dir.display().to_string(), 300)));
    for (change, name) in &recovery.files {
        output::note(&format!("  {} {}", change.verb(), escape(name, 200)));
    }
}

/// Warns about temporary files that could not be removed.
fn warn(leftover: Option<&Leftover>) {
    if let Some(leftover) = leftover {
        output::note(&output::safe(&leftover.to_string()));
    }
}

/// A checkpoint after its fixes were applied.
pub struct Repaired {
    /// The repaired directory: the original or the copy.
    pub dir: PathBuf,
    /// Read again, if files were written.
    pub checkpoint: Arc<Checkpoint>,
    /// The result of the check, if no file was written.
    pub outcome: Option<Outcome>,
    pub fixed: Vec<Fixed>,
    pub withdrawn: Vec<Withdrawn>,
}

/// Applies the fixes of the findings in `outcome`.
pub fn repair(
    args: &FixArgs,
    dir: PathBuf,
    checkpoint: &Arc<Checkpoint>,
    outcome: Outcome,
    open: &dyn Fn(&Path) -> anyhow::Result<Arc<Checkpoint>>,
    judge: CheckFn<'_>,
) -> anyhow::Result<Repaired> {
    let repair = plan(checkpoint, outcome.clone(), args.unsafe_fixes, judge);
    let written = write(args, &dir, &repair)?;
    let Repair { fixed, withdrawn, .. } = repair;
    Ok(match written {
        Some(dir) => Repaired { checkpoint: open(&dir)?, outcome: None, dir, fixed, withdrawn },
        None => Repaired { dir, checkpoint: Arc::clone(checkpoint), outcome: Some(outcome), fixed, withdrawn },
    })
}

/// Writes a repair; returns the written directory, or `None` without changes.
fn write(args: &FixArgs, dir: &Path, repair: &Repair) -> anyhow::Result<Option<PathBuf>> {
    if repair.changes.is_empty() {
        return Ok(None);
    }
    let total = repair.changes.iter().fold(0_u64, |n, change| n.saturating_add(change.new.len()));
    let meter = Meter::new("writing");
    let progress = |bytes: u64| meter.add("", bytes, total);
    if let Some(out) = &args.output {
        let copy = overlay(repair, out, &progress)?;
        if let Some(cleared) = &copy.cleared {
            let cleared = output::safe(&cleared.display().to_string());
            output::note(&format!("{cleared}, which an ended run had left, was removed"));
        }
        warn(copy.leftover.as_ref());
        return Ok(Some(out.clone()));
    }
    let RepairWritten { leftover, unsigned } = journal::write(repair, &StateFolder::of_user(), &progress)?;
    warn(leftover.as_ref());
    if let Some(why) = unsigned {
        let text = format!("{}: only `undo --adopt-journal` undoes this repair: {why}", dir.display());
        output::note(&output::safe(&text));
    }
    Ok(Some(dir.to_owned()))
}

/// What the fixes of a directory would change, for `--diff`. A worker sends it.
#[derive(Serialize, Deserialize)]
pub struct Preview {
    /// The changes, as they are printed.
    pub diff: String,
    /// Numbers of fixes and of files that they change.
    pub fixes: usize,
    pub files: usize,
}

/// What the fixes would change.
pub fn preview(
    args: &FixArgs,
    dir: &Path,
    checkpoint: &Arc<Checkpoint>,
    outcome: Outcome,
    judge: CheckFn<'_>,
) -> Preview {
    let repair = plan(checkpoint, outcome, args.unsafe_fixes, judge);
    Preview { diff: diff::render(&shown(dir), &repair), fixes: repair.fixed.len(), files: repair.changes.len() }
}

/// The end of a run by a signal. It names the directory that was not written: earlier ones may already be repaired.
pub fn interrupted(dir: &Path) -> anyhow::Error {
    anyhow::Error::new(RepairError::Apply(ApplyError::Interrupted)).context(dir.display().to_string())
}
