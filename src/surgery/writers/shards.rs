//! Writes shards on several threads.
//!
//! The threads take jobs from one queue over all shards, in the order of the files. Every job writes to its own range of a
//! shard, so the bytes do not depend on the number of threads. The first thread that needs a shard creates it, and the one
//! that ends its last job syncs and verifies it, while the others go on with the next shard.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use sha2::{Digest as _, Sha256};

use super::jobs::{Job, jobs};
use super::out::Out;
use super::system::{KernelCopy, create, reserve};
use super::verify::accepted_by_safetensors;
use crate::checkpoint::open::{OpenError, open_regular};
use crate::checkpoint::{HashAlgorithm, hex, parallel};
use crate::surgery::donor::OpenDonors;
use crate::surgery::error::{ApplyError, io_at};
use crate::surgery::plan::PlannedShard;
use crate::surgery::stop::interrupted;
use crate::surgery::written::{Writing, WrittenShard, WrittenTensor};

/// Writes new files with these paths, and syncs them. Called with all shards of a merge, and with each one of a repair.
///
/// `progress` receives the bytes written, from several threads.
///
/// # Errors
/// As [`super::apply()`]; the files are then incomplete.
pub(super) fn write_shards(
    files: &[(PathBuf, &PlannedShard)],
    how: Writing,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<Vec<WrittenShard>, ApplyError> {
    let is_hashed = how.hash != HashAlgorithm::None;
    let (mut shards, mut queue) = (Vec::new(), Vec::new());
    for (path, plan) in files {
        let header = plan.header();
        let jobs = jobs(plan, header.len() as u64, is_hashed);
        let len = plan.data_len().saturating_add(header.len() as u64);
        let left = AtomicUsize::new(jobs.len());
        queue.extend(jobs.into_iter().map(|job| (shards.len(), job)));
        shards.push(ShardFile { path, plan, header, len, left, file: Mutex::new(None) });
    }
    let writers = Writers { shards: &shards, hash: how.hash, progress, stopped: AtomicBool::new(false) };
    let done = parallel::map(how.threads, &queue, Thread::default, |thread, (shard, job)| {
        let done = writers.run(thread, *shard, *job);
        if done.is_err() {
            writers.stopped.store(true, Ordering::Relaxed);
        }
        done
    });
    let mut written: Vec<WrittenShard> = shards.iter().map(ShardFile::record).collect();
    for ((shard, job), done) in queue.iter().zip(done) {
        if let (Some(tensor), Job::Tensor { index, .. }) = (done?, job)
            && let Some(place) = written.get_mut(*shard).and_then(|shard| shard.tensors.get_mut(*index))
        {
            *place = tensor;
        }
    }
    Ok(written)
}

/// A shard that is being written.
struct ShardFile<'p> {
    path: &'p Path,
    plan: &'p PlannedShard,
    header: Vec<u8>,
    /// Size of the whole file.
    len: u64,
    /// Number of jobs that have not ended.
    left: AtomicUsize,
    /// Open from the first job to the last one.
    file: Mutex<Option<Arc<File>>>,
}

impl ShardFile<'_> {
    /// The record of the shard, with that of a copy for each tensor.
    fn record(&self) -> WrittenShard {
        WrittenShard {
            name: self.plan.name.clone(),
            bytes: self.len,
            header_sha256: hex(&Sha256::digest(&self.header)),
            tensors: vec![WrittenTensor::default(); self.plan.tensors.len()],
        }
    }

    /// Syncs the complete file, and reads its header with the safetensors crate.
    fn finish(&self, file: &File) -> Result<(), ApplyError> {
        let is = file.metadata().map_err(io_at(self.path, "reading metadata"))?.len();
        if is != self.len {
            let error = io::Error::other(format!("wrote {is} bytes, but the header declares {}", self.len));
            return Err(io_at(self.path, "writing")(error));
        }
        file.sync_all().map_err(io_at(self.path, "syncing"))?;
        // The file is write-only and opened again for the verification.
        let written = open_regular(self.path, u64::MAX);
        let written = written.map_err(|error| match error {
            OpenError::Io { source, .. } => io_at(self.path, "opening")(source),
            other => io_at(self.path, "opening")(io::Error::other(other)),
        })?;
        accepted_by_safetensors(&written.file).map_err(io_at(self.path, "verifying"))
    }
}

