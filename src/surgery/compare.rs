//! Compares a tensor of a result with what its donors give, byte for byte.

use std::io::{self, Write};
use std::path::Path;

use super::donor::{DonorFile, OpenDonors};
use super::error::ApplyError;
use super::planned_tensor::PlannedTensor;
use super::stream::{block, stream};
use crate::checkpoint::HashAlgorithm;

/// A recomputed tensor, compared with the one in a result.
#[derive(Debug)]
pub struct Compared {
    /// Offset of the first byte that differs, from the start of the tensor; `None` when all are equal.
    pub difference: Option<u64>,
    /// Digests of the donors' parts, in the order of the expression's sources; `None` for one of which no bytes were read, or
    /// without an algorithm.
    pub source_digests: Vec<Option<String>>,
}

/// Recomputes `tensor` from its donors, and compares it with the bytes from `at` on in the file `result`; `hash` is the
/// algorithm of the donors' digests.
///
/// # Errors
/// [`ApplyError`] when a file cannot be opened or read.
pub fn compare(tensor: &PlannedTensor, result: &Path, at: u64, hash: HashAlgorithm) -> Result<Compared, ApplyError> {
    let mut out =
        Comparison { file: DonorFile::open(result)?, start: at, len: 0, difference: None, buffer: Vec::new() };
    let streamed = stream(&mut OpenDonors::default(), tensor, hash, result, &mut out)?;
    let difference = out.difference.or_else(|| (out.len != tensor.len()).then_some(out.len));
    Ok(Compared { difference, source_digests: streamed.source_digests })
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
