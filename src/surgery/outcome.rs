//! What the writers return.

use std::path::PathBuf;

use super::leftover::Leftover;

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

/// Result of [`journal::recover`](super::journal::recover).
#[derive(Debug, Default)]
pub struct Recovery {
    /// What happened to an interrupted repair or undo; `None` when there was none.
    pub outcome: Option<Recovered>,
    /// Files that could not be removed.
    pub leftover: Option<Leftover>,
}

/// Result of an undo.
#[derive(Debug)]
pub struct Undone {
    /// Files that were restored.
    pub restored: Vec<String>,
    /// Files that the repair had added and that were removed.
    pub removed: Vec<String>,
    /// Number of earlier repairs that can still be undone.
    pub left: usize,
    /// Files that could not be removed.
    pub leftover: Option<Leftover>,
}
