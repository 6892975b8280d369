//! Writes a plan as a directory, published by one rename.
//!
//! All files are written into a [`Staging`] directory beside the target and synced before the rename, so the target
//! never exists incomplete.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use super::staging::Staging;
use super::system::{check_space, copy_in_kernel, create, with_figures};
use super::verify::accepted_by_safetensors;
use crate::checkpoint::open::open_regular;
use crate::surgery::donor::{DonorFile, DonorSnapshot};
use crate::surgery::error::{ApplyError, io_at};
use crate::surgery::leftover::Leftover;
use crate::surgery::plan::{Plan, PlannedFile, PlannedShard, PlannedTensor, TensorRef, TensorTransform};
use crate::surgery::stop::interrupted;
use crate::surgery::stream::{Streamed, block, stream};
use crate::surgery::written::{ShardDigests, WrittenShard};

/// Writes `plan` as the directory `out` (a path from [`super::claim_target`]); `progress` receives the bytes written.
/// Returns the staging directory if it could not be removed afterwards.
///
/// `record` is called once, after the shards and before the other files are written: it returns the files whose content
/// depends on what was written, such as the manifest of a merge. `recorded` are the expected sizes of these files in
/// bytes, for the check for free space.
///
/// Fails when a donor no longer matches its snapshot.
///
/// # Errors
/// An [`ApplyError`]; unless it says otherwise, the target is unchanged and the staging directory is removed.
pub fn apply(
    plan: &Plan,
    donors: &[DonorSnapshot],
    out: &Path,
    recorded: &[u64],
    record: &mut dyn FnMut(&[WrittenShard]) -> Vec<PlannedFile>,
    progress: &mut dyn FnMut(u64),
) -> Result<Option<Leftover>, ApplyError> {
    let parent = out.parent().unwrap_or_else(|| Path::new("/"));
    let files = plan.files.iter().map(|f| f.bytes.len() as u64);
    let shards = plan.shards.iter().map(PlannedShard::file_len);
    let sizes: Vec<u64> = files.chain(shards).chain(recorded.iter().copied()).collect();
    let explained = |error| with_figures(error, parent, &sizes);
    let staging = Staging::new(out).map_err(explained)?;
    // After `Staging::new`, which removes the files of a killed run: these may fill the disk.
    let written = check_space(parent, &sizes)
        .and_then(|()| write(plan, staging.content(), record, progress))
        .and_then(|()| donors.iter().try_for_each(DonorSnapshot::unchanged))
        .and_then(|()| interrupted())
        .and_then(|()| staging.publish(out));
    match (written, staging.discard()) {
        (Ok(()), leftover) => Ok(leftover),
        (Err(error), None) => Err(explained(error)),
        (Err(error), Some(leftover)) => Err(ApplyError::Left { error: Box::new(explained(error)), leftover }),
    }
}

fn write(
    plan: &Plan,
    dir: &Path,
    record: &mut dyn FnMut(&[WrittenShard]) -> Vec<PlannedFile>,
    progress: &mut dyn FnMut(u64),
) -> Result<(), ApplyError> {
    let mut written = Vec::new();
    for shard in &plan.shards {
        let mut digests = ShardDigests::default();
        write_content(&dir.join(&shard.name), shard, Some(&mut digests), progress)?;
        written.push(digests.finish(&shard.name, shard.file_len()));
    }
    for file in record(&written) {
        write_file(dir, &file)?;
    }
    for file in &plan.files {
        write_file(dir, file)?;
        progress(file.bytes.len() as u64);
    }
    Ok(())
}

fn write_file(dir: &Path, file: &PlannedFile) -> Result<(), ApplyError> {
    interrupted()?;
    let path = dir.join(&file.name);
    let mut f = create(&path)?;
    f.write_all(&file.bytes).map_err(io_at(&path, "writing"))?;
    f.sync_all().map_err(io_at(&path, "syncing"))
}

/// Writes a shard of a repair.
pub(super) fn write_shard(path: &Path, shard: &PlannedShard, progress: &mut dyn FnMut(u64)) -> Result<(), ApplyError> {
    write_content(path, shard, None, progress)
}

