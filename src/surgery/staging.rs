//! The staging directory: where a checkpoint is written before it gets its name.
//!
//! `.NAME.partial` beside the target holds a marker that says who works on it, and `content`, which becomes
//! the target by one rename. The directory is locked while a run works on it, so a second run sees the lock
//! (the kernel frees it, whatever ends the first), and a run after a crash clears what the marker shows to
//! be ours. A directory of that name without the marker is somebody's data and is left alone.
#![expect(clippy::disallowed_methods, reason = "this module and apply.rs are where checkpoints are written")]

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;

use super::apply::{ApplyError, io_at};
use crate::checkpoint::open::read_capped;

const MARKER: &str = "ckpt-doctor-owner";
const CONTENT: &str = "content";

/// A locked staging directory; dropped without [`Staging::publish`] it is removed.
pub(super) struct Staging {
    path: PathBuf,
    content: PathBuf,
    _lock: File,
}

impl Staging {
    /// Makes and locks the staging directory of `out`.
    ///
    /// # Errors
    /// [`ApplyError::Busy`] when another run has it, [`ApplyError::Target`] when it is not ours to clear.
    pub(super) fn new(out: &Path) -> Result<Self, ApplyError> {
        let name = out.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let path = out.with_file_name(format!(".{name}.partial"));
        // Two rounds: a run that ended between our open and our lock took the directory with it.
        for _ in 0..2 {
            match fs::create_dir(&path) {
                Err(e) if e.kind() != io::ErrorKind::AlreadyExists => return Err(io_at(&path, "creating")(e)),
                _ => {}
            }
            let flags = i32::try_from((OFlags::DIRECTORY | OFlags::NOFOLLOW).bits()).unwrap_or_default();
            let lock = match OpenOptions::new().read(true).custom_flags(flags).open(&path) {
                Err(e) if e.kind() == io::ErrorKind::NotFound => continue,
                other => other.map_err(io_at(&path, "opening"))?,
            };
            match lock.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    let holder = read_capped(&path.join(MARKER), 64).unwrap_or_default();
                    let holder = String::from_utf8(holder).unwrap_or_default();
                    let holder = if holder.is_empty() { "just started".to_owned() } else { holder };
                    return Err(ApplyError::Busy { path: out.to_owned(), holder });
                }
                Err(TryLockError::Error(e)) => return Err(io_at(&path, "locking")(e)),
            }
            let held = lock.metadata().map_err(io_at(&path, "looking at"))?;
            let same = fs::symlink_metadata(&path).is_ok_and(|m| (m.dev(), m.ino()) == (held.dev(), held.ino()));
            if same {
                clear(&path)?;
                let staging = Self { content: path.join(CONTENT), path, _lock: lock };
                let marker = staging.path.join(MARKER);
                fs::write(&marker, format!("process {}", std::process::id())).map_err(io_at(&marker, "writing"))?;
                fs::create_dir(&staging.content).map_err(io_at(&staging.content, "creating"))?;
                return Ok(staging);
            }
        }
        Err(ApplyError::Busy { path: out.to_owned(), holder: "it ended just now".to_owned() })
    }

    /// Where files are written.
    pub(super) fn content(&self) -> &Path {
        &self.content
    }

    /// Makes the content durable and gives it its name.
    ///
    /// # Errors
    /// [`ApplyError::Io`]; a failed sync is a failure, never retried.
    pub(super) fn publish(self, out: &Path) -> Result<(), ApplyError> {
        sync_dir(&self.content)?;
        // rename(2) replaces an empty directory and refuses any other: exactly the rule for the target.
        fs::rename(&self.content, out).map_err(io_at(out, "publishing"))?;
        out.parent().map_or(Ok(()), sync_dir)
    }
}

/// Removes what a crashed run left in a staging directory of ours.
fn clear(path: &Path) -> Result<(), ApplyError> {
    let names: Vec<_> = fs::read_dir(path)
        .and_then(|entries| entries.map(|e| e.map(|e| e.file_name())).collect::<io::Result<_>>())
        .map_err(io_at(path, "listing"))?;
    let ours = names.is_empty() || names.iter().any(|n| n == MARKER);
    if !ours || names.iter().any(|n| n != MARKER && n != CONTENT) {
        let reason = "has this name and was not made by ckpt-doctor, which works there; move it away".to_owned();
        return Err(ApplyError::Target { path: path.to_owned(), reason });
    }
    for (name, is_dir) in [(CONTENT, true), (MARKER, false)] {
        let inner = path.join(name);
        let removed = if is_dir { fs::remove_dir_all(&inner) } else { fs::remove_file(&inner) };
        match removed {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(io_at(&inner, "removing")(e)),
            _ => {}
        }
    }
    Ok(())
}

impl Drop for Staging {
    fn drop(&mut self) {
        // Best effort: when something failed, that error is the one to report; the next run clears the rest.
        // The marker goes last, so that what is left is still known to be ours.
        let _ = fs::remove_dir_all(&self.content);
        let _ = fs::remove_file(self.path.join(MARKER));
        let _ = fs::remove_dir(&self.path);
    }
}

fn sync_dir(path: &Path) -> Result<(), ApplyError> {
    File::open(path).and_then(|d| d.sync_all()).map_err(io_at(path, "syncing"))
}
