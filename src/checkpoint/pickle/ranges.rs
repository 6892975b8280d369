//! Ranges of bytes of a file, with the errors of a pickle.

use super::Problem;
use crate::checkpoint::SourceFile;
use crate::checkpoint::reserve::reserved;

impl SourceFile {
    /// The bytes of a range, which the caller has bounded.
    ///
    /// # Errors
    /// When the range ends behind the file, or reading fails.
    pub(super) fn bytes(&self, at: u64, len: u64) -> Result<Vec<u8>, Problem> {
        let short = || Problem::Malformed("a range lies outside the file".to_owned(), at);
        at.checked_add(len).filter(|end| *end <= self.len()).ok_or_else(short)?;
        let io = |error: std::io::Error| Problem::Io(error.to_string());
        let mut buffer = reserved(usize::try_from(len).map_err(|_| short())?).map_err(io)?;
        self.read_exact_at(&mut buffer, at).map_err(io)?;
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
