//! Compares a tensor of a result with what its donor gives, byte for byte.

use std::io::{self, Write};
use std::path::Path;

use super::donor::DonorFile;
use super::error::ApplyError;
use super::plan::PlannedTensor;
use super::stream::{block, stream};
use crate::checkpoint::HashAlgorithm;

/// A recomputed tensor, compared with the one in a result.
#[derive(Debug)]
pub struct Compared {
    /// Offset of the first byte that differs, from the start of the tensor; `None` when all are equal.
    pub difference: Option<u64>,
    /// Digest of the donor's part; `None` if none of its bytes were read, or without an algorithm.
    pub source_digest: Option<String>,
}

/// Recomputes `tensor` from its donor, and compares it with the bytes from `at` on in the file `result`; `hash` is the
/// algorithm of the donor's digest.
///
/// # Errors
/// [`ApplyError`] when a file cannot be opened or read.
pub fn compare(tensor: &PlannedTensor, result: &Path, at: u64, hash: HashAlgorithm) -> Result<Compared, ApplyError> {
    let donor = DonorFile::open(&tensor.source.from.path)?;
    let mut out =
        Comparison { file: DonorFile::open(result)?, start: at, len: 0, difference: None, buffer: Vec::new() };
    let streamed = stream(&donor, tensor, hash, result, &mut out)?;
    let difference = out.difference.or_else(|| (out.len != tensor.len()).then_some(out.len));
    Ok(Compared { difference, source_digest: streamed.source_digest })
}

/// Compares what is written to it with a range of a file.
struct Comparison {
    file: DonorFile,
    start: u64,
    /// Number of bytes compared.
    len: u64,
    difference: Option<u64>,
    buffer: Vec<u8>,
}

impl Write for Comparison {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let there = block(&mut self.buffer, bytes.len() as u64);
        let part = bytes.get(..there.len()).unwrap_or_default();
        if self.difference.is_none() {
            self.file.read_at(there, self.start.saturating_add(self.len))?;
            let differs = part.iter().zip(there.iter()).position(|(a, b)| a != b);
            self.difference = differs.map(|place| self.len.saturating_add(place as u64));
        }
        self.len = self.len.saturating_add(part.len() as u64);
        Ok(part.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
