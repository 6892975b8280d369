//! Recovers from an interrupted repair.

use std::path::Path;

use super::folder::Folder;
use super::record::JournalKind;
use super::replay::Replay;
use crate::surgery::error::RepairError;

/// Outcome of the recovery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recovered {
    /// The repair was completed.
    Finished,
    /// The checkpoint is in its state before the repair.
    RolledBack,
}

/// Finishes or rolls back an interrupted repair; `None` when there is none.
///
/// # Errors
/// A [`RepairError`]; the journal stays, so that the next run can continue.
pub fn recover(root: &Path) -> Result<Option<Recovered>, RepairError> {
    // A directory without remains needs no lock, so it may be read-only.
    if !Folder::has_remains(root) {
        return Ok(None);
    }
    match Folder::open(root)? {
        None => Ok(None),
        Some(folder) => {
            let recovered = recover_in(&folder)?;
            folder.tidy();
            Ok(recovered)
        }
    }
}

pub(super) fn recover_in(folder: &Folder) -> Result<Option<Recovered>, RepairError> {
    let Some(journal) = folder.pending()? else {
        folder.clear()?;
        return Ok(None);
    };
    let replay = Replay::new(folder, &journal);
    let recovered = match journal.kind {
        JournalKind::Undo => {
            replay.restore()?;
            Recovered::Finished
        }
        JournalKind::Repair if replay.can_finish()? => {
            replay.finish()?;
            Recovered::Finished
        }
        JournalKind::Repair => {
            replay.roll_back()?;
            Recovered::RolledBack
        }
    };
    Ok(Some(recovered))
}
