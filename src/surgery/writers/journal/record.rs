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
    /// The edit, if only the header of a shard changes, in place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) header: Option<HeaderEdit>,
}

/// An edit of the header of a shard, in place; `undo/N/NAME` contains the old header and then the new one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct HeaderEdit {
    /// Number of bytes before the tensors.
    pub(super) old_len: u64,
    /// Number of bytes before the tensors after the edit.
    pub(super) new_len: u64,
    /// Inode of the shard: a file of another one was saved by another program, and was never edited.
    pub(super) inode: u64,
}

impl HeaderEdit {
    /// Number of bytes of both headers.
    pub(super) const fn kept_len(&self) -> u64 {
        self.old_len.saturating_add(self.new_len)
    }
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
    /// Of the file; with [`JournaledFile::header`], of its header.
    pub(super) sha256: String,
}
