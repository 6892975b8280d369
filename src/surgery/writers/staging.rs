//! The staging directory, in which a checkpoint is written before it is renamed to the target.
//!
//! `.NAME.partial` beside the target contains a marker file and `content`, which becomes the target by one rename. The
//! marker contains the process of the run and is locked, so that a second run fails; the kernel releases the lock when
//! the process ends. After a crash, the next run recognises the directory by its marker and clears it. A directory of
//! that name without the marker is user data and is not touched.
#![expect(clippy::disallowed_methods, reason = "this module and apply.rs are where checkpoints are written")]

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::lock::{self, Lock, LockFile};
pub(super) use super::system::sync_dir;
use super::system::{names, remove_dir, remove_file, remove_folder, retry};
use crate::surgery::error::{ApplyError, io_at};
use crate::surgery::leftover::Leftover;

const MARKER: &str = "ckpt-doctor-owner";
const CONTENT: &str = "content";

/// Path of the staging directory of `out`.
pub(super) fn staging_path(out: &Path) -> PathBuf {
    let mut name = std::ffi::OsString::from(".");
    name.push(out.file_name().unwrap_or_default());
    name.push(".partial");
    out.with_file_name(name)
}

/// A locked staging directory; removed on drop, or by [`Staging::discard`].
pub(super) struct Staging {
    path: PathBuf,
    content: PathBuf,
    lock: LockFile,
    /// The marker is removed, so the directory must not be touched any more.
    over: bool,
}

impl Staging {
    /// Creates and locks the staging directory of `out`, after [`clear_remains`].
    ///
    /// # Errors
    /// [`ApplyError::Busy`] when another run has locked it, [`ApplyError::Target`] when it is not a staging directory.
    pub(super) fn new(out: &Path) -> Result<Self, ApplyError> {
        let path = staging_path(out);
        // Three attempts: another run may create or remove the directory between these steps.
        for _ in 0..3 {
            clear_remains(out)?;
            match retry(|| fs::create_dir(&path)) {
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => continue,
                other => other.map_err(io_at(&path, "creating"))?,
            }
            match Self::fill(out, &path) {
                Ok(Some(staging)) => return Ok(staging),
                Ok(None) => {}
                Err(error) => {
                    // Fails when another run works in the directory: then it is not empty.
                    let _ = remove_dir(&path);
                    return Err(error);
                }
            }
        }
        Err(ApplyError::Busy { path: out.to_owned(), holder: "it has just ended".to_owned() })
    }

    /// Locks the new directory `path` and creates its content; `None` when another run has removed it meanwhile.
    fn fill(out: &Path, path: &Path) -> Result<Option<Self>, ApplyError> {
        let marker = path.join(MARKER);
        let lock = match lock::take(&marker) {
            // Without lock support, the run that created the directory uses it.
            Ok(Lock::Ours(lock) | Lock::Unknown(lock)) => lock,
            Ok(Lock::Theirs(holder)) => return Err(ApplyError::Busy { path: out.to_owned(), holder }),
            Ok(Lock::Gone) => return Ok(None),
            Err(error) => {
                let _ = remove_file(&marker);
                return Err(error);
            }
        };
        // From here on every error removes the directory.
        let mut staging = Self { path: path.to_owned(), content: path.join(CONTENT), lock, over: false };
        lock::sign(&mut staging.lock).map_err(io_at(&marker, "writing"))?;
        // A power failure may keep the content without the marker otherwise: btrfs syncs a file without its siblings.
        staging.lock.sync().map_err(io_at(&marker, "syncing"))?;
        sync_dir(path)?;
        retry(|| fs::create_dir(&staging.content)).map_err(io_at(&staging.content, "creating"))?;
        Ok(Some(staging))
    }

    /// Directory for the files of the checkpoint.
    pub(super) fn content(&self) -> &Path {
        &self.content
    }

