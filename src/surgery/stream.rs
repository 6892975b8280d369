//! The bytes of a planned tensor, streamed from its donors.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::donor::{DonorFile, OpenDonors};
use super::error::{ApplyError, io_at};
use super::planned_tensor::PlannedTensor;
use super::stop::interrupted;
use super::tensor_ref::TensorRef;
use super::transform::{self, ValueFacts};
use crate::checkpoint::HashAlgorithm;
use crate::checkpoint::digest::Hasher;

/// Bytes held in memory between the donor and the writer.
const BLOCK: usize = 256 * 1024;

/// Facts about a streamed tensor; the default is that of a byte copy.
#[derive(Debug, Default)]
pub(super) struct Streamed {
    /// What is known of its values.
    pub(super) facts: ValueFacts,
    /// Digests of the donors' tensors, in the order of the expression's sources; `None` for one of which no bytes were read, or
    /// without an algorithm. Empty for a byte copy.
    pub(super) source_digests: Vec<Option<String>>,
}

/// Writes the bytes of a planned tensor into `out`: a file of the result, or the comparison of a verification.
///
/// `donors` opens the files of the tensor's sources, which are hashed by `hash`; `path` names `out` in errors of writing.
///
/// # Errors
/// [`ApplyError::Changed`] when a donor is shorter than a source, [`ApplyError::Io`] for other errors of reading and
/// for errors of writing, and [`ApplyError::Interrupted`].
pub(super) fn stream(
    donors: &mut OpenDonors,
    tensor: &PlannedTensor,
    hash: HashAlgorithm,
    path: &Path,
    out: &mut dyn Write,
) -> Result<Streamed, ApplyError> {
    let sources = tensor.source.sources();
    let paths: Vec<&Path> = sources.iter().map(|from| from.path.as_path()).collect();
    let source = |(from, donor)| SourceDigest { from, donor, hash: Hasher::new(hash), len: 0, is_read: false };
    let mut sources: Vec<SourceDigest<'_>> = sources.into_iter().zip(donors.files(&paths)?).map(source).collect();
    let mut failed_read = None;
    let result = {
        let mut writer = BufWriter::with_capacity(BLOCK, out);
        let mut read = |from: &TensorRef, at: u64, buf: &mut [u8]| {
            let source = sources.iter_mut().find(|source| std::ptr::eq(source.from, from));
            let Some(source) = source.filter(|_| interrupted().is_ok()) else {
                return Err(io::Error::from(io::ErrorKind::Other));
            };
            source.donor.read_at(buf, from.offset.saturating_add(at)).map_err(|e| {
                let kind = e.kind();
                failed_read = Some(source.donor.read_error(e));
                io::Error::from(kind)
            })?;
            source.add(at, buf);
            Ok(())
        };
        let facts = transform::write(&mut read, tensor, &mut writer);
        facts.and_then(|facts| writer.flush().map(|()| facts))
    };
    interrupted()?;
    if let Some(error) = failed_read {
        return Err(error);
    }
    let facts = result.map_err(io_at(path, "writing"))?;
    let is_hashed = hash != HashAlgorithm::None;
    let digests = sources.into_iter().map(|source| if is_hashed { source.finish() } else { Ok(None) });
    Ok(Streamed { facts, source_digests: digests.collect::<Result<_, _>>()? })
}

/// A donor's tensor and the digest of what is read of it, usually once and in order.
struct SourceDigest<'s> {
    from: &'s TensorRef,
    donor: &'s DonorFile,
    hash: Hasher,
    /// Number of bytes in `hash`, from the start of the tensor.
    len: u64,
    is_read: bool,
}

impl SourceDigest<'_> {
    /// Adds bytes read at an offset in the tensor, unless they are already included.
    fn add(&mut self, at: u64, bytes: &[u8]) {
        self.is_read = true;
        if at == self.len {
            self.hash.update(bytes);
            self.len = self.len.saturating_add(bytes.len() as u64);
        }
    }

    /// The digest, after the bytes that the expression left out are read; `None` if it read none.
    fn finish(mut self) -> Result<Option<String>, ApplyError> {
        let mut buffer = Vec::new();
        while self.is_read && self.len < self.from.len {
            interrupted()?;
            let block = block(&mut buffer, self.from.len.saturating_sub(self.len));
            let at = self.from.offset.saturating_add(self.len);
            self.donor.read_at(block, at).map_err(|e| self.donor.read_error(e))?;
            self.add(self.len, block);
        }
        Ok(self.hash.finish_hex().filter(|_| self.is_read))
    }
}

/// The part of the buffer for the next of `left` bytes.
pub(super) fn block(buffer: &mut Vec<u8>, left: u64) -> &mut [u8] {
    let len = usize::try_from(left).map_or(BLOCK, |n| n.min(BLOCK));
    buffer.resize(len, 0);
    buffer
}
