//! Bytes of a file, read by position.

use super::Problem;
use crate::checkpoint::open::Opened;

/// A file or a buffer that is read by position.
pub(super) trait Source {
    /// Number of bytes.
    fn len(&self) -> u64;

    /// Fills the buffer with the bytes from `at` on.
    fn fill(&self, at: u64, buffer: &mut [u8]) -> std::io::Result<()>;
}

impl dyn Source + '_ {
    /// Whether there is no byte.
    pub(super) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The bytes of a range, which the caller has bounded.
    ///
    /// # Errors
    /// When the range ends behind the file, or reading fails.
    pub(super) fn bytes(&self, at: u64, len: u64) -> Result<Vec<u8>, Problem> {
        let short = || Problem::Malformed("a range lies outside the file".to_owned(), at);
        at.checked_add(len).filter(|end| *end <= self.len()).ok_or_else(short)?;
        let mut buffer = vec![0; usize::try_from(len).map_err(|_| short())?];
        self.fill(at, &mut buffer).map_err(|error| Problem::Io(error.to_string()))?;
        Ok(buffer)
    }

    /// An array of bytes.
    ///
    /// # Errors
    /// As [`Self::bytes`].
    pub(super) fn array<const N: usize>(&self, at: u64) -> Result<[u8; N], Problem> {
        let bytes = self.bytes(at, u64::try_from(N).unwrap_or(u64::MAX))?;
        bytes.first_chunk().copied().ok_or_else(|| Problem::Io("fewer bytes were read than expected".to_owned()))
    }
}

impl Source for Opened {
    fn len(&self) -> u64 {
        self.identity.size
    }

    fn fill(&self, at: u64, buffer: &mut [u8]) -> std::io::Result<()> {
        self.read_exact_at(buffer, at)
    }
}

impl Source for &[u8] {
    fn len(&self) -> u64 {
        u64::try_from(<[u8]>::len(self)).unwrap_or(u64::MAX)
    }

    fn fill(&self, at: u64, buffer: &mut [u8]) -> std::io::Result<()> {
        let start = usize::try_from(at).unwrap_or(usize::MAX);
        let bytes = self.get(start..).and_then(|rest| rest.get(..buffer.len()));
        buffer.copy_from_slice(bytes.ok_or(std::io::ErrorKind::UnexpectedEof)?);
        Ok(())
    }
}