/// What one thread keeps from job to job.
#[derive(Default)]
struct Thread {
    donors: OpenDonors,
    buffer: Vec<u8>,
}

/// What all threads share.
struct Writers<'w> {
    shards: &'w [ShardFile<'w>],
    hash: HashAlgorithm,
    progress: &'w (dyn Fn(u64) + Sync),
    /// A job failed.
    stopped: AtomicBool,
}

impl Writers<'_> {
    /// Does a job; returns the record of a tensor that was made. Does nothing once another job has failed.
    fn run(&self, thread: &mut Thread, shard: usize, job: Job<'_>) -> Result<Option<WrittenTensor>, ApplyError> {
        interrupted()?;
        let Some(shard) = self.shards.get(shard) else { return Ok(None) };
        let Some(file) = self.open(shard)? else { return Ok(None) };
        let out = Out { path: shard.path, file: &file, kernel: KernelCopy::of(&file), progress: self.progress };
        let tensor = match job {
            Job::Header => {
                out.write(&shard.header, 0)?;
                None
            }
            Job::Copy(run) => {
                out.copy(thread.donors.file(run.path)?, run, &mut thread.buffer)?;
                None
            }
            Job::Tensor { tensor, at, .. } => {
                Some(out.tensor(&mut thread.donors, tensor, at, self.hash, &mut thread.buffer)?)
            }
        };
        if shard.left.fetch_sub(1, Ordering::AcqRel) == 1 {
            shard.finish(&file)?;
            *shard.file.lock().unwrap_or_else(PoisonError::into_inner) = None;
        }
        Ok(tensor)
    }

    /// The file of a shard, which the first call creates; `None` once a job has failed.
    fn open(&self, shard: &ShardFile<'_>) -> Result<Option<Arc<File>>, ApplyError> {
        let mut open = shard.file.lock().unwrap_or_else(PoisonError::into_inner);
        if self.stopped.load(Ordering::Relaxed) {
            return Ok(None);
        }
        if open.is_none() {
            let new = create(shard.path).and_then(|file| {
                // Blocks that will be shared need no space.
                let sized = match KernelCopy::of(&file) {
                    KernelCopy::Shares => file.set_len(shard.len),
                    KernelCopy::Delegates | KernelCopy::Splices => reserve(&file, shard.len),
                };
                sized.map_err(io_at(shard.path, "writing"))?;
                Ok(file)
            });
            // Before the lock is released: otherwise another thread would report that the file exists.
            if new.is_err() {
                self.stopped.store(true, Ordering::Relaxed);
            }
            *open = Some(Arc::new(new?));
        }
        Ok(open.clone())
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, clippy::arithmetic_side_effects, reason = "makes the files it reads")]
mod tests {
    use std::collections::BTreeMap;
    use std::fs;

    use super::*;
    use crate::checkpoint::{Dtype, FileName};
    use crate::surgery::expr::{Factor, NewValues, Product, TensorExpr};
    use crate::surgery::planned_tensor::PlannedTensor;
    use crate::surgery::tensor_ref::TensorRef;

    /// Shards with tensors of every transform, from one donor's file.
    fn plans(donor: &Path) -> Vec<PlannedShard> {
        let tensor = |shard: usize, index: usize| {
            let (rows, width) = (20 + index as u64, 300 + shard as u64);
            let from = TensorRef {
                donor: "a".to_owned(),
                path: donor.to_owned(),
                name: format!("{shard}.{index}"),
                dtype: Dtype::F32,
                shape: vec![rows, width],
                offset: (shard * 40 + index) as u64 * 1003,
                len: rows * width * 4,
                slice: None,
            };
            let (dtype, shape) = (from.dtype, vec![rows + 1, width]);
            let scale = (index == 7).then_some(2.0);
            let to = if index % 3 == 2 { Dtype::BF16 } else { dtype };
            // Sixteen rows of the same place, which fit in the file.
            let factor =
                |shape: [u64; 2]| TensorRef { shape: shape.to_vec(), len: shape[0] * shape[1] * 4, ..from.clone() };
            let source = match index % 6 {
                0 => TensorExpr::Stored(from),
                1 => TensorExpr::GrowRows { of: from, rows: rows + 1 },
                2 => TensorExpr::SampleRows { of: from, rows: rows + 1 },
                3 => TensorExpr::Pad { of: from, shape },
                4 => TensorExpr::Initialise { values: NewValues::Normal(0.02), dtype: to, shape, instead_of: from },
                _ => {
                    let (left, right) = (Factor::Transposed(factor([16, rows])), Factor::Stored(factor([16, width])));
                    let product = Product { left, right, scale: 1e-30, rounded: index % 4 == 1 };
                    TensorExpr::AddProduct { to: Box::new(TensorExpr::Stored(from)), product }
                }
            };
            let from = source.typed().unwrap().0;
            PlannedTensor::new(format!("{shard}.{index}"), source.converted(from, scale, to)).unwrap()
        };
        let shard = |shard: usize| PlannedShard {
            name: FileName::shard(shard + 1, 3),
            tensors: (0..40).map(|index| tensor(shard, index)).collect(),
            metadata: BTreeMap::new(),
            data_start: None,
        };
        (0..3).map(shard).collect()
    }

