//! Recovers from an interrupted repair.

use std::path::Path;

use super::folder::{Folder, Remains};
use super::replay::Replay;
use crate::surgery::error::RepairError;
use crate::surgery::outcome::{Recovered, Recovery};
use crate::surgery::trust::Trust;

/// Finishes or rolls back an interrupted repair, and removes what an ended run has left.
///
/// # Errors
/// [`RepairError::ForeignJournal`] for a journal that `trust` does not cover, and then nothing is put into place; any other
/// [`RepairError`]. The journal stays, so that the next run can continue.
pub fn recover(root: &Path, trust: &Trust) -> Result<Recovery, RepairError> {
    match Folder::remains(root)? {
        Remains::None => Ok(Recovery::default()),
        // Without a repair to finish, a directory may be read-only, and another run may have the lock.
        Remains::Empty => {
            let leftover = Folder::open(root).ok().flatten().and_then(|folder| folder.tidy());
            Ok(Recovery { leftover, ..Recovery::default() })
        }
        Remains::Interrupted => match Folder::open(root)? {
            None => Ok(Recovery::default()),
            Some(folder) => {
                let recovery = recover_in(&folder, trust)?;
                Ok(Recovery { leftover: recovery.leftover.or(folder.tidy()), ..recovery })
            }
        },
    }
}

/// The recovery in a locked folder.
pub(super) fn recover_in(folder: &Folder, trust: &Trust) -> Result<Recovery, RepairError> {
    let Some(journal) = folder.pending()? else {
        folder.clear()?;
        return Ok(Recovery::default());
    };
    folder.admit(&journal, folder.journal(), trust)?;
    let journal = folder.adopted(journal, trust);
    let replay = Replay::new(folder, &journal, trust.adopts);
    if replay.can_finish()? {
        let leftover = replay.finish()?;
        return Ok(Recovery { outcome: Some(Recovered::Finished), files: replay.files(), leftover });
    }
    let files = replay.roll_back()?;
    Ok(Recovery { outcome: Some(Recovered::RolledBack), files, leftover: None })
}
