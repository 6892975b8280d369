//! The work of writing a shard, cut into pieces that threads do in any order.

use crate::surgery::align::Run;
use crate::surgery::plan::PlannedShard;
use crate::surgery::planned_tensor::PlannedTensor;

/// Maximum number of bytes of a job that copies; also the bytes copied between two checks for a signal.
pub(super) const SLICE: u64 = 64 * 1024 * 1024;

/// A piece of work. Jobs of one shard write to disjoint ranges of it, which are together the whole file.
#[derive(Debug, Clone, Copy)]
pub(super) enum Job<'p> {
    /// Write the header.
    Header,
    /// Copy bytes.
    Copy(Run<'p>),
    /// Make a tensor, and hash it.
    Tensor {
        /// Its index in the shard.
        index: usize,
        /// The tensor.
        tensor: &'p PlannedTensor,
        /// Its first byte in the shard.
        at: u64,
    },
}

/// The jobs of a shard whose header has `header` bytes, in the order of the file.
///
/// If tensors are hashed, each one is a job, since a digest needs its bytes in order. Otherwise tensors that are adjacent
/// both in the shard and in a donor's file are copied together, in slices that end at multiples of [`SLICE`].
pub(super) fn jobs(shard: &PlannedShard, header: u64, hashed: bool) -> Vec<Job<'_>> {
    let mut jobs = vec![Job::Header];
    let mut open: Option<Run<'_>> = None;
    let mut at = header;
    for (index, tensor) in shard.tensors.iter().enumerate() {
        let len = tensor.len();
        if let Some(from) = tensor.copied().filter(|_| !hashed) {
            let run = Run { path: &from.path, from: from.offset, at, len };
            if !open.as_mut().is_some_and(|open| open.extend(run)) {
                cut(open.replace(run), &mut jobs);
            }
        } else {
            cut(open.take(), &mut jobs);
            jobs.push(Job::Tensor { index, tensor, at });
        }
        at = at.saturating_add(len);
    }
    cut(open, &mut jobs);
    jobs
}

/// Adds a run as slices.
fn cut<'p>(run: Option<Run<'p>>, jobs: &mut Vec<Job<'p>>) {
    let Some(mut rest) = run else { return };
    while rest.len > 0 {
        let (slice, others) = rest.split(SLICE.saturating_sub(rest.at % SLICE));
        jobs.push(Job::Copy(slice));
        rest = others;
    }
}

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects, reason = "small numbers")]
mod tests {
    use std::collections::BTreeMap;
    use std::path::PathBuf;

    use super::*;
    use crate::checkpoint::{Dtype, FileName};
    use crate::surgery::tensor_ref::TensorRef;

    /// A tensor of bytes at an offset of a donor's file.
    fn tensor(path: &str, offset: u64, len: u64) -> PlannedTensor {
        let from = TensorRef {
            donor: "a".to_owned(),
            path: PathBuf::from(path),
            name: "t".to_owned(),
            dtype: Dtype::U8,
            shape: vec![len],
            offset,
            len,
            slice: None,
        };
        PlannedTensor::copy("t".to_owned(), from)
    }

    fn shard(tensors: Vec<PlannedTensor>) -> PlannedShard {
        PlannedShard {
            name: FileName::constant("model.safetensors"),
            tensors,
            metadata: BTreeMap::new(),
            data_start: None,
        }
    }

    /// File, offset there, offset in the shard and length of each copy. Every byte of the data belongs to exactly one job.
    fn copies(shard: &PlannedShard) -> Vec<String> {
        let (mut copies, mut end) = (Vec::new(), 100);
        for job in jobs(shard, 100, false) {
            let (at, len) = match job {
                Job::Header => continue,
                Job::Copy(run) => {
                    copies.push(format!("{} {} {} {}", run.path.display(), run.from, run.at, run.len));
                    (run.at, run.len)
                }
                Job::Tensor { tensor, at, .. } => (at, tensor.len()),
            };
            assert_eq!(at, end);
            end += len;
        }
        assert_eq!(end, 100 + shard.data_len());
        copies
    }

    #[test]
    fn adjacent_copies_are_one_run() {
        let runs = |tensors| copies(&shard(tensors));
        assert_eq!(runs(vec![tensor("x", 50, 10), tensor("x", 60, 0), tensor("x", 60, 5)]), ["x 50 100 15"]);
        // A gap in the donor, another order, and another file.
        assert_eq!(runs(vec![tensor("x", 50, 10), tensor("x", 61, 5)]), ["x 50 100 10", "x 61 110 5"]);
        assert_eq!(runs(vec![tensor("x", 60, 5), tensor("x", 50, 10)]), ["x 60 100 5", "x 50 105 10"]);
        assert_eq!(runs(vec![tensor("x", 50, 10), tensor("y", 60, 5)]), ["x 50 100 10", "y 60 110 5"]);
        // A tensor that is made lies between the runs.
        let mut made = tensor("x", 60, 5).started();
        made.shape = vec![7];
        assert_eq!(runs(vec![tensor("x", 50, 10), made, tensor("x", 65, 5)]), ["x 50 100 10", "x 65 117 5"]);
        assert_eq!(runs(vec![tensor("x", 0, 0)]), [""; 0]);
    }

    #[test]
    fn long_runs_are_cut_at_multiples_of_the_slice() {
        let shard = shard(vec![tensor("x", 7, SLICE), tensor("x", 7 + SLICE, SLICE)]);
        let first = SLICE - 100;
        let expected = [(7, 100, first), (7 + first, SLICE, SLICE), (7 + first + SLICE, 2 * SLICE, 100)];
        assert_eq!(copies(&shard), expected.map(|(from, at, len)| format!("x {from} {at} {len}")));
    }

    #[test]
    fn hashed_tensors_are_jobs_of_their_own() {
        let shard = shard(vec![tensor("x", 50, 10), tensor("x", 60, 5)]);
        let places: Vec<u64> = jobs(&shard, 100, true)
            .iter()
            .filter_map(|job| if let Job::Tensor { at, .. } = job { Some(*at) } else { None })
            .collect();
        assert_eq!(places, [100, 110]);
    }
}
