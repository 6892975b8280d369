//! The bytes of a file in pieces, without the holes of a sparse file.

use std::io::{Error, ErrorKind, Result};

use super::numbers::as_u64;
use crate::checkpoint::HashAlgorithm;
use crate::checkpoint::digest::Hasher;
use crate::checkpoint::open::Opened;
use crate::checkpoint::platform::{next_data, next_hole};

/// Pieces start and end at a multiple of this many bytes from the start of the range, so that no element is split.
const ALIGNMENT: u64 = 16;

/// A part of a range of bytes.
pub(super) enum Piece<'b> {
    /// Bytes that were read.
    Data(&'b [u8]),
    /// A number of zeros that the file system did not store.
    Hole(u64),
}

impl Piece<'_> {
    pub(super) const fn len(&self) -> u64 {
        match self {
            Self::Data(bytes) => bytes.len() as u64,
            Self::Hole(len) => *len,
        }
    }
}

/// Calls `each` with the `len` bytes from `start` on, one piece of at most the length of `buffer` at a time. Called for the
/// header and for each tensor of a shard.
///
/// # Errors
/// When reading fails, or the file has become shorter.
pub(super) fn each_piece(
    opened: &Opened,
    start: u64,
    len: u64,
    buffer: &mut [u8],
    mut each: impl FnMut(Piece<'_>),
) -> Result<()> {
    let end = start.saturating_add(len);
    let aligned = |at: u64| start.saturating_add(at.saturating_sub(start) & !(ALIGNMENT - 1));
    let mut at = start;
    while at < end {
        let data = match next_data(&opened.file, at) {
            Ok(Some(data)) => aligned(data).min(end),
            // There is no data behind this place.
            Ok(None) => end,
            // The file system does not tell holes.
            Err(_) => at,
        };
        if data > at {
            if opened.file.metadata()?.len() < end {
                return Err(Error::from(ErrorKind::UnexpectedEof));
            }
            each(Piece::Hole(data.saturating_sub(at)));
            at = data;
            continue;
        }
        let hole = next_hole(&opened.file, at).unwrap_or(end);
        // A piece reaches into the hole up to the end of its last element.
        let stop = aligned(hole.saturating_add(ALIGNMENT)).min(end);
        at = read(opened, at..stop, buffer, &mut each)?;
    }
    Ok(())
}

/// Number of the `len` bytes from `start` on that are in holes: at least as many as [`each_piece`] gives as holes. 0 where the
/// file system does not tell holes.
#[cfg(feature = "cli")]
pub(super) fn holes(opened: &Opened, start: u64, len: u64) -> u64 {
    let end = start.saturating_add(len);
    let (mut at, mut zeros) = (start, 0_u64);
    while at < end {
        let Ok(data) = next_data(&opened.file, at) else { break };
        let data = data.map_or(end, |data| data.min(end));
        zeros = zeros.saturating_add(data.saturating_sub(at));
        at = next_hole(&opened.file, data).unwrap_or(end);
    }
    zeros
}

/// Reads a range of the file, and returns its end.
fn read(
    opened: &Opened,
    range: std::ops::Range<u64>,
    buffer: &mut [u8],
    each: &mut impl FnMut(Piece<'_>),
) -> Result<u64> {
    let mut at = range.start;
    while at < range.end {
        let left = range.end.saturating_sub(at);
        let size = usize::try_from(left).unwrap_or(usize::MAX).min(buffer.len());
        let Some(piece) = buffer.get_mut(..size).filter(|piece| !piece.is_empty()) else { break };
        opened.read_exact_at(piece, at)?;
        each(Piece::Data(piece));
        at = at.saturating_add(as_u64(size));
    }
    Ok(range.end)
}

/// A digest in progress; none once the bytes have more holes than are hashed.
pub(super) struct Hash(Option<Hasher>);

impl Hash {
    /// A SHA-256.
    pub(super) fn new() -> Self {
        Self::by(HashAlgorithm::Sha256)
    }

    pub(super) fn by(algorithm: HashAlgorithm) -> Self {
        Self(Some(Hasher::new(algorithm)))
    }

    pub(super) const fn none() -> Self {
        Self(None)
    }

    /// Adds a piece; zeros of a hole are taken from `zeros_left`.
    pub(super) fn add(&mut self, piece: &Piece<'_>, zeros_left: &mut u64) {
        let Self(Some(hash)) = self else { return };
        match piece {
            Piece::Data(bytes) => hash.update(bytes),
            Piece::Hole(len) => match zeros_left.checked_sub(*len) {
                Some(left) => {
                    *zeros_left = left;
                    add_zeros(hash, *len);
                }
                None => self.0 = None,
            },
        }
    }

    pub(super) fn finish(self) -> Option<[u8; 32]> {
        self.0.and_then(Hasher::finish)
    }
}

fn add_zeros(hash: &mut Hasher, len: u64) {
    const ZEROS: [u8; 4096] = [0; 4096];
    let mut left = len;
    while left > 0 {
        let size = left.min(as_u64(ZEROS.len()));
        hash.update(ZEROS.get(..usize::try_from(size).unwrap_or(0)).unwrap_or_default());
        left = left.saturating_sub(size);
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    #[cfg(unix)]
    use std::os::unix::fs::FileExt as _;

    use super::*;
    use crate::checkpoint::open::open_regular;

    /// Numbers from a seed.
    #[cfg(unix)]
    fn next(state: &mut u64, below: u64) -> u64 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 33).checked_rem(below).unwrap_or(0)
    }

    #[test]
    #[cfg(unix)]
    fn pieces_are_the_bytes_of_a_sparse_file() {
        const LEN: u64 = 1 << 20;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("sparse");
        let mut state = 1;
        let mut holes = 0;
        for _ in 0..20 {
            let file = std::fs::File::create(&path).unwrap();
            file.set_len(LEN).unwrap();
            for _ in 0..next(&mut state, 12) {
                let at = next(&mut state, LEN - 9000);
                let bytes = vec![7; usize::try_from(next(&mut state, 9000)).unwrap()];
                file.write_all_at(&bytes, at).unwrap();
            }
            let whole = std::fs::read(&path).unwrap();
            let opened = open_regular(&path, u64::MAX).unwrap();
            for _ in 0..50 {
                let start = next(&mut state, LEN);
                let len = next(&mut state, LEN - start + 1);
                let (mut found, mut lengths) = (Vec::new(), Vec::new());
                each_piece(&opened, start, len, &mut [0; 8192], |piece| {
                    lengths.push(piece.len());
                    holes += usize::from(matches!(piece, Piece::Hole(_)));
                    match piece {
                        Piece::Data(bytes) => found.extend_from_slice(bytes),
                        Piece::Hole(len) => found.resize(found.len() + usize::try_from(len).unwrap(), 0),
                    }
                })
                .unwrap();
                let range = usize::try_from(start).unwrap()..usize::try_from(start + len).unwrap();
                assert!(found == whole[range], "{start} {len}");
                let split = lengths.iter().rev().skip(1).find(|len| *len % ALIGNMENT != 0);
                assert_eq!(split, None, "an element is split");
            }
        }
        assert!(holes > 100, "{holes} holes: the file system of the temporary directory has none");
    }

    #[test]
    fn a_file_that_became_shorter_is_no_hole() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("short");
        std::fs::write(&path, [1; 100]).unwrap();
        let opened = open_regular(&path, u64::MAX).unwrap();
        let read = each_piece(&opened, 50, 100, &mut [0; 64], |_| {});
        assert_eq!(read.unwrap_err().kind(), ErrorKind::UnexpectedEof);
    }
}
