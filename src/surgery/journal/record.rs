//! The journal of a repair, as `journal.json` and `undo/N.json` hold it.

use serde::{Deserialize, Serialize};

/// What a journal is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum JournalKind {
    Repair,
    Undo,
}

/// A repair, as it is written down.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Journal {
    pub(super) version: u32,
    pub(super) kind: JournalKind,
    /// Number of the repair: the latest is undone first.
    pub(super) number: u32,
    pub(super) files: Vec<JournaledFile>,
}

/// A file of a repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JournaledFile {
    pub(super) name: String,
    /// What was there; null when nothing was.
    pub(super) old: Option<OldFile>,
    pub(super) new: NewFile,
}

/// A file before the repair. Its bytes lie in `undo/`, so that no hash is needed to tell that they are the same.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct OldFile {
    pub(super) len: u64,
    /// Seconds and nanoseconds since 1970.
    pub(super) mtime: (i64, i64),
    pub(super) mode: u32,
}

/// A file after the repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NewFile {
    pub(super) len: u64,
    pub(super) sha256: String,
}
