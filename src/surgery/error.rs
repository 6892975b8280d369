//! Errors while writing a checkpoint; each text ends with the next step.

use std::io;
use std::path::{Path, PathBuf};

/// Why a plan was not written. Nothing has the target's name then, but for [`ApplyError::Unsynced`].
#[derive(Debug, thiserror::Error)]
pub enum ApplyError {
    /// The target is in the way.
    #[error("{path}: {reason}; choose a directory that does not exist yet or is empty", path = path.display())]
    Target {
        /// The target.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The target and a donor overlap.
    #[error("{path}: {reason}; the output directory must not overlap a donor; choose another one", path = path.display())]
    Donor {
        /// The target.
        path: PathBuf,
        /// How they overlap.
        reason: String,
    },
    /// Another run holds the staging directory.
    #[error("{path}: another run is writing there ({holder}); wait for it or choose another directory", path = path.display())]
    Busy {
        /// The target.
        path: PathBuf,
        /// Who holds it.
        holder: String,
    },
    /// Not enough room: by the estimate, or found while writing.
    #[error("{path}: {cause}: need {need} bytes, have {have}; free some, or write to another disk", path = path.display())]
    Space {
        /// What was being written, or the directory that would hold the target.
        path: PathBuf,
        /// `no space`, or what the system said.
        cause: String,
        /// Bytes still to be written.
        need: u64,
        /// Bytes free.
        have: u64,
    },
    /// No more files can be made, however small they are.
    #[error("{path}: {doing}: {error}: need {need} files, have {have} (inodes); remove some, or write to another disk", path = path.display())]
    Files {
        /// What was being made.
        path: PathBuf,
        /// What was being done.
        doing: &'static str,
        /// What the system said.
        error: io::Error,
        /// Files to be made.
        need: u64,
        /// Files that can be made.
        have: u64,
    },
    /// One file is larger than may be.
    #[error("{path}: the file would be too large: need {need} bytes, {limit}; raise that limit, or use smaller shards", path = path.display())]
    FileSize {
        /// The file.
        path: PathBuf,
        /// Its size when it is whole.
        need: u64,
        /// Whose limit it is.
        limit: String,
    },
    /// A donor changed while it was read.
    #[error("{path}: {reason} while it was being read; nothing was written, retry once nothing else modifies it", path = path.display())]
    Changed {
        /// The donor's file.
        path: PathBuf,
        /// What changed.
        reason: String,
    },
    /// A signal, such as that of Ctrl-C.
    #[error("interrupted; nothing was written")]
    Interrupted,
    /// Anything the system says.
    #[error("{path}: {doing}: {error}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was being done.
        doing: &'static str,
        /// What the system said.
        error: io::Error,
    },
    /// Writing failed, and so did removing what was written until then.
    #[error("{error}; {path} could not be removed ({why}); the next run with the same target tries again", path = path.display())]
    Left {
        /// What went wrong first.
        error: Box<Self>,
        /// The staging directory.
        path: PathBuf,
        /// What the system said to its removal.
        why: io::Error,
    },
    /// The target has its name, and can neither be made durable nor be taken back.
    #[error("{path}: is complete, but may not survive a power failure: syncing its parent directory failed: {error}", path = path.display())]
    Unsynced {
        /// The target.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
}

/// Why a repair was not written or undone.
#[derive(Debug, thiserror::Error)]
pub enum RepairError {
    /// A file that would change is a symbolic link, as all files of the hub's cache are.
    #[error("{path} is a symbolic link to {target}, and its target is never written to; \
             `--fix --output DIR` makes a repaired copy", path = path.display(), target = target.display())]
    Linked {
        /// The link.
        path: PathBuf,
        /// What it says.
        target: PathBuf,
    },
    /// The directory cannot be written to.
    #[error("{path} cannot be written to ({error}); `--fix --output DIR` makes a repaired copy elsewhere", path = path.display())]
    ReadOnly {
        /// The directory.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// A new file could not be given the owner of the old one.
    #[error("{path} is owned by another user, and its replacement cannot be given that owner ({error}); \
             `--fix --output DIR` makes a repaired copy", path = path.display())]
    Owner {
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// Another run works there.
    #[error("{path}: another run is repairing this checkpoint ({holder}); wait for it", path = path.display())]
    Busy {
        /// The checkpoint.
        path: PathBuf,
        /// Who it is.
        holder: String,
    },
    /// Not enough room.
    #[error("{path}: {cause}: need {need} bytes, have {have}; free some, or use `--fix --output DIR` on another disk", path = path.display())]
    Space {
        /// The checkpoint.
        path: PathBuf,
        /// `no space`, or what the system said.
        cause: String,
        /// Bytes the new files take.
        need: u64,
        /// Bytes free.
        have: u64,
    },
    /// A file is not what it was when the repair was planned.
    #[error("{path} changed while the repair was planned; nothing was written; retry once nothing else is modifying it", path = path.display())]
    ChangedWhilePlanned {
        /// The file.
        path: PathBuf,
    },
    /// A file is not what the repair made of it.
    #[error("{path} has changed since the repair, so it was not restored; its original is in {originals}",
        path = path.display(), originals = originals.display())]
    ChangedSinceRepair {
        /// The file.
        path: PathBuf,
        /// Where the originals are.
        originals: PathBuf,
    },
    /// There is no repair to undo.
    #[error("{path} has no repair to undo", path = path.display())]
    NothingToUndo {
        /// The checkpoint.
        path: PathBuf,
    },
    /// The journal was not written by this program.
    #[error("{path} cannot be used: {reason}", path = path.display())]
    UnusableJournal {
        /// The journal.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Something went wrong while files were put in place, and taking it back did too.
    #[error("{error}; writing is not finished: remove the cause, then run `ckpt-doctor undo` or `check --fix`")]
    Unfinished {
        /// What went wrong.
        error: Box<RepairError>,
    },
    /// Whatever else goes wrong with files.
    #[error(transparent)]
    Apply(#[from] ApplyError),
}

/// Turns an error of the system into [`ApplyError::Io`]: `doing` is what was done to `path`.
pub(super) fn io_at(path: &Path, doing: &'static str) -> impl FnOnce(io::Error) -> ApplyError {
    move |error| ApplyError::Io { path: path.to_owned(), doing, error }
}
