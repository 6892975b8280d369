//! Writes a plan as a directory, published by one rename.
//!
//! All files are written into a [`Staging`] directory beside the target and synced before the rename, so the target
//! never exists incomplete.

use std::io::Write;
use std::path::{Path, PathBuf};

use super::shards::write_shards;
use super::sharing::Sharing;
use super::staging::Staging;
use super::system::{check_space, create, with_figures};
use crate::surgery::donor::DonorSnapshot;
use crate::surgery::error::{ApplyError, io_at};
use crate::surgery::leftover::Leftover;
use crate::surgery::plan::{Plan, PlannedFile, PlannedShard};
use crate::surgery::stop::interrupted;
use crate::surgery::written::{Writing, WrittenShard};

/// Writes `plan` as the directory `out` (a path from [`super::claim_target`]); `progress` receives the bytes written,
/// from several threads. Returns the staging directory if it could not be removed afterwards.
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
    how: Writing,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<Option<Leftover>, ApplyError> {
    let parent = out.parent().unwrap_or_else(|| Path::new("/"));
    let files = plan.files.iter().map(|f| f.bytes.len() as u64);
    let sharing = Sharing::of(parent);
    let shards = plan.shards.iter().map(|shard| sharing.space(shard));
    let sizes: Vec<u64> = files.chain(shards).chain(recorded.iter().copied()).collect();
    let explained = |error| with_figures(error, parent, &sizes);
    let staging = Staging::new(out).map_err(explained)?;
    // After `Staging::new`, which removes the files of a killed run: these may fill the disk.
    let written = check_space(parent, &sizes)
        .and_then(|()| write(plan, staging.content(), record, how, progress))
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
    how: Writing,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<(), ApplyError> {
    let files: Vec<(PathBuf, &PlannedShard)> = plan.shards.iter().map(|s| (dir.join(&*s.name), s)).collect();
    let written = write_shards(&files, how, progress)?;
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
