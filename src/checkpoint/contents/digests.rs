//! The digest of a file and of ranges in it, in one pass.

use std::path::Path;

use sha2::Sha256;

use super::pieces::{Hash, each_piece};
use super::{CHUNK, HASHED_ZEROS};
use crate::checkpoint::open::{OpenError, open_own};

/// SHA-256 digests of a file of a checkpoint, in hexadecimal; `None` for what has more zeros in holes than are hashed.
pub(crate) struct FileDigests {
    /// Its size.
    pub(crate) bytes: u64,
    /// Digest of the whole file.
    pub(crate) sha256: Option<String>,
    /// Digests of the ranges; `None` also for a range that overlaps the one before it or ends behind the file.
    pub(crate) ranges: Vec<Option<String>>,
}

/// Hashes files of one checkpoint, with one limit on the zeros of holes.
pub(crate) struct Digester {
    buffer: Vec<u8>,
    zeros_left: u64,
}

impl Digester {
    pub(crate) fn new() -> Self {
        Self { buffer: vec![0; CHUNK], zeros_left: HASHED_ZEROS }
    }

    /// Hashes the file `name` of the checkpoint in `root`, and ranges of it (start and length, in order of their starts).
    ///
    /// # Errors
    /// As [`open_own`], and when reading fails.
    pub(crate) fn file(&mut self, root: &Path, name: &str, ranges: &[(u64, u64)]) -> Result<FileDigests, OpenError> {
        let opened = open_own(root, name, u64::MAX)?;
        let bytes = opened.identity.size;
        let io = |source| OpenError::from_io(&root.join(name), source);
        let Self { buffer, zeros_left } = self;
        let mut whole = Hash::<Sha256>::new();
        let mut digests = Vec::new();
        let mut at = 0_u64;
        for (start, len) in ranges {
            let end = start.checked_add(*len).filter(|end| *end <= bytes && *start >= at);
            let Some(end) = end else {
                digests.push(None);
                continue;
            };
            each_piece(&opened, at, start.saturating_sub(at), buffer, |piece| whole.add(&piece, zeros_left))
                .map_err(io)?;
            let mut range = Hash::<Sha256>::new();
            each_piece(&opened, *start, *len, buffer, |piece| {
                range.add(&piece, zeros_left);
                whole.add(&piece, zeros_left);
            })
            .map_err(io)?;
            digests.push(range.finish());
            at = end;
        }
        each_piece(&opened, at, bytes.saturating_sub(at), buffer, |piece| whole.add(&piece, zeros_left)).map_err(io)?;
        Ok(FileDigests { bytes, sha256: whole.finish(), ranges: digests })
    }
}