    /// Syncs the content and renames it to the target.
    ///
    /// # Errors
    /// [`ApplyError::Io`]; a failed sync is never retried, and the target is removed again.
    pub(super) fn publish(&self, out: &Path) -> Result<(), ApplyError> {
        sync_dir(&self.content)?;
        // rename(2) replaces an empty directory and refuses any other, as required for the target.
        retry(|| fs::rename(&self.content, out)).map_err(io_at(out, "publishing"))?;
        let synced = out.parent().map_or(Ok(()), sync_dir);
        match synced {
            Err(ApplyError::Io { error, .. }) if retry(|| fs::rename(out, &self.content)).is_err() => {
                Err(ApplyError::Unsynced { path: out.to_owned(), error })
            }
            other => other,
        }
    }

    /// Removes the staging directory with its content.
    ///
    /// Returns the directory if that fails.
    pub(super) fn discard(mut self) -> Option<Leftover> {
        self.remove().err().map(|why| Leftover { path: self.path.clone(), why })
    }

    /// The marker is removed last, so that an incomplete removal can be continued.
    fn remove(&mut self) -> io::Result<()> {
        if self.over {
            return Ok(());
        }
        remove_folder(&self.content)?;
        // Without the marker, another run may start in the directory before it is removed.
        self.over = true;
        remove_file(&self.path.join(MARKER))?;
        match remove_dir(&self.path) {
            Err(e) if e.kind() == io::ErrorKind::DirectoryNotEmpty => Ok(()),
            other => other,
        }
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        // After panics and early errors; does nothing after `discard`.
        let _ = self.remove();
    }
}

/// Removes the staging directory that an ended run with the target `out` left; returns its path, `None` without one.
///
/// # Errors
/// [`ApplyError::Busy`] when a run has locked it, [`ApplyError::Target`] when it is not a staging directory, or when the
/// file system has no locks; [`ApplyError::Io`] when it cannot be removed.
pub(super) fn clear_remains(out: &Path) -> Result<Option<PathBuf>, ApplyError> {
    let path = staging_path(out);
    if !is_ours(&path)? {
        return Ok(None);
    }
    // A run killed before it wrote the marker, or after it removed it, leaves an empty directory.
    if remove_dir(&path).is_ok() {
        return Ok(Some(path));
    }
    match lock::take(&path.join(MARKER))? {
        Lock::Ours(lock) => {
            let staging = Staging { content: path.join(CONTENT), path: path.clone(), lock, over: false };
            match staging.discard() {
                Some(Leftover { why, .. }) => Err(io_at(&path, "removing the files of an ended run")(why)),
                None => Ok(Some(path)),
            }
        }
        Lock::Theirs(holder) => Err(ApplyError::Busy { path: out.to_owned(), holder }),
        Lock::Gone => Ok(None),
        Lock::Unknown(_) => {
            let reason = "exists, and this file system has no locks that would show whether a run is still writing; \
                          remove it if no run is";
            Err(ApplyError::Target { path, reason: reason.to_owned() })
        }
    }
}

/// Whether the directory is a staging directory; `false` when it is missing.
fn is_ours(path: &Path) -> Result<bool, ApplyError> {
    let not_ours = |reason: &str| ApplyError::Target {
        path: path.to_owned(),
        reason: format!("{reason}, but ckpt-doctor needs this name; rename or remove it"),
    };
    let metadata = match fs::symlink_metadata(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(false),
        other => other.map_err(io_at(path, "reading metadata"))?,
    };
    if !metadata.is_dir() {
        return Err(not_ours("is not a directory"));
    }
    // Who owns a directory can swap what is in it while we write.
    if metadata.uid() != rustix::process::geteuid().as_raw() {
        return Err(not_ours("belongs to another user"));
    }
    let names = match names(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(false),
        other => other.map_err(io_at(path, "listing"))?,
    };
    if !(names.is_empty() || names.iter().any(|n| n == MARKER)) || names.iter().any(|n| n != MARKER && n != CONTENT) {
        return Err(not_ours("was not created by ckpt-doctor"));
    }
    Ok(true)
}
