//! Errors while writing a checkpoint; each message ends with the next step.

use std::io;
use std::path::{Path, PathBuf};

use super::leftover::Leftover;
use crate::checkpoint::journal::JournalDistrust;
use crate::checkpoint::platform::is_out_of_descriptors;

/// Why a plan was not written. The target then does not exist, except with [`ApplyError::Unsynced`].
#[derive(Debug, thiserror::Error)]
pub enum ApplyError {
    /// The target cannot be used.
    #[error("{path}: {reason}; choose a directory that does not exist yet or is empty", path = path.display())]
    Target {
        /// The target.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// The target and a donor overlap.
    #[error("{path}: {reason}; the output directory must not overlap a donor; choose another one", path = path.display())]
    Donor {
        /// The target.
        path: PathBuf,
        /// Kind of overlap.
        reason: String,
    },
    /// Another run has locked the staging directory.
    #[error("{path}: another run is writing there ({holder}); wait for it or choose another directory", path = path.display())]
    Busy {
        /// The target.
        path: PathBuf,
        /// The process of the other run.
        holder: String,
    },
    /// Not enough space, by the estimate or while writing.
    #[error("{path}: {cause}: need {need} bytes, have {have}; free some space or write to another disk", path = path.display())]
    Space {
        /// The file being written, or the parent of the target.
        path: PathBuf,
        /// `no space`, or the system's error.
        cause: String,
        /// Bytes still to be written.
        need: u64,
        /// Bytes free.
        have: u64,
    },
    /// The file system cannot hold more files.
    #[error("{path}: {doing}: {error}: need {need} files, have {have} (inodes); remove some files or write to another disk", path = path.display())]
    Files {
        /// The file being created.
        path: PathBuf,
        /// The operation.
        doing: &'static str,
        /// The system's error.
        error: io::Error,
        /// Number of files to create.
        need: u64,
        /// Number of files that can be created.
        have: u64,
    },
    /// A file exceeds a limit on its size.
    #[error("{path}: the file would be too large: need {need} bytes, {limit}; raise that limit or use smaller shards", path = path.display())]
    FileSize {
        /// The file.
        path: PathBuf,
        /// Its full size.
        need: u64,
        /// The limit and its origin.
        limit: String,
    },
    /// A donor's file cannot be opened, because too many files are open.
    #[error("{path}: opening: {error}{more}; nothing was written", path = path.display(), more = more_descriptors(error))]
    Descriptors {
        /// The donor's file.
        path: PathBuf,
        /// The system's error.
        error: io::Error,
    },
    /// A donor changed during the run.
    #[error("{path}: {reason} during the run; nothing was written, retry once nothing else modifies it", path = path.display())]
    Changed {
        /// The donor's file.
        path: PathBuf,
        /// The change.
        reason: String,
    },
    /// This system cannot write checkpoints.
    #[error("writing checkpoints needs Linux or macOS; on Windows use WSL")]
    NeedsUnix,
    /// A signal such as SIGINT from Ctrl-C.
    #[error("interrupted; nothing was written")]
    Interrupted,
    /// Any other error of the system.
    #[error("{path}: {doing}: {error}{more}", path = path.display(), more = more_descriptors(error))]
    Io {
        /// The file.
        path: PathBuf,
        /// The operation.
        doing: &'static str,
        /// The system's error.
        error: io::Error,
    },
    /// Writing failed, and the incomplete files could not be removed.
    #[error("{error}; {leftover}")]
    Left {
        /// The first error.
        error: Box<Self>,
        /// The staging directory.
        leftover: Leftover,
    },
    /// The target is complete, but its name could neither be synced nor removed.
    #[error("{path}: syncing the parent directory: {error}; the directory is complete, but may be lost on a power failure", path = path.display())]
    Unsynced {
        /// The target.
        path: PathBuf,
        /// The system's error.
        error: io::Error,
    },
}

/// Why a repair was not written or not undone.
#[derive(Debug, thiserror::Error)]
pub enum RepairError {
    /// A file to change is a symbolic link, like all files of the hub cache.
    #[error("{path} is a symbolic link to {target}, and its target is never written to; \
             `--fix --output DIR` makes a repaired copy", path = path.display(), target = target.display())]
    Linked {
        /// The link.
        path: PathBuf,
        /// Its target.
        target: PathBuf,
    },
    /// The directory is not writable.
    #[error("{path} cannot be written to ({error}); `--fix --output DIR` makes a repaired copy elsewhere", path = path.display())]
    ReadOnly {
        /// The directory.
        path: PathBuf,
        /// The system's error.
        error: io::Error,
    },
    /// A new file could not be given the owner of the original.
    #[error("{path} is owned by another {whose}, and its replacement cannot be given that owner ({error}); \
             `--fix --output DIR` makes a repaired copy", path = path.display())]
    Owner {
        /// The original.
        path: PathBuf,
        /// `user` or `group`.
        whose: &'static str,
        /// The system's error.
        error: io::Error,
    },
    /// Another run has locked the checkpoint.
    #[error("{path}: another run is repairing this checkpoint ({holder}); wait for it", path = path.display())]
    Busy {
        /// The checkpoint.
        path: PathBuf,
        /// The process of the other run.
        holder: String,
    },
    /// Not enough space.
    #[error("{path}: {cause}: need {need} bytes, have {have}; free some space or use `--fix --output DIR` on another disk", path = path.display())]
    Space {
        /// The checkpoint.
        path: PathBuf,
        /// `no space`, or the system's error.
        cause: String,
        /// Bytes needed for the new files.
        need: u64,
        /// Bytes free.
        have: u64,
    },
    /// A file changed after the repair was planned.
    #[error("{path} changed while the repair was planned; nothing was written, retry once nothing else modifies it", path = path.display())]
    ChangedWhilePlanned {
        /// The file.
        path: PathBuf,
    },
    /// A file changed between the staging of its replacement and the replacement.
    #[error("{path} changed while it was repaired, and keeps its new content; retry once nothing else modifies it", path = path.display())]
    ChangedWhileRepaired {
        /// The file.
        path: PathBuf,
    },
    /// A file changed after the repair.
    #[error("{path} has changed since the repair, so it was not restored; what the repair replaced is in {originals}",
        path = path.display(), originals = originals.display())]
    ChangedSinceRepair {
        /// The file.
        path: PathBuf,
        /// The folder with the originals.
        originals: PathBuf,
    },
    /// A fix would leave a file as it is: the plan is wrong, and no other program has changed anything.
    #[error("{path}: the planned repair of this file changes nothing, and nothing was written; this is an error of \
             ckpt-doctor, please report it with the header or text of the file", path = path.display())]
    ChangesNothing {
        /// The file.
        path: PathBuf,
    },
    /// The checkpoint is in memory.
    #[error("{path} is in memory, and repairs are written into a directory; write its files into one first", path = path.display())]
    InMemory {
        /// The path that its files were given.
        path: PathBuf,
    },
    /// The checkpoint has no repair to undo.
    #[error("{path} has no repair to undo", path = path.display())]
    NothingToUndo {
        /// The checkpoint.
        path: PathBuf,
    },
    /// The journal is invalid or of an unknown version.
    #[error("{path} cannot be used: {reason}", path = path.display())]
    UnusableJournal {
        /// The journal.
        path: PathBuf,
        /// The problem.
        reason: String,
    },
    /// The journal is not this user's, so it may have come with a download.
    #[error("{path} was not carried out: {why}; delete {folder} if you do not know this repair, or add --adopt-journal if \
             you know who began it", path = path.display(), folder = folder.display())]
    ForeignJournal {
        /// The journal.
        path: PathBuf,
        /// How that was found.
        why: JournalDistrust,
        /// The folder with the journal, the new files and the originals.
        folder: PathBuf,
    },
    /// A file that the journal does not account for would get a name in the checkpoint.
    #[error("{path} is neither a new file nor an original of the repair, so it was not put into place; delete it if you do \
             not need it, or add --adopt-journal to put it into place", path = path.display())]
    Unaccounted {
        /// The file, in the folder of the journal.
        path: PathBuf,
    },
    /// Replacing the files failed, and so did restoring the originals.
    #[error("{error}; the repair is incomplete: remove the cause, then run `ckpt-doctor undo` or `check --fix`")]
    Unfinished {
        /// The error.
        error: Box<RepairError>,
    },
    /// The repair was not written, and its files could not be removed.
    #[error("{error}; {leftover}")]
    Left {
        /// The first error.
        error: Box<RepairError>,
        /// The directory.
        leftover: Leftover,
    },
    /// Any other error of writing files.
    #[error(transparent)]
    Apply(#[from] ApplyError),
}

impl RepairError {
    /// The error of a run that also left files.
    pub(super) fn with_leftover(self, leftover: Option<Leftover>) -> Self {
        match leftover {
            Some(leftover) => Self::Left { error: Box::new(self), leftover },
            None => self,
        }
    }
}

/// What helps against an error of the system, for the end of its message.
fn more_descriptors(error: &io::Error) -> &'static str {
    if is_out_of_descriptors(error) { "; raise the limit on open files (`ulimit -n`)" } else { "" }
}

/// Turns an error of the system into [`ApplyError::Io`]; `doing` names the operation on `path`.
pub(super) fn io_at(path: &Path, doing: &'static str) -> impl FnOnce(io::Error) -> ApplyError {
    move |error| ApplyError::Io { path: path.to_owned(), doing, error }
}
