//! Writes a repair into its checkpoint.

use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;

use super::folder::{Folder, VERSION};
use super::record::{Journal, JournaledFile, NewFile, OldFile};
use super::replay::Replay;
use crate::surgery::donor::DonorSnapshot;
use crate::surgery::error::{RepairError, io_at};
use crate::surgery::leftover::Leftover;
use crate::surgery::repair::Repair;
use crate::surgery::stop::interrupted;
use crate::surgery::writers::changes::{check_unchanged, explain_error, write_content};
use crate::surgery::writers::system::{check_space, look, retry, sync_dir};

/// Replaces the changed files of a repair, all of them or none.
///
/// `progress` receives the bytes written, from several threads.
/// Call [`super::recover`] before the checkpoint is opened. Returns the files that
/// could not be removed afterwards.
///
/// # Errors
/// A [`RepairError`]; then the checkpoint is unchanged, except with [`RepairError::Unfinished`].
pub fn write(repair: &Repair, progress: &(dyn Fn(u64) + Sync)) -> Result<Option<Leftover>, RepairError> {
    let root = &repair.original.root;
    for change in &repair.changes {
        let path = root.join(&change.name);
        if look(&path)?.is_some_and(|m| m.is_symlink()) {
            let target = fs::read_link(&path).map_err(io_at(&path, "reading"))?;
            return Err(RepairError::Linked { path, target });
        }
    }
    let folder = Folder::create(root).map_err(|error| explain_error(error, root, repair))?;
    let written = stage(repair, &folder, progress).and_then(|journal| {
        folder.begin(&journal)?;
        let replay = Replay::new(&folder, &journal);
        let undo = || folder.reopen(journal.number).and_then(|()| replay.roll_back());
        replay.finish().map_err(|error| match undo() {
            Ok(()) => error,
            Err(_) => RepairError::Unfinished { error: Box::new(error) },
        })
    });
    match written {
        Ok(leftover) => Ok(leftover.or(folder.tidy())),
        Err(error) => Err(explain_error(error, root, repair).with_leftover(folder.tidy())),
    }
}

/// Stages the new files.
fn stage(repair: &Repair, folder: &Folder, progress: &(dyn Fn(u64) + Sync)) -> Result<Journal, RepairError> {
    let root = &repair.original.root;
    let donor = DonorSnapshot::record(root)?;
    if folder.pending()?.is_some() {
        return Err(RepairError::Busy { path: root.clone(), holder: "an interrupted run".to_owned() });
    }
    folder.clear()?;
    // One more block each for the journal and for the folder of new files, and two for the originals.
    let sizes: Vec<u64> = repair.sizes().into_iter().chain([1; 4]).collect();
    check_space(root, &sizes)?;
    let number = folder.numbers()?.last().map_or(1, |n| n.saturating_add(1));
    let staging = folder.staged();
    folder.folder(&staging)?;
    let mut files = Vec::new();
    for change in &repair.changes {
        interrupted()?;
        let (target, path) = (root.join(&change.name), staging.join(&change.name));
        let old = look(&target)?;
        check_unchanged(repair, change, &target)?;
        write_content(&path, &change.new, progress)?;
        if let Some(old) = &old {
            copy_owner_and_mode(&path, old)?;
        }
        files.push(JournaledFile {
            name: change.name.clone(),
            old: old.as_ref().map(OldFile::from_metadata),
            new: NewFile::hash(&path)?,
        });
    }
    sync_dir(&staging)?;
    donor.unchanged()?;
    interrupted()?;
    Ok(Journal { version: VERSION, number, files })
}

/// Gives a new file the owner and the mode of the original.
fn copy_owner_and_mode(path: &Path, old: &fs::Metadata) -> Result<(), RepairError> {
    let new = fs::metadata(path).map_err(io_at(path, "reading metadata"))?;
    if (new.uid(), new.gid()) != (old.uid(), old.gid()) {
        retry(|| std::os::unix::fs::chown(path, Some(old.uid()), Some(old.gid())))
            .map_err(|error| RepairError::Owner { path: path.to_owned(), error })?;
    }
    // After the owner, because changing the owner may clear mode bits.
    retry(|| fs::set_permissions(path, Permissions::from_mode(old.mode() & 0o7777)))
        .map_err(io_at(path, "setting permissions"))?;
    Ok(fs::File::open(path).and_then(|f| f.sync_all()).map_err(io_at(path, "syncing"))?)
}
