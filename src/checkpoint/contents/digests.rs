//! Digests of files and of ranges in them, on several threads.

use super::pieces::{Hash, each_piece, holes};
use super::{CHUNK, HASHED_ZEROS};
use crate::checkpoint::digest::Hasher;
use crate::checkpoint::{HashAlgorithm, OpenError, Source, parallel};

/// A file of a checkpoint, or a range of it, to be hashed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HashJob<'h> {
    /// Where the files of the checkpoint are.
    pub(crate) source: &'h Source,
    /// File name.
    pub(crate) name: &'h str,
    /// First byte and number of bytes; the whole file if `None`.
    pub(crate) range: Option<(u64, u64)>,
    /// How to hash it.
    pub(crate) algorithm: HashAlgorithm,
}

/// A file, or a range of it, that was hashed.
#[derive(Debug)]
pub(crate) struct Hashed {
    /// Size of the whole file.
    pub(crate) file_len: u64,
    /// Digest in hexadecimal; `None` for a range that ends behind the file, and when the holes of the jobs up to this one
    /// have more zeros than are hashed.
    pub(crate) digest: Option<String>,
}

/// Hashes files and ranges of one checkpoint; the results are in the order of the jobs, and do not depend on the number of
/// threads.
///
/// # Errors
/// For each job as [`Source::open_own`], and when reading fails.
pub(crate) fn hash(jobs: &[HashJob<'_>]) -> Vec<Result<Hashed, OpenError>> {
    // The zeros of holes are shared out in the order of the jobs, so that the threads do not compete for them.
    let mut left = HASHED_ZEROS;
    let allowed = jobs.iter().map(|job| {
        let zeros = Some(job.zeros()).filter(|zeros| *zeros <= left).unwrap_or(0);
        left = left.saturating_sub(zeros);
        (*job, zeros)
    });
    let jobs: Vec<(HashJob<'_>, u64)> = allowed.collect();
    parallel::map(parallel::threads(), &jobs, || vec![0; CHUNK], |buffer, (job, zeros)| job.run(buffer, *zeros))
}

impl HashJob<'_> {
    /// The range in a file of `file_len` bytes; `None` when it ends behind it.
    fn range(self, file_len: u64) -> Option<(u64, u64)> {
        let (start, len) = self.range.unwrap_or((0, file_len));
        start.checked_add(len).filter(|end| *end <= file_len).map(|_| (start, len))
    }

    /// Number of its bytes in holes; 0 for a file that cannot be opened.
    fn zeros(self) -> u64 {
        let Ok(opened) = self.source.open_own(self.name, u64::MAX) else { return 0 };
        self.range(opened.len()).map_or(0, |(start, len)| holes(&opened, start, len))
    }

    fn run(self, buffer: &mut [u8], mut zeros: u64) -> Result<Hashed, OpenError> {
        let opened = self.source.open_own(self.name, u64::MAX)?;
        let file_len = opened.len();
        let Some((start, len)) = self.range(file_len) else { return Ok(Hashed { file_len, digest: None }) };
        let mut hash = Hash::of(Hasher::new(self.algorithm));
        each_piece(&opened, start, len, buffer, |piece| hash.add(&piece, &mut zeros))
            .map_err(|source| OpenError::from_io(&self.source.path().join(self.name), source))?;
        Ok(Hashed { file_len, digest: hash.finish() })
    }
}
