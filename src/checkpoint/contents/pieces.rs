//! The bytes of a file in pieces, without the holes of a sparse file.

use std::io::{Error, ErrorKind, Result};
use std::ops::Range;

use sha2::Digest;

use super::tally::{BLOCK, as_u64};
use crate::checkpoint::digest::Hasher;
use crate::checkpoint::open::Opened;
use crate::checkpoint::platform::{next_data, next_hole, with_window};
use crate::checkpoint::{SourceFile, hex};

/// Pieces start and end at a multiple of this many bytes from the start of the range, so that no element is split, and sums
/// do not depend on the holes.
const ALIGNMENT: u64 = BLOCK as u64;

/// Bytes that are mapped at a time: few enough to keep the memory that counts as used small.
pub(super) const WINDOW: usize = 1024 * BLOCK;

/// Fewer bytes than this are read into the buffer, which is faster.
const LEAST: usize = 256 << 10;

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

/// Calls `each` with the `len` bytes from `start` on, one piece of at most [`WINDOW`] bytes at a time: mapped, or
/// read into `buffer` where they are few or cannot be mapped. Called for each part of a tensor, and for files that are hashed.
///
/// # Errors
/// When reading fails, or the file has become shorter.
pub(super) fn each_piece(
    file: &SourceFile,
    start: u64,
    len: u64,
    buffer: &mut [u8],
    mut each: impl FnMut(Piece<'_>),
) -> Result<()> {
    let end = start.saturating_add(len);
    let opened = match file {
        SourceFile::Local(opened) => opened,
        SourceFile::Memory(bytes) => return each_window(bytes, start..end, each),
    };
    let aligned = |at: u64| at.saturating_sub(at.saturating_sub(start) % ALIGNMENT);
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
        // A piece reaches into the hole, or starts in one before it, by less than a block.
        let stop = aligned(hole.saturating_add(ALIGNMENT)).min(end);
        at = read(opened, at..stop, buffer, &mut each)?;
    }
    Ok(())
}

/// Calls `each` with a range of bytes in memory.
fn each_window(bytes: &[u8], range: Range<u64>, mut each: impl FnMut(Piece<'_>)) -> Result<()> {
    let place = |at| usize::try_from(at).unwrap_or(usize::MAX);
    let range = bytes.get(place(range.start)..place(range.end)).ok_or(ErrorKind::UnexpectedEof)?;
    range.chunks(WINDOW).for_each(|window| each(Piece::Data(window)));
    Ok(())
}

/// Number of the `len` bytes from `start` on that are in holes: at least as many as [`each_piece`] gives as holes. 0 where the
/// file system does not tell holes, and in memory.
#[cfg(feature = "cli")]
pub(super) fn holes(file: &SourceFile, start: u64, len: u64) -> u64 {
    let Some(opened) = file.local() else { return 0 };
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
fn read(opened: &Opened, range: Range<u64>, buffer: &mut [u8], each: &mut impl FnMut(Piece<'_>)) -> Result<u64> {
    let mut at = range.start;
    while at < range.end {
        let left = range.end.saturating_sub(at);
        let window = usize::try_from(left).unwrap_or(usize::MAX).min(WINDOW);
        if window >= LEAST
            && let Some(read) = with_window(&opened.file, at, window, |bytes| each(Piece::Data(bytes)))
        {
            read?;
            at = at.saturating_add(as_u64(window));
            continue;
        }
        let size = usize::try_from(left).unwrap_or(usize::MAX).min(buffer.len());
        let Some(piece) = buffer.get_mut(..size).filter(|piece| !piece.is_empty()) else { break };
        opened.read_exact_at(piece, at)?;
        each(Piece::Data(piece));
        at = at.saturating_add(as_u64(size));
    }
    Ok(range.end)
}

/// A hash function in progress.
pub(super) trait Absorb {
    fn absorb(&mut self, bytes: &[u8]);

    /// The digest in hexadecimal; `None` for no hash function.
    fn into_hex(self) -> Option<String>;
}

impl<D: Digest> Absorb for D {
    fn absorb(&mut self, bytes: &[u8]) {
        self.update(bytes);
    }

    fn into_hex(self) -> Option<String> {
        Some(hex(&self.finalize()))
    }
}

impl Absorb for Hasher {
    fn absorb(&mut self, bytes: &[u8]) {
        self.update(bytes);
    }

    fn into_hex(self) -> Option<String> {
        self.finish().map(|digest| hex(&digest))
    }
}

/// A hash in progress; none once the bytes have more holes than are hashed.
pub(super) struct Hash<H>(Option<H>);

impl<H: Absorb> Hash<H> {
    /// The hash of what `start` has already absorbed, and of what is added.
    pub(super) const fn of(start: H) -> Self {
        Self(Some(start))
    }

    /// Adds a piece; zeros of a hole are taken from `zeros_left`.
    pub(super) fn add(&mut self, piece: &Piece<'_>, zeros_left: &mut u64) {
        let Self(Some(hash)) = self else { return };
        match piece {
            Piece::Data(bytes) => hash.absorb(bytes),
            Piece::Hole(len) => match zeros_left.checked_sub(*len) {
                Some(left) => {
                    *zeros_left = left;
                    add_zeros(hash, *len);
                }
                None => self.0 = None,
            },
        }
    }

    /// Whether nothing was left out.
    pub(super) const fn is_whole(&self) -> bool {
        self.0.is_some()
    }

    /// The digest in hexadecimal; `None` when something was left out.
    pub(super) fn finish(self) -> Option<String> {
        self.0.and_then(H::into_hex)
    }
}

fn add_zeros(hash: &mut impl Absorb, len: u64) {
    const ZEROS: [u8; 4096] = [0; 4096];
    let mut left = len;
    while left > 0 {
        let size = left.min(as_u64(ZEROS.len()));
        hash.absorb(ZEROS.get(..usize::try_from(size).unwrap_or(0)).unwrap_or_default());
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
        const LEN: u64 = 2 << 20;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("sparse");
        let mut state = 1;
        let mut holes = 0;
        for _ in 0..20 {
            let file = std::fs::File::create(&path).unwrap();
            file.set_len(LEN).unwrap();
            for _ in 0..next(&mut state, 12) {
                let at = next(&mut state, LEN - 90_000);
                let bytes = vec![7; usize::try_from(next(&mut state, 90_000)).unwrap()];
                file.write_all_at(&bytes, at).unwrap();
            }
            let whole = std::fs::read(&path).unwrap();
            let opened = SourceFile::Local(open_regular(&path, u64::MAX).unwrap());
            for _ in 0..50 {
                let start = next(&mut state, LEN);
                let len = next(&mut state, LEN - start + 1);
                let (mut found, mut lengths) = (Vec::new(), Vec::new());
                each_piece(&opened, start, len, &mut vec![0; 3 * BLOCK], |piece| {
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
        let opened = SourceFile::Local(open_regular(&path, u64::MAX).unwrap());
        let read = each_piece(&opened, 50, 100, &mut [0; 64], |_| {});
        assert_eq!(read.unwrap_err().kind(), ErrorKind::UnexpectedEof);
    }
}
