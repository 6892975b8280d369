//! Recovers from an interrupted repair.

use std::path::Path;

use super::folder::{Folder, Remains};
use super::replay::Replay;
use crate::surgery::error::RepairError;
use crate::surgery::leftover::Leftover;
use crate::surgery::outcome::{Recovered, Recovery};

/// Finishes or rolls back an interrupted repair, and removes what an ended run has left.
///
/// # Errors
/// A [`RepairError`]; the journal stays, so that the next run can continue.
pub fn recover(root: &Path) -> Result<Recovery, RepairError> {
    match Folder::remains(root)? {
        Remains::None => Ok(Recovery::default()),
        // Without a repair to finish, a directory may be read-only, and another run may have the lock.
        Remains::Empty => {
            let leftover = Folder::open(root).ok().flatten().and_then(|folder| folder.tidy());
            Ok(Recovery { outcome: None, leftover })
        }
        Remains::Interrupted => match Folder::open(root)? {
            None => Ok(Recovery::default()),
            Some(folder) => {
                let (outcome, leftover) = recover_in(&folder)?;
                Ok(Recovery { outcome, leftover: leftover.or(folder.tidy()) })
            }
        },
    }
}

/// The recovery in a locked folder.
pub(super) fn recover_in(folder: &Folder) -> Result<(Option<Recovered>, Option<Leftover>), RepairError> {
    let Some(journal) = folder.pending()? else {
        folder.clear()?;
        return Ok((None, None));
    };
    let replay = Replay::new(folder, &journal);
    if replay.can_finish()? {
        return Ok((Some(Recovered::Finished), replay.finish()?));
    }
    replay.roll_back()?;
    Ok((Some(Recovered::RolledBack), None))
}
