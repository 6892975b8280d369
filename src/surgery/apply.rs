//! Writes a plan as a directory, published by one rename.
//!
//! All files are written into a [`Staging`] directory beside the target and synced before the rename, so the target
//! never exists incomplete.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::donor::{DonorFile, DonorSnapshot};
use super::error::{ApplyError, io_at};
use super::leftover::Leftover;
use super::plan::{Plan, PlannedShard, PlannedTensor, TensorRef, TensorSource};
use super::staging::Staging;
use super::stop::interrupted;
use super::system::{check_space, copy_in_kernel, create, with_figures};
use super::transform;
use super::verify::accepted_by_safetensors;
use crate::checkpoint::open::open_regular;

/// Writes `plan` as the directory `out` (a path from [`super::claim_target`]); `progress` receives the bytes written.
/// Returns the staging directory if it could not be removed afterwards.
///
/// Fails when a donor no longer matches its snapshot.
///
/// # Errors
/// An [`ApplyError`]; unless it says otherwise, the target is unchanged and the staging directory is removed.
pub fn apply(
    plan: &Plan,
    donors: &[DonorSnapshot],
    out: &Path,
    progress: &mut dyn FnMut(u64),
) -> Result<Option<Leftover>, ApplyError> {
    let parent = out.parent().unwrap_or_else(|| Path::new("/"));
    let files = plan.files.iter().map(|f| f.bytes.len() as u64);
    let sizes: Vec<u64> = files.chain(plan.shards.iter().map(PlannedShard::file_len)).collect();
    let explained = |error| with_figures(error, parent, &sizes);
    let staging = Staging::new(out).map_err(explained)?;
    // After `Staging::new`, which removes the files of a killed run: these may fill the disk.
    let written = check_space(parent, &sizes)
        .and_then(|()| write(plan, staging.content(), progress))
        .and_then(|()| donors.iter().try_for_each(DonorSnapshot::unchanged))
        .and_then(|()| interrupted())
        .and_then(|()| staging.publish(out));
    match (written, staging.discard()) {
        (Ok(()), leftover) => Ok(leftover),
        (Err(error), None) => Err(explained(error)),
        (Err(error), Some(leftover)) => Err(ApplyError::Left { error: Box::new(explained(error)), leftover }),
    }
}

fn write(plan: &Plan, dir: &Path, progress: &mut dyn FnMut(u64)) -> Result<(), ApplyError> {
    for shard in &plan.shards {
        write_shard(&dir.join(&shard.name), shard, progress)?;
    }
    for file in &plan.files {
        interrupted()?;
        let path = dir.join(&file.name);
        let mut f = create(&path)?;
        f.write_all(&file.bytes).map_err(io_at(&path, "writing"))?;
        f.sync_all().map_err(io_at(&path, "syncing"))?;
        progress(file.bytes.len() as u64);
    }
    Ok(())
}

pub(super) fn write_shard(path: &Path, shard: &PlannedShard, progress: &mut dyn FnMut(u64)) -> Result<(), ApplyError> {
    let mut out = create(path)?;
    let header = shard.header();
    out.write_all(&header).map_err(io_at(path, "writing"))?;
    progress(header.len() as u64);
    let mut donor: Option<DonorFile> = None;
    for tensor in &shard.tensors {
        interrupted()?;
        let from = tensor.source.donor();
        // Adjacent tensors are usually in the same donor file, so it stays open.
        if donor.as_ref().is_none_or(|d| d.path != from.path) {
            donor = Some(DonorFile::open(&from.path)?);
        }
        if let Some(d) = &donor {
            write_tensor(&mut out, path, d, tensor, progress)?;
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

fn write_tensor(
    out: &mut File,
    path: &Path,
    donor: &DonorFile,
    tensor: &PlannedTensor,
    progress: &mut dyn FnMut(u64),
) -> Result<(), ApplyError> {
    match &tensor.source {
        TensorSource::Copy(from) => copy_range(out, path, donor, from, progress),
        source => {
            let from = source.donor();
            let elem = tensor.dtype.bits() / 8;
            let mut failed_read = None;
            let result = {
                let mut writer = BufWriter::with_capacity(256 * 1024, &mut *out);
                let mut read = |at: u64, buf: &mut [u8]| {
                    if interrupted().is_err() {
                        return Err(io::Error::from(io::ErrorKind::Other));
                    }
                    donor.read_at(buf, from.offset.saturating_add(at)).map_err(|e| {
                        let kind = e.kind();
                        failed_read = Some(e);
                        io::Error::from(kind)
                    })
                };
                let made = match source {
                    TensorSource::Pad(_) => transform::pad(&mut read, elem, &from.shape, &tensor.shape, &mut writer),
                    TensorSource::GrowRows(_) => {
                        let rows = from.shape.first().copied().unwrap_or_default();
                        let width = tensor.shape.iter().skip(1).fold(1_u64, |n, d| n.saturating_mul(*d));
                        let more = tensor.shape.first().copied().unwrap_or_default().saturating_sub(rows);
                        transform::grow_rows(&mut read, tensor.dtype, rows, width, more, &mut writer)
                    }
                    TensorSource::Copy(_) | TensorSource::Reinit { .. } => {
                        transform::reinit(&tensor.name, tensor.dtype, &tensor.shape, &mut writer)
                    }
                };
                made.and_then(|()| writer.flush())
            };
            interrupted()?;
            if let Some(e) = failed_read {
                return Err(donor.read_error(e));
            }
            result.map_err(io_at(path, "writing"))?;
            progress(tensor.len());
            Ok(())
        }
    }
}

/// Copies a byte range, inside the kernel if supported, otherwise through a buffer.
fn copy_range(
    out: &mut File,
    path: &Path,
    donor: &DonorFile,
    from: &TensorRef,
    progress: &mut dyn FnMut(u64),
) -> Result<(), ApplyError> {
    let mut at = from.offset;
    let mut left = from.len;
    let mut buffer = Vec::new();
    while left > 0 {
        interrupted()?;
        let in_kernel = if buffer.is_empty() {
            copy_in_kernel(donor.file(), at, out, left.min(SLICE)).map_err(io_at(path, "copying from a donor"))?
        } else {
            None
        };
        let copied = if let Some(n) = in_kernel {
            n
        } else {
            buffer.resize(usize::try_from(left.min(BUFFER)).unwrap_or_default(), 0);
            donor.read_at(&mut buffer, at).map_err(|e| donor.read_error(e))?;
            out.write_all(&buffer).map_err(io_at(path, "writing"))?;
            buffer.len() as u64
        };
        progress(copied);
        at = at.saturating_add(copied);
        left = left.saturating_sub(copied);
    }
    Ok(())
}

/// Bytes copied at a time when the kernel cannot copy.
const BUFFER: u64 = 1024 * 1024;
