//! A lock on a directory for a single run: a file that contains the process of the run.
//!
//! The kernel releases the lock when the process ends. A file is locked instead of the directory, because NFS only
//! locks files that are open for writing.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;
use rustix::io::Errno;

use super::system::{custom, retry};
use crate::checkpoint::open::read_capped;
use crate::surgery::error::{ApplyError, io_at};

/// Result of locking.
pub(super) enum Lock {
    /// This run has the lock.
    Ours(LockFile),
    /// Another run has the lock; its process, from the file.
    Theirs(String),
    /// The file or its directory was removed by the run that had it.
    Gone,
    /// The file system does not support locks (Lustre, for one, may be mounted without), or its lock service is not
    /// reachable (`ENOLCK`; NFS, flock(2)).
    Unknown(LockFile),
}

/// An open lock file. It is unlocked explicitly when it is dropped: a child process that is being started holds a copy of
/// the descriptor until it runs its program, and would keep the lock for that time.
pub(super) struct LockFile(File);

impl LockFile {
    /// Syncs the file with its signature.
    pub(super) fn sync(&self) -> io::Result<()> {
        retry(|| self.0.sync_all())
    }
}

impl Drop for LockFile {
    fn drop(&mut self) {
        // An error would only mean that the file system has no locks.
        let _unlocked = self.0.unlock();
    }
}

/// Locks the file `path`; creates it when missing.
///
/// # Errors
/// [`ApplyError::Io`].
pub(super) fn take(path: &Path) -> Result<Lock, ApplyError> {
    let mut options = OpenOptions::new();
    let options = options.read(true).write(true).create(true).truncate(false);
    let file = match options.custom_flags(custom(OFlags::NOFOLLOW | OFlags::NONBLOCK)).open(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Lock::Gone),
        other => other.map_err(io_at(path, "opening"))?,
    };
    loop {
        match file.try_lock() {
            Ok(()) => break,
            Err(TryLockError::WouldBlock) => return Ok(Lock::Theirs(holder(path))),
            Err(TryLockError::Error(e)) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(TryLockError::Error(e)) if has_no_locks(&e) => {
                return Ok(Lock::Unknown(LockFile(file)));
            }
            Err(TryLockError::Error(e)) => return Err(io_at(path, "locking")(e)),
        }
    }
    let held = file.metadata().map_err(io_at(path, "reading metadata"))?;
    // A run that ended between opening and locking has removed the file, so this lock is on a deleted file.
    let same = fs::symlink_metadata(path).is_ok_and(|m| (m.dev(), m.ino()) == (held.dev(), held.ino()));
    Ok(if same { Lock::Ours(LockFile(file)) } else { Lock::Gone })
}

/// Whether the error of a lock says that there are no locks.
fn has_no_locks(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::Unsupported || Errno::from_io_error(error) == Some(Errno::NOLCK)
}

/// Writes the process of this run into the locked file.
pub(super) fn sign(LockFile(file): &mut LockFile) -> io::Result<()> {
    let host = rustix::system::uname();
    let signature = format!("process {} on {}", std::process::id(), host.nodename().to_string_lossy());
    retry(|| file.set_len(0))?;
    file.write_all(signature.as_bytes())
}

fn holder(path: &Path) -> String {
    let holder = String::from_utf8(read_capped(path, 400).unwrap_or_default()).unwrap_or_default();
    if holder.is_empty() { "just started".to_owned() } else { holder }
}
