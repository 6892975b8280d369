//! The range of a new file that one job writes: copies, hashed copies and tensors that are made.

use std::fs::File;
use std::io::{self, Write};
use std::os::unix::fs::FileExt as _;
use std::path::Path;

use super::system::{KernelCopy, copy_in_kernel, read_ahead, write_back};
use crate::checkpoint::HashAlgorithm;
use crate::checkpoint::digest::Hasher;
use crate::surgery::align::{BLOCK, Run};
use crate::surgery::donor::{DonorFile, OpenDonors};
use crate::surgery::error::{ApplyError, io_at};
use crate::surgery::planned_tensor::PlannedTensor;
use crate::surgery::stop::interrupted;
use crate::surgery::stream::{Streamed, block, stream};
use crate::surgery::written::WrittenTensor;

/// Bytes between two requests to write back and to read ahead.
const STREAMED: u64 = 8 << 20;

/// Whether the `len` bytes from `at` on reach the end of a window of [`STREAMED`] bytes.
fn ends_window(at: u64, len: u64) -> bool {
    at / STREAMED != at.saturating_add(len) / STREAMED
}

/// The file that a job writes to.
pub(super) struct Out<'o> {
    pub(super) path: &'o Path,
    pub(super) file: &'o File,
    /// What copies inside the kernel do on its file system.
    pub(super) kernel: KernelCopy,
    pub(super) progress: &'o (dyn Fn(u64) + Sync),
}

impl Out<'_> {
    pub(super) fn write(&self, bytes: &[u8], at: u64) -> Result<(), ApplyError> {
        self.file.write_all_at(bytes, at).map_err(io_at(self.path, "writing"))?;
        (self.progress)(bytes.len() as u64);
        Ok(())
    }

    /// Copies bytes, inside the kernel where that shares blocks or the file system does it, otherwise through the buffer.
    ///
    /// The kernel shares whole blocks with the donor if both offsets agree; a call for more than whole blocks would copy all of
    /// them.
    pub(super) fn copy(&self, donor: &DonorFile, run: Run<'_>, buffer: &mut Vec<u8>) -> Result<(), ApplyError> {
        let mut place = Place { out: self, at: run.at, left: run.len, hasher: Hasher::new(HashAlgorithm::None) };
        let [head, whole, tail] = run.blocks();
        place.copy(donor, head, buffer)?;
        self.copy_rest(donor, whole, &mut place, buffer)?;
        // Offsets that do not agree: the kernel copies without sharing.
        if tail.len < BLOCK { place.copy(donor, tail, buffer) } else { self.copy_rest(donor, tail, &mut place, buffer) }
    }

    /// Copies inside the kernel what it can, and the rest through the buffer.
    fn copy_rest(
        &self,
        donor: &DonorFile,
        run: Run<'_>,
        place: &mut Place<'_>,
        buffer: &mut Vec<u8>,
    ) -> Result<(), ApplyError> {
        let rest = self.copy_in_kernel(donor, run)?;
        place.skip(run.len.saturating_sub(rest.len));
        place.copy(donor, rest, buffer)
    }

    /// Copies inside the kernel, and returns the range that it did not copy because it is not supported or would be slower.
    fn copy_in_kernel<'r>(&self, donor: &DonorFile, run: Run<'r>) -> Result<Run<'r>, ApplyError> {
        let mut rest = run;
        while rest.len > 0 && self.kernel != KernelCopy::Splices {
            interrupted()?;
            let shares = self.kernel == KernelCopy::Shares;
            let next = if shares { rest } else { rest.split(STREAMED.saturating_sub(rest.at % STREAMED)).0 };
            if !shares {
                let later = rest.split(next.len).1.split(STREAMED).0;
                read_ahead(donor.file(), later.from, later.len);
            }
            let copied = copy_in_kernel(donor.file(), next.from, self.file, next.at, next.len);
            let Some(copied) = copied.map_err(io_at(self.path, "copying from a donor"))? else { break };
            if !shares {
                write_back(self.file, next.at, copied);
            }
            (self.progress)(copied);
            rest = rest.split(copied).1;
        }
        Ok(rest)
    }

    /// Copies a tensor, and hashes it. What the file system can share is only read.
    fn copy_hashed(
        &self,
        donor: &DonorFile,
        run: Run<'_>,
        place: &mut Place<'_>,
        buffer: &mut Vec<u8>,
    ) -> Result<(), ApplyError> {
        let [head, whole, tail] = run.blocks();
        let rest = if self.kernel == KernelCopy::Shares { self.copy_in_kernel(donor, whole)? } else { whole };
        let (shared, rest) = whole.split(whole.len.saturating_sub(rest.len));
        place.copy(donor, head, buffer)?;
        read_blocks(donor, shared, buffer, |bytes| {
            place.pass(bytes);
            Ok(())
        })?;
        place.copy(donor, rest, buffer)?;
        place.copy(donor, tail, buffer)
    }

    /// Makes a tensor at an offset of the file, and its digest.
    pub(super) fn tensor(
        &self,
        donors: &mut OpenDonors,
        tensor: &PlannedTensor,
        at: u64,
        hash: HashAlgorithm,
        buffer: &mut Vec<u8>,
    ) -> Result<WrittenTensor, ApplyError> {
        let mut place = Place { out: self, at, left: tensor.len(), hasher: Hasher::new(hash) };
        let streamed = if let Some(from) = tensor.copied() {
            let run = Run { path: &from.path, from: from.offset, at, len: tensor.len() };
            self.copy_hashed(donors.file(&from.path)?, run, &mut place, buffer)?;
            Streamed::default()
        } else {
            stream(donors, tensor, hash, self.path, &mut place)?
        };
        if place.left > 0 {
            let error = io::Error::other(format!("{} is {} bytes too short", tensor.name, place.left));
            return Err(io_at(self.path, "writing")(error));
        }
        let Streamed { facts, source_digests } = streamed;
        Ok(WrittenTensor { digest: place.hasher.finish_hex(), facts, source_digests })
    }
}

