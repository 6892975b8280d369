//! What the bytes of the tensors reveal, and their comparison; read only for `check --deep` and `diff`.
//!
//! Every byte of every shard is read once, through windows of a memory map, so that memory does not depend on the size of the
//! weights; holes of sparse files, which are zeros, are not read. A file that shrinks during the read gives a fault instead of
//! a signal (`platform/mapped.rs`). Positioned reads take its place where a file cannot be mapped, and on Windows: they take
//! about twice as long where the page cache has large pages (`cargo bench --bench contents` compares the two).

use super::{Dtype, Shard, Source, Tensor};

#[cfg(feature = "cli")]
pub(crate) mod digests;
mod distance;
mod formats;
mod git_index;
pub(super) mod hashes;
mod pieces;
mod rank;
mod read;
mod tally;

pub use distance::Distance;
pub(super) use distance::distance;
pub use hashes::HashedFiles;
use pieces::{Piece, each_piece};
pub use rank::DifferenceRank;
pub(super) use rank::rank;
pub(super) use read::read;
pub use read::{Progress, ReadOptions, TensorContents, TensorStats};
use tally::{BLOCK, as_u64};

/// Bytes of a buffer: whole blocks, so that no element is split between two reads.
const CHUNK: usize = 40 * BLOCK;

/// Maximum number of zeros in holes that are hashed of one checkpoint: a few seconds of work. A file or a tensor with more
/// has no digest.
const HASHED_ZEROS: u64 = 1 << 30;

/// Whether two tensors of the same length, each in a file of its source, have the same bytes; `None` when they cannot be read.
/// Holes are zeros.
pub(super) fn same_bytes(
    [source, beside]: [&Source; 2],
    one: (&Shard, &Tensor),
    other: (&Shard, &Tensor),
) -> Option<bool> {
    let start = |source: &Source, (shard, tensor): (&Shard, &Tensor)| {
        let file = source.open_regular(&shard.name, u64::MAX).ok()?;
        let is_whole = file.len() == shard.file_len && !shard.unread && shard.is_contiguous(&tensor.name);
        let start = shard.data_start.checked_add(tensor.begin)?;
        (is_whole && start.checked_add(tensor.len())? <= shard.file_len).then_some((file, start))
    };
    let ((one_file, one_start), (other_file, other_start)) = (start(source, one)?, start(beside, other)?);
    let [mut buffer, mut there] = [(); 2].map(|()| vec![0_u8; CHUNK]);
    let mut equal = one.1.len() == other.1.len();
    let mut readable = true;
    let mut at = other_start;
    let whole = each_piece(&one_file, one_start, one.1.len(), &mut buffer, |piece| {
        if equal && readable {
            match &piece {
                Piece::Data(bytes) => {
                    let mut at = at;
                    for here in bytes.chunks(there.len()) {
                        let there = there.get_mut(..here.len()).unwrap_or_default();
                        readable &= other_file.read_exact_at(there, at).is_ok();
                        equal &= here == there;
                        at = at.saturating_add(as_u64(here.len()));
                        if !(equal && readable) {
                            break;
                        }
                    }
                }
                Piece::Hole(len) => {
                    let zeros = each_piece(&other_file, at, *len, &mut there, |piece| {
                        equal &= !matches!(piece, Piece::Data(bytes) if bytes.iter().any(|byte| *byte != 0));
                    });
                    readable = zeros.is_ok();
                }
            }
        }
        at = at.saturating_add(piece.len());
    });
    (whole.is_ok() && readable).then_some(equal)
}

/// Bytes of each of the blocks of a [`sample`].
const SAMPLE: u64 = 4096;

/// The first, middle and last bytes of a tensor, to tell tensors apart without reading them; `None` when the file does not
/// have them, as for a planned shard.
pub(super) fn sample(source: &Source, shard: &Shard, tensor: &Tensor) -> Option<Vec<u8>> {
    let file = source.open_regular(&shard.name, u64::MAX).ok()?;
    if shard.unread || file.len() != shard.file_len {
        return None;
    }
    if !shard.is_contiguous(&tensor.name) {
        return None;
    }
    let length = tensor.len().min(SAMPLE);
    let last = tensor.len().checked_sub(length)?;
    let start = shard.data_start.checked_add(tensor.begin)?;
    let mut bytes = Vec::new();
    for at in [0, last / 2, last] {
        let mut block = vec![0; usize::try_from(length).ok()?];
        file.read_exact_at(&mut block, start.checked_add(at)?).ok()?;
        bytes.append(&mut block);
    }
    Some(bytes)
}

/// Maximum number of bytes of a tensor whose numbers are read: statistics have some hundred.
const NUMBERS: u64 = 64 << 10;

/// The numbers of a small tensor of floats; `None` for another dtype, a large tensor, and when the file does not have them.
pub(super) fn numbers(source: &Source, shard: &Shard, tensor: &Tensor) -> Option<Vec<f64>> {
    let is_small = tensor.len() <= NUMBERS && !shard.unread;
    let file = is_small.then(|| source.open_regular(&shard.name, u64::MAX).ok()).flatten()?;
    if file.len() != shard.file_len {
        return None;
    }
    let mut bytes = vec![0; usize::try_from(tensor.len()).ok()?];
    file.read_exact_at(&mut bytes, shard.data_start.checked_add(tensor.begin)?).ok()?;
    decoded(tensor.dtype, &bytes)
}

/// The values of bytes of a float type; `None` for another type.
fn decoded(dtype: Dtype, bytes: &[u8]) -> Option<Vec<f64>> {
    Some(match dtype {
        Dtype::F64 => bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        Dtype::F32 => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b).into()).collect(),
        Dtype::BF16 => bytes.as_chunks().0.iter().map(|b| half::bf16::from_le_bytes(*b).into()).collect(),
        Dtype::F16 => bytes.as_chunks().0.iter().map(|b| half::f16::from_le_bytes(*b).into()).collect(),
        _ => return None,
    })
}
