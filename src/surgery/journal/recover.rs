//! Finishes or takes back a repair that was interrupted.

use std::path::Path;

use super::folder::Folder;
use super::record::JournalKind;
use super::replay::Replay;
use crate::surgery::error::RepairError;

/// What became of a repair that was interrupted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recovered {
    /// It is complete now.
    Finished,
    /// The checkpoint is as it was before.
    TakenBack,
}

/// Finishes or takes back a repair that was interrupted; `None` when there is none.
///
/// # Errors
/// A [`RepairError`]; then everything is as it was, the journal included.
pub fn recover(root: &Path) -> Result<Option<Recovered>, RepairError> {
    // What is read only, and has nothing left over, needs no lock.
    if !Folder::left_over(root) {
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
            replay.take_back()?;
            Recovered::TakenBack
        }
    };
    Ok(Some(recovered))
}
