//! Entries of a checkpoint directory.

use std::fmt;
use std::fs::Metadata;

use super::lfs::LfsPointer;
use super::platform::special_kind;

/// Kind of a directory entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EntryKind {
    /// A regular file.
    #[default]
    Regular,
    /// A directory.
    Directory,
    /// A FIFO, which would hang a reader.
    Fifo,
    /// A socket.
    Socket,
    /// A device.
    Device,
    /// A symbolic link with a missing target or in a loop, or an entry without readable metadata.
    Broken,
}

impl EntryKind {
    /// The kind according to metadata of the link target; any other kind of file counts as a device.
    #[must_use]
    pub(super) fn from_metadata(metadata: &Metadata) -> Self {
        let kind = metadata.file_type();
        if kind.is_file() {
            Self::Regular
        } else if kind.is_dir() {
            Self::Directory
        } else {
            special_kind(kind)
        }
    }

    /// The name used in messages.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Regular => "regular file",
            Self::Directory => "directory",
            Self::Fifo => "FIFO",
            Self::Socket => "socket",
            Self::Device => "device",
            Self::Broken => "broken link",
        }
    }
}

impl fmt::Display for EntryKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One entry of a checkpoint directory.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Entry {
    /// Kind of the entry, after following symbolic links.
    pub kind: EntryKind,
    /// Bytes in the file, after following symbolic links; 0 for anything but a file.
    pub size: u64,
    /// Target of the symbolic link; `None` when the entry is not a link.
    pub link: Option<String>,
    /// The Git LFS pointer; `None` when the file is not one.
    pub lfs: Option<LfsPointer>,
}