    #[test]
    fn the_number_of_threads_does_not_change_a_byte() {
        let work = tempfile::tempdir().unwrap();
        let donor = work.path().join("donor");
        let values = (0..300_000_u32).map(|i| i.wrapping_mul(2_654_435_761) & 0x7f7f_ffff);
        let bytes: Vec<u8> = values.flat_map(u32::to_le_bytes).collect();
        fs::write(&donor, bytes).unwrap();
        let plans = plans(&donor);
        let mut expected = None;
        for (threads, hash) in
            [(1, HashAlgorithm::Blake3), (4, HashAlgorithm::Blake3), (1, HashAlgorithm::None), (3, HashAlgorithm::None)]
        {
            let dir = work.path().join(format!("{threads}-{hash:?}"));
            fs::create_dir(&dir).unwrap();
            let files: Vec<_> = plans.iter().map(|plan| (dir.join(&*plan.name), plan)).collect();
            let total = AtomicUsize::new(0);
            let progress = |n: u64| {
                total.fetch_add(usize::try_from(n).unwrap(), Ordering::Relaxed);
            };
            let written = write_shards(&files, Writing { hash, threads }, &progress).unwrap();
            let bytes: Vec<Vec<u8>> = files.iter().map(|(path, _)| fs::read(path).unwrap()).collect();
            assert_eq!(total.into_inner(), bytes.iter().map(Vec::len).sum::<usize>());
            for (shard, bytes) in written.iter().zip(&bytes) {
                assert_eq!(safetensors::SafeTensors::deserialize(bytes).unwrap().len(), shard.tensors.len());
                for (tensor, plan) in shard.tensors.iter().zip(&plans[0].tensors) {
                    assert_eq!(tensor.digest.is_some(), hash != HashAlgorithm::None);
                    let is_started = matches!(plan.source, TensorExpr::Initialise { .. });
                    let read = if plan.copied().is_some() { 0 } else { plan.source.sources().len() };
                    assert_eq!(tensor.source_digests.len(), read);
                    let is_digest = !is_started && hash != HashAlgorithm::None;
                    assert!(tensor.source_digests.iter().all(|digest| digest.is_some() == is_digest));
                }
            }
            let losses: Vec<_> = written.iter().flat_map(|s| &s.tensors).map(|t| t.facts).collect();
            let found = (bytes, losses);
            assert!(expected.get_or_insert_with(|| found.clone()) == &found, "{threads} {hash:?}");
        }
    }

    #[test]
    fn a_donor_that_is_too_short_stops_all_threads() {
        let work = tempfile::tempdir().unwrap();
        let donor = work.path().join("donor");
        fs::write(&donor, vec![0; 100_000]).unwrap();
        for (threads, hash) in [(1, HashAlgorithm::None), (4, HashAlgorithm::Sha256)] {
            let plans = plans(&donor);
            let dir = work.path().join(format!("{threads}"));
            fs::create_dir(&dir).unwrap();
            let files: Vec<_> = plans.iter().map(|plan| (dir.join(&*plan.name), plan)).collect();
            let error = write_shards(&files, Writing { hash, threads }, &|_| {}).unwrap_err();
            assert!(error.to_string().contains("was truncated during the run"), "{error}");
        }
    }
}
