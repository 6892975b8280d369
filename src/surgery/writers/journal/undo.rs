//! `undo`: restores the files before the latest repair, byte for byte.

use std::fs;
use std::path::Path;

use super::folder::Folder;
use super::recover::recover_in;
use super::replay::Replay;
use crate::checkpoint::journal::{Journal, JournaledFile};
use crate::surgery::error::{RepairError, io_at};
use crate::surgery::outcome::{Recovered, Recovery, Undone};
use crate::surgery::stop::interrupted;
use crate::surgery::trust::Trust;

/// Undoes the latest repair of a checkpoint. An interrupted repair is finished or rolled back first.
///
/// # Errors
/// An I/O error for a directory that cannot be opened, [`RepairError::NothingToUndo`] without a repair, [`RepairError::ForeignJournal`] for a journal that `trust` does not cover,
/// [`RepairError::ChangedSinceRepair`] when a file changed after the repair; then no file is changed.
pub fn undo(root: &Path, trust: &Trust) -> Result<Undone, RepairError> {
    let Some(folder) = Folder::open(root)? else {
        fs::metadata(root).map_err(io_at(root, "opening"))?;
        return Err(RepairError::NothingToUndo { path: root.to_owned() });
    };
    let pending = folder.pending()?;
    let recovery = recover_in(&folder, trust)?;
    if let Some(journal) = pending
        && recovery.outcome == Some(Recovered::RolledBack)
    {
        // The recovery has undone an interrupted repair, or finished an interrupted undo: this is the requested one.
        return Ok(undone(&folder, &journal, Recovery::default()));
    }
    let Some(journal) = folder.latest()? else {
        let leftover = folder.tidy();
        let error = RepairError::NothingToUndo { path: root.to_owned() };
        return Err(error.with_leftover(leftover));
    };
    folder.admit(&journal, folder.done(journal.number), trust)?;
    let replay = Replay::new(&folder, &journal, trust.adopts);
    if let Some(path) = replay.changed()? {
        return Err(RepairError::ChangedSinceRepair { path, originals: folder.originals(journal.number) });
    }
    interrupted()?;
    folder.reopen(journal.number)?;
    replay.roll_back().map_err(|error| RepairError::Unfinished { error: Box::new(error) })?;
    Ok(undone(&folder, &journal, recovery))
}

fn undone(folder: &Folder, journal: &Journal, recovery: Recovery) -> Undone {
    let left = folder.numbers().map_or(0, |numbers| numbers.len());
    let leftover = folder.tidy();
    let (restored, removed): (Vec<_>, Vec<_>) = journal.files.iter().partition(|f| f.old.is_some());
    let names = |entries: Vec<&JournaledFile>| entries.into_iter().map(|f| f.name.clone()).collect();
    Undone { recovery, restored: names(restored), removed: names(removed), left, leftover }
}
