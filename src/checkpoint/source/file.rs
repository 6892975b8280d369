//! An open file of a source.

use std::io;
use std::sync::Arc;

use crate::checkpoint::open::Opened;

/// An open file of a [`super::Source`], read by position.
#[derive(Debug)]
pub enum SourceFile {
    /// A file of the file system.
    Local(Opened),
    /// A file in memory.
    Memory(Arc<[u8]>),
}

impl SourceFile {
    /// Number of bytes, at the time of opening.
    #[must_use]
    pub fn len(&self) -> u64 {
        match self {
            Self::Local(opened) => opened.identity.size,
            Self::Memory(bytes) => u64::try_from(bytes.len()).unwrap_or(u64::MAX),
        }
    }

    /// Whether it has no bytes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The file of the file system, which may have holes and can be mapped; `None` in memory.
    #[must_use]
    pub const fn local(&self) -> Option<&Opened> {
        match self {
            Self::Local(opened) => Some(opened),
            Self::Memory(_) => None,
        }
    }

    /// Time of the last change of content, in seconds and nanoseconds since 1970; `None` in memory.
    pub(crate) const fn modified(&self) -> Option<(i64, i64)> {
        match self {
            Self::Local(opened) => Some(opened.identity.mtime),
            Self::Memory(_) => None,
        }
    }

    /// Fills the buffer with the bytes from `at` on. Called by the readers of shards, pickles and contents, in any order.
    ///
    /// # Errors
    /// When the file ends before, or reading fails.
    pub(crate) fn read_exact_at(&self, buffer: &mut [u8], at: u64) -> io::Result<()> {
        match self {
            Self::Local(opened) => opened.read_exact_at(buffer, at),
            Self::Memory(bytes) => {
                let start = usize::try_from(at).unwrap_or(usize::MAX);
                let range = bytes.get(start..).and_then(|rest| rest.get(..buffer.len()));
                buffer.copy_from_slice(range.ok_or(io::ErrorKind::UnexpectedEof)?);
                Ok(())
            }
        }
    }
}
