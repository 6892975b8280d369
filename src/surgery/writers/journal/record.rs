//! The journal of a repair, the content of `journal.json` and `undo/N.json`.

use serde::{Deserialize, Serialize};

/// The serialised journal of a repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Journal {
    pub(super) version: u32,
    /// Number of the repair; the highest is undone first.
    pub(super) number: u32,
    pub(super) files: Vec<JournaledFile>,
}

/// A file of a repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JournaledFile {
    pub(super) name: String,
    /// The file before the repair; null when it did not exist.
    pub(super) old: Option<OldFile>,
    pub(super) new: NewFile,
}

/// A file before the repair. The original itself is kept in `undo/`, so no hash is needed.
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
