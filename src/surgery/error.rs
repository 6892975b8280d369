//! Errors while writing a checkpoint; each text ends with the next step.

use std::io;
use std::path::{Path, PathBuf};

/// Why nothing was written.
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

pub(super) fn io_at(path: &Path, doing: &'static str) -> impl FnOnce(io::Error) -> ApplyError {
    move |error| ApplyError::Io { path: path.to_owned(), doing, error }
}
