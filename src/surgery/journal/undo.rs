//! `undo`: the latest repair is taken back, byte for byte.

use std::path::Path;

use super::folder::Folder;
use super::record::{Journal, JournalKind, JournaledFile};
use super::recover::{Recovered, recover_in};
use super::replay::Replay;
use crate::surgery::error::RepairError;
use crate::surgery::stop::interrupted;

/// What was undone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Undone {
    /// Files that are as they were before.
    pub restored: Vec<String>,
    /// Files that the repair had added, and that are gone.
    pub removed: Vec<String>,
    /// Repairs before this one, that can be undone next.
    pub left: usize,
}

/// Undoes the latest repair of a checkpoint. One that was interrupted is finished or taken back first.
///
/// # Errors
/// [`RepairError::NothingToUndo`] when there is none, [`RepairError::ChangedSinceRepair`] when a file is no longer what the repair
/// made of it; then nothing is touched.
pub fn undo(root: &Path) -> Result<Undone, RepairError> {
    let Some(folder) = Folder::open(root)? else { return Err(RepairError::NothingToUndo { path: root.to_owned() }) };
    let pending = folder.pending()?;
    let recovered = recover_in(&folder)?;
    if let Some(journal) = pending
        && (journal.kind == JournalKind::Undo || recovered == Some(Recovered::TakenBack))
    {
        // That was the undoing that is asked for.
        return Ok(undone(&folder, &journal));
    }
    let numbers = folder.numbers()?;
    let read = numbers.last().map(|number| Folder::read_journal(&folder.done(*number))).transpose()?.flatten();
    let Some(journal) = read else {
        folder.tidy();
        return Err(RepairError::NothingToUndo { path: root.to_owned() });
    };
    let journal = Journal { kind: JournalKind::Undo, ..journal };
    let replay = Replay::new(&folder, &journal);
    if let Some(path) = replay.changed()? {
        return Err(RepairError::ChangedSinceRepair { path, originals: folder.originals(journal.number) });
    }
    interrupted()?;
    folder.begin(&journal)?;
    replay.restore().map_err(|error| RepairError::Unfinished { error: Box::new(error) })?;
    Ok(undone(&folder, &journal))
}

fn undone(folder: &Folder, journal: &Journal) -> Undone {
    let left = folder.numbers().map_or(0, |numbers| numbers.len());
    folder.tidy();
    let (restored, removed): (Vec<_>, Vec<_>) = journal.files.iter().partition(|f| f.old.is_some());
    let names = |entries: Vec<&JournaledFile>| entries.into_iter().map(|f| f.name.clone()).collect();
    Undone { restored: names(restored), removed: names(removed), left }
}