/// The range of a file that belongs to one tensor, written from its start to its end.
struct Place<'p> {
    out: &'p Out<'p>,
    /// Offset of the next byte in the file.
    at: u64,
    /// Number of bytes up to the end of the tensor.
    left: u64,
    hasher: Hasher,
}

impl Place<'_> {
    /// Copies a range of a donor through the buffer to the next bytes.
    fn copy(&mut self, donor: &DonorFile, run: Run<'_>, buffer: &mut Vec<u8>) -> Result<(), ApplyError> {
        read_blocks(donor, run, buffer, |bytes| self.write_all(bytes).map_err(io_at(self.out.path, "writing")))
    }

    /// Adds the next bytes, which the file already has.
    fn pass(&mut self, bytes: &[u8]) {
        self.hasher.update(bytes);
        self.skip(bytes.len() as u64);
    }

    /// Moves past bytes that the file has.
    fn skip(&mut self, len: u64) {
        self.at = self.at.saturating_add(len);
        self.left = self.left.saturating_sub(len);
    }
}

/// Reads a range of a donor in blocks, and ahead of them. Each is passed on while it is in the cache of the processor.
fn read_blocks(
    donor: &DonorFile,
    run: Run<'_>,
    buffer: &mut Vec<u8>,
    mut pass: impl FnMut(&[u8]) -> Result<(), ApplyError>,
) -> Result<(), ApplyError> {
    let mut rest = run;
    while rest.len > 0 {
        interrupted()?;
        let block = block(buffer, rest.len);
        if ends_window(rest.from, block.len() as u64) {
            let (_, later) = rest.split(STREAMED);
            read_ahead(donor.file(), later.from, later.len.min(STREAMED));
        }
        donor.read_at(block, rest.from).map_err(|e| donor.read_error(e))?;
        pass(block)?;
        rest = rest.split(block.len() as u64).1;
    }
    Ok(())
}

impl Write for Place<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let len = bytes.len() as u64;
        if len > self.left {
            return Err(io::Error::other("a transform gave more bytes than its tensor has"));
        }
        self.out.file.write_all_at(bytes, self.at)?;
        (self.out.progress)(len);
        if ends_window(self.at, len) {
            write_back(self.out.file, (self.at / STREAMED).saturating_mul(STREAMED), STREAMED);
        }
        self.pass(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    use std::fs;

    use super::*;

    /// Where the kernel does not copy, the bytes pass through the buffer; hashed copies always do.
    #[test]
    fn every_way_to_copy_gives_the_same_bytes() {
        let work = tempfile::tempdir().unwrap();
        let path = work.path().join("donor");
        let bytes: Vec<u8> = (0..3_000_000_u32).map(|i| i.wrapping_mul(2_654_435_761).to_be_bytes()[0]).collect();
        fs::write(&path, &bytes).unwrap();
        let donor = DonorFile::open(&path).unwrap();
        for (from, at, len) in [(0, 0, 3_000_000), (5, 4101, 2_000_000), (7, 9, 2_999_993), (4000, 4000, 200)] {
            let run = Run { path: &path, from, at, len };
            for way in ["kernel", "buffer", "hashed", "hashed, shared"] {
                let target = work.path().join(way);
                let file = File::create(&target).unwrap();
                let kernel = match way {
                    "kernel" => KernelCopy::Delegates,
                    "hashed, shared" => KernelCopy::Shares,
                    _ => KernelCopy::Splices,
                };
                let out = Out { path: &target, file: &file, kernel, progress: &|_| {} };
                let mut buffer = Vec::new();
                match way {
                    "kernel" | "buffer" => out.copy(&donor, run, &mut buffer).unwrap(),
                    _ => {
                        let mut place = Place { out: &out, at, left: len, hasher: Hasher::new(HashAlgorithm::Blake3) };
                        out.copy_hashed(&donor, run, &mut place, &mut buffer).unwrap();
                        assert_eq!(place.left, 0);
                        let [from, len] = [from, len].map(|n| usize::try_from(n).unwrap());
                        assert_eq!(place.hasher.finish(), Some(blake3::hash(&bytes[from..][..len]).into()));
                    }
                }
                let [from, at, len] = [from, at, len].map(|n| usize::try_from(n).unwrap());
                assert!(fs::read(&target).unwrap()[at..] == bytes[from..][..len], "{way}: {from} {at} {len}");
            }
        }
        let long = Run { path: &path, from: 2_999_999, at: 0, len: 2 };
        let target = work.path().join("long");
        let file = File::create(&target).unwrap();
        for kernel in [KernelCopy::Shares, KernelCopy::Delegates, KernelCopy::Splices] {
            let out = Out { path: &target, file: &file, kernel, progress: &|_| {} };
            let error = out.copy(&donor, long, &mut Vec::new()).unwrap_err();
            assert!(matches!(error, ApplyError::Changed { .. }), "{error}");
        }
    }
}
