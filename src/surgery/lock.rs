//! The lock on a directory that one run at a time may work in: a file in it that says who does.
//!
//! The kernel frees it, whatever ends the run. It is on a file and not on the directory, because NFS locks only what
//! is open for writing.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;

use super::error::{ApplyError, io_at};
use super::system::{custom, retry};
use crate::checkpoint::open::read_capped;

/// What came of asking for a lock.
pub(super) enum Lock {
    /// This run has it.
    Ours(File),
    /// Another run has it: what that one says of itself.
    Theirs(String),
    /// The file or its directory went away meanwhile, with the run that had it.
    Gone,
    /// There are no locks on this file system; Lustre, for one, may be mounted so.
    Unknown(File),
}

/// Asks for the lock on the file `path`, which is made when it is not there.
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
            Err(TryLockError::Error(e)) if e.kind() == io::ErrorKind::Unsupported => return Ok(Lock::Unknown(file)),
            Err(TryLockError::Error(e)) => return Err(io_at(path, "locking")(e)),
        }
    }
    let held = file.metadata().map_err(io_at(path, "looking at"))?;
    // A run that ended between our open and our lock has removed it: what we hold then has no name any more.
    let same = fs::symlink_metadata(path).is_ok_and(|m| (m.dev(), m.ino()) == (held.dev(), held.ino()));
    Ok(if same { Lock::Ours(file) } else { Lock::Gone })
}

/// Writes into the locked file who works here.
pub(super) fn sign(file: &mut File) -> io::Result<()> {
    let host = rustix::system::uname();
    let signature = format!("process {} on {}", std::process::id(), host.nodename().to_string_lossy());
    retry(|| file.set_len(0))?;
    file.write_all(signature.as_bytes())
}

fn holder(path: &Path) -> String {
    let holder = String::from_utf8(read_capped(path, 400).unwrap_or_default()).unwrap_or_default();
    if holder.is_empty() { "just started".to_owned() } else { holder }
}
