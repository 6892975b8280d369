//! What the writers return.

use std::path::PathBuf;

use super::leftover::Leftover;
use crate::checkpoint::journal::NoKey;

/// An output directory that is free.
#[derive(Debug)]
pub struct Target {
    /// The path, with the links of its parent resolved.
    pub path: PathBuf,
    /// The staging directory of an ended run, if one was removed.
    pub cleared: Option<PathBuf>,
}

/// A repaired copy that was written.
#[derive(Debug)]
pub struct RepairedCopy {
    /// The staging directory of an ended run, if one was removed.
    pub cleared: Option<PathBuf>,
    /// The staging directory, if it could not be removed.
    pub leftover: Option<Leftover>,
}

/// Outcome of the recovery of a checkpoint with an interrupted repair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recovered {
    /// The repair was completed.
    Finished,
    /// The checkpoint is in its state before the repair.
    RolledBack,
}

/// What a repair, or the way back from it, did to a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileChange {
    /// A new file took the place of the old one.
    Replaced,
    /// The header of a shard was edited in place.
    Edited,
    /// A new file got a free name.
    Added,
    /// The original is in its place again.
    Restored,
    /// A file that the repair had added is gone.
    Removed,
    /// A file that another program had saved meanwhile is in its place again.
    Returned,
}

impl FileChange {
    /// The verb before the name of the file.
    #[must_use]
    pub const fn verb(self) -> &'static str {
        match self {
            Self::Replaced => "replaced",
            Self::Edited => "edited the header of",
            Self::Added => "added",
            Self::Restored => "restored",
            Self::Removed => "removed",
            Self::Returned => "returned what another program had saved as",
        }
    }
}

/// Result of [`journal::write`](super::journal::write).
#[derive(Debug, Default)]
pub struct RepairWritten {
    /// Files that could not be removed.
    pub leftover: Option<Leftover>,
    /// Why the journal of the repair has no authenticator: then only those who vouch for it can finish or undo it.
    pub unsigned: Option<NoKey>,
}

/// Result of [`journal::recover`](super::journal::recover).
#[derive(Debug, Default)]
pub struct Recovery {
    /// What happened to an interrupted repair or undo; `None` when there was none.
    pub outcome: Option<Recovered>,
    /// Of a finished one all its files, of one that was rolled back those that were put back.
    pub files: Vec<(FileChange, String)>,
    /// Files that could not be removed.
    pub leftover: Option<Leftover>,
}

/// Result of an undo.
#[derive(Debug)]
pub struct Undone {
    /// The interrupted repair that was finished first.
    pub recovery: Recovery,
    /// Files that were restored.
    pub restored: Vec<String>,
    /// Files that the repair had added and that were removed.
    pub removed: Vec<String>,
    /// Number of earlier repairs that can still be undone.
    pub left: usize,
    /// Files that could not be removed.
    pub leftover: Option<Leftover>,
}