/// Writes a shard; `digests` receives its bytes.
fn write_content(
    path: &Path,
    shard: &PlannedShard,
    mut digests: Option<&mut ShardDigests>,
    progress: &mut dyn FnMut(u64),
) -> Result<(), ApplyError> {
    let mut out = create(path)?;
    let header = shard.header();
    out.write_all(&header).map_err(io_at(path, "writing"))?;
    progress(header.len() as u64);
    if let Some(digests) = &mut digests {
        digests.header(&header);
    }
    let mut donor: Option<DonorFile> = None;
    for tensor in &shard.tensors {
        interrupted()?;
        let from = &tensor.source.from;
        // Adjacent tensors are usually in the same donor file, so it stays open.
        if donor.as_ref().is_none_or(|d| d.path != from.path) {
            donor = Some(DonorFile::open(&from.path)?);
        }
        if let Some(d) = &donor {
            let mut out = ShardWriter { path, file: &mut out, digests: digests.as_deref_mut() };
            out.write_tensor(d, tensor, progress)?;
        }
    }
    let want = shard.file_len();
    let is = out.metadata().map_err(io_at(path, "reading metadata"))?.len();
    if is != want {
        let error = io::Error::other(format!("wrote {is} bytes, but the header declares {want}"));
        return Err(io_at(path, "writing")(error));
    }
    out.sync_all().map_err(io_at(path, "syncing"))?;
    // The file is write-only and opened again for the verification.
    let written = open_regular(path, u64::MAX).map_err(|e| io_at(path, "opening")(io::Error::other(e)))?;
    accepted_by_safetensors(&written.file).map_err(io_at(path, "verifying"))
}

/// Bytes copied between two checks for a signal.
const SLICE: u64 = 64 * 1024 * 1024;

/// A shard that is being written, with the digests of its bytes.
struct ShardWriter<'a> {
    path: &'a Path,
    file: &'a mut File,
    digests: Option<&'a mut ShardDigests>,
}

impl Write for ShardWriter<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.file.write(bytes)?;
        if let Some(digests) = &mut self.digests {
            digests.update(bytes.get(..n).unwrap_or_default());
        }
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl ShardWriter<'_> {
    fn write_tensor(
        &mut self,
        donor: &DonorFile,
        tensor: &PlannedTensor,
        progress: &mut dyn FnMut(u64),
    ) -> Result<(), ApplyError> {
        let streamed = if tensor.transform() == TensorTransform::Copy {
            self.copy_range(donor, &tensor.source.from, progress)?;
            Streamed::default()
        } else {
            let path = self.path;
            let streamed = stream(donor, tensor, path, self)?;
            progress(tensor.len());
            streamed
        };
        if let Some(digests) = &mut self.digests {
            digests.end_tensor(streamed);
        }
        Ok(())
    }

    /// Copies a byte range, inside the kernel if supported, otherwise through a buffer.
    fn copy_range(
        &mut self,
        donor: &DonorFile,
        from: &TensorRef,
        progress: &mut dyn FnMut(u64),
    ) -> Result<(), ApplyError> {
        let mut at = from.offset;
        let mut left = from.len;
        let mut kernel_copies = true;
        let mut buffer = Vec::new();
        while left > 0 {
            interrupted()?;
            let in_kernel = if kernel_copies {
                copy_in_kernel(donor.file(), at, self.file, left.min(SLICE))
                    .map_err(io_at(self.path, "copying from a donor"))?
            } else {
                None
            };
            let copied = if let Some(n) = in_kernel {
                self.hash_range(donor, at, n, &mut buffer)?;
                n
            } else {
                kernel_copies = false;
                let block = block(&mut buffer, left);
                donor.read_at(block, at).map_err(|e| donor.read_error(e))?;
                self.write_all(block).map_err(io_at(self.path, "writing"))?;
                block.len() as u64
            };
            progress(copied);
            at = at.saturating_add(copied);
            left = left.saturating_sub(copied);
        }
        Ok(())
    }

    /// Adds a range that the kernel copied to the digests. It has just been read, so it is in the page cache.
    fn hash_range(
        &mut self,
        donor: &DonorFile,
        mut at: u64,
        mut left: u64,
        buffer: &mut Vec<u8>,
    ) -> Result<(), ApplyError> {
        let Some(digests) = &mut self.digests else { return Ok(()) };
        while left > 0 {
            interrupted()?;
            let block = block(buffer, left);
            donor.read_at(block, at).map_err(|e| donor.read_error(e))?;
            digests.update(block);
            at = at.saturating_add(block.len() as u64);
            left = left.saturating_sub(block.len() as u64);
        }
        Ok(())
    }
}
