//! Entries of a checkpoint directory.

use super::lfs::LfsPointer;

/// A directory entry, and what it turned out to be.
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
    /// A symbolic link that leads nowhere, or in a circle; or nothing the system tells about.
    Broken,
}

/// One entry of a checkpoint directory.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Entry {
    /// What it is, after following symbolic links.
    pub kind: EntryKind,
    /// Bytes in the file, after following symbolic links; 0 for anything but a file.
    pub size: u64,
    /// What the symbolic link says, if it is one.
    pub link: Option<String>,
    /// The pointer, if the file is one.
    pub lfs: Option<LfsPointer>,
}
