//! The staging directory: where a checkpoint is written before it gets its name.
//!
//! `.NAME.partial` beside the target holds a marker that says who works on it, and `content`, which becomes
//! the target by one rename. The marker is locked while a run works there, so a second run sees the lock (the
//! kernel frees it, whatever ends the first), and a run after a crash clears what the marker shows to be ours.
//! A directory of that name without the marker is somebody's data and is left alone.
#![expect(clippy::disallowed_methods, reason = "this module and apply.rs are where checkpoints are written")]

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::error::{ApplyError, io_at};
use super::lock::{self, Lock};
pub(super) use super::system::sync_dir;
use super::system::{names, remove_dir, remove_dir_all, remove_file, retry};

const MARKER: &str = "ckpt-doctor-owner";
const CONTENT: &str = "content";

/// Where the staging directory of `out` is.
pub(super) fn staging_path(out: &Path) -> PathBuf {
    let mut name = std::ffi::OsString::from(".");
    name.push(out.file_name().unwrap_or_default());
    name.push(".partial");
    out.with_file_name(name)
}

/// A locked staging directory; dropped without [`Staging::discard`] it is removed all the same.
pub(super) struct Staging {
    path: PathBuf,
    content: PathBuf,
    lock: File,
    /// The marker is gone, and with it the right to touch what is there.
    over: bool,
}

impl Staging {
    /// Makes and locks the staging directory of `out`.
    ///
    /// # Errors
    /// [`ApplyError::Busy`] when another run has it, [`ApplyError::Target`] when it is not ours to clear.
    pub(super) fn new(out: &Path) -> Result<Self, ApplyError> {
        let path = staging_path(out);
        // Three rounds: a run that ends between our steps takes the directory or the marker with it.
        for _ in 0..3 {
            let made = match retry(|| fs::create_dir(&path)) {
                Ok(()) => true,
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => false,
                Err(e) => return Err(io_at(&path, "creating")(e)),
            };
            match Self::lock(out, &path, made) {
                Ok(Some(staging)) => return Ok(staging),
                Ok(None) => {}
                Err(error) => {
                    if made {
                        // It stays when another run is quicker and works there: then it is not empty.
                        let _ = remove_dir(&path);
                    }
                    return Err(error);
                }
            }
        }
        Err(ApplyError::Busy { path: out.to_owned(), holder: "it ended just now".to_owned() })
    }

    /// Locks the marker in `path`; `None` when the directory went away meanwhile.
    fn lock(out: &Path, path: &Path, made: bool) -> Result<Option<Self>, ApplyError> {
        if !made && !is_ours(path)? {
            return Ok(None);
        }
        let marker = path.join(MARKER);
        let lock = match lock::take(&marker) {
            Ok(Lock::Ours(lock)) => lock,
            Ok(Lock::Theirs(holder)) => return Err(ApplyError::Busy { path: out.to_owned(), holder }),
            Ok(Lock::Gone) => return Ok(None),
            // Who made the directory has it to itself.
            Ok(Lock::Unknown(lock)) if made => lock,
            Ok(Lock::Unknown(_)) => {
                let reason = "is there, and without locks on this file system nobody can tell whether a run is still \
                              writing; remove it if none is";
                return Err(ApplyError::Target { path: path.to_owned(), reason: reason.to_owned() });
            }
            Err(error) => {
                if made {
                    let _ = remove_file(&marker);
                }
                return Err(error);
            }
        };
        let content = path.join(CONTENT);
        // From here on whatever fails removes the directory: it is ours.
        let mut staging = Self { path: path.to_owned(), content, lock, over: false };
        remove_dir_all(&staging.content).map_err(io_at(&staging.content, "removing"))?;
        lock::sign(&mut staging.lock).map_err(io_at(&marker, "writing"))?;
        retry(|| fs::create_dir(&staging.content)).map_err(io_at(&staging.content, "creating"))?;
        Ok(Some(staging))
    }

    /// Where files are written.
    pub(super) fn content(&self) -> &Path {
        &self.content
    }

    /// Makes the content durable and gives it its name.
    ///
    /// # Errors
    /// [`ApplyError::Io`]; a failed sync is a failure, never retried, and the name is taken back.
    pub(super) fn publish(&self, out: &Path) -> Result<(), ApplyError> {
        sync_dir(&self.content)?;
        // rename(2) replaces an empty directory and refuses any other: exactly the rule for the target.
        retry(|| fs::rename(&self.content, out)).map_err(io_at(out, "publishing"))?;
        let synced = out.parent().map_or(Ok(()), sync_dir);
        match synced {
            Err(ApplyError::Io { error, .. }) if retry(|| fs::rename(out, &self.content)).is_err() => {
                Err(ApplyError::Unsynced { path: out.to_owned(), error })
            }
            other => other,
        }
    }

    /// Removes the staging directory with all that is in it.
    ///
    /// # Errors
    /// Its path, and what the system said.
    pub(super) fn discard(mut self) -> Result<(), (PathBuf, io::Error)> {
        self.remove().map_err(|why| (self.path.clone(), why))
    }

    /// The marker goes last, so that what is left is still known to be ours.
    fn remove(&mut self) -> io::Result<()> {
        if self.over {
            return Ok(());
        }
        remove_dir_all(&self.content)?;
        // Without its marker the directory is anybody's: the next run may begin in it before we remove it.
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
        // For panics and early errors; after `discard` there is nothing left to do.
        let _ = self.remove();
    }
}

/// Whether the directory is one that a run of ours left behind or works in; `false` when it is gone.
fn is_ours(path: &Path) -> Result<bool, ApplyError> {
    let not_ours = |reason: &str| ApplyError::Target {
        path: path.to_owned(),
        reason: format!("{reason}, and ckpt-doctor works under this name; move it away"),
    };
    let metadata = match fs::symlink_metadata(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(false),
        other => other.map_err(io_at(path, "looking at"))?,
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
        return Err(not_ours("was not made by ckpt-doctor"));
    }
    Ok(true)
}
