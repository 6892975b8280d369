//! The bytes of a planned tensor, streamed from its donor.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::convert::CastLosses;
use super::donor::DonorFile;
use super::error::{ApplyError, io_at};
use super::plan::{PlannedTensor, TensorRef};
use super::stop::interrupted;
use super::transform;
use crate::checkpoint::HashAlgorithm;
use crate::checkpoint::digest::Hasher;

/// Bytes held in memory between the donor and the writer.
const BLOCK: usize = 256 * 1024;

/// Facts about a streamed tensor; the default is that of a byte copy.
#[derive(Debug, Default)]
pub(super) struct Streamed {
    /// Values of the donor that scaling and casting could not keep.
    pub(super) losses: CastLosses,
    /// Digest of the donor's tensor; `None` if none of its bytes were read, or without an algorithm.
    pub(super) source_digest: Option<String>,
}

/// Writes the bytes of a planned tensor into `out`: a file of the result, or the comparison of a verification.
///
/// `donor` is the open file of the tensor's source, which is hashed by `hash`; `path` names `out` in errors of writing.
///
/// # Errors
/// [`ApplyError::Changed`] when the donor is shorter than the source, [`ApplyError::Io`] for other errors of reading and
/// for errors of writing, and [`ApplyError::Interrupted`].
pub(super) fn stream(
    donor: &DonorFile,
    tensor: &PlannedTensor,
    hash: HashAlgorithm,
    path: &Path,
    out: &mut dyn Write,
) -> Result<Streamed, ApplyError> {
    let from = &tensor.source.from;
    let mut failed_read = None;
    let mut digest =
        SourceDigest { hash: (hash != HashAlgorithm::None).then(|| Hasher::new(hash)), len: 0, is_read: false };
    let result = {
        let mut writer = BufWriter::with_capacity(BLOCK, out);
        let mut read = |at: u64, buf: &mut [u8]| {
            if interrupted().is_err() {
                return Err(io::Error::from(io::ErrorKind::Other));
            }
            donor.read_at(buf, from.offset.saturating_add(at)).map_err(|e| {
                let kind = e.kind();
                failed_read = Some(e);
                io::Error::from(kind)
            })?;
            digest.add(at, buf);
            Ok(())
        };
        let losses = transform::write(&mut read, tensor, &mut writer);
        losses.and_then(|losses| writer.flush().map(|()| losses))
    };
    interrupted()?;
    if let Some(e) = failed_read {
        return Err(donor.read_error(e));
    }
    let losses = result.map_err(io_at(path, "writing"))?;
    Ok(Streamed { losses, source_digest: digest.finish(donor, from)? })
}

/// The digest of a donor's tensor that a transform reads, usually once and in order.
struct SourceDigest {
    /// `None` without an algorithm.
    hash: Option<Hasher>,
    /// Number of bytes in `hash`, from the start of the tensor.
    len: u64,
    is_read: bool,
}

impl SourceDigest {
    /// Adds bytes read at an offset in the tensor, unless they are already included.
    fn add(&mut self, at: u64, bytes: &[u8]) {
        self.is_read = true;
        if let Some(hash) = self.hash.as_mut().filter(|_| at == self.len) {
            hash.update(bytes);
            self.len = self.len.saturating_add(bytes.len() as u64);
        }
    }

    /// The digest, after the bytes that the transform left out are read.
    fn finish(mut self, donor: &DonorFile, from: &TensorRef) -> Result<Option<String>, ApplyError> {
        if !self.is_read || self.hash.is_none() {
            return Ok(None);
        }
        let mut buffer = Vec::new();
        while self.len < from.len {
            interrupted()?;
            let block = block(&mut buffer, from.len.saturating_sub(self.len));
            donor.read_at(block, from.offset.saturating_add(self.len)).map_err(|e| donor.read_error(e))?;
            self.add(self.len, block);
        }
        Ok(self.hash.and_then(Hasher::finish_hex))
    }
}

/// The part of the buffer for the next of `left` bytes.
pub(super) fn block(buffer: &mut Vec<u8>, left: u64) -> &mut [u8] {
    let len = usize::try_from(left).map_or(BLOCK, |n| n.min(BLOCK));
    buffer.resize(len, 0);
    buffer
}
