//! The owner and the mode of files that replace others.

use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::path::Path;

use crate::surgery::error::{RepairError, io_at};
use crate::surgery::writers::system::retry;

/// Gives a new file the owner and the mode of the `original`, whose metadata is `old`, and syncs it.
pub(super) fn copy_owner_and_mode(path: &Path, original: &Path, old: &fs::Metadata) -> Result<(), RepairError> {
    let new = fs::metadata(path).map_err(io_at(path, "reading metadata"))?;
    if (new.uid(), new.gid()) != (old.uid(), old.gid()) {
        retry(|| std::os::unix::fs::chown(path, Some(old.uid()), Some(old.gid()))).map_err(|error| {
            let whose = if new.uid() == old.uid() { "group" } else { "user" };
            RepairError::Owner { path: original.to_owned(), whose, error }
        })?;
    }
    // After the owner, because changing the owner may clear mode bits.
    retry(|| fs::set_permissions(path, Permissions::from_mode(old.mode() & 0o7777)))
        .map_err(io_at(path, "setting permissions"))?;
    Ok(fs::File::open(path).and_then(|f| f.sync_all()).map_err(io_at(path, "syncing"))?)
}
