//! Faults from the bytes of the tensors, and their comparison; read only for `check --deep`.
//!
//! Every byte of every shard passes once through the buffer of a thread, independent of the size of the weights; holes of
//! sparse files, which are zeros, are not read. Reads are positioned instead of memory-mapped: a file that shrinks during the read gives a
//! fault instead of a signal.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::thread;

use super::open::{Opened, open_regular};
use super::shard::tail::zero_tail;
use super::text::hex;
use super::{Dtype, Entry, Fault, FaultKind, Shard, Tensor};

#[cfg(feature = "cli")]
pub(crate) mod digests;
mod numbers;
mod pieces;

use numbers::{NonFiniteCounter, as_u64};
use pieces::{Hash, Piece, each_piece};

/// Bytes read at a time: a multiple of every element width, so that no element is split between two reads.
const CHUNK: usize = 1 << 20;

/// Maximum number of zeros in holes that are hashed of one checkpoint: a few seconds of work. A file or a tensor with more
/// has no digest.
const HASHED_ZEROS: u64 = 1 << 30;

/// Reads the bytes of every tensor of `shards`, and adds the faults that only the bytes reveal. Each thread takes one shard
/// after the other; the faults of a shard do not depend on the number of threads.
pub(super) fn read(root: &Path, entries: &BTreeMap<String, Entry>, shards: &mut BTreeMap<String, Shard>) {
    let hashed = shards.keys().filter(|name| entries.get(*name).and_then(stated_digest).is_some()).count();
    let zeros = HASHED_ZEROS.checked_div(as_u64(hashed)).unwrap_or(0);
    let threads = thread::available_parallelism().map_or(1, usize::from).min(shards.len());
    let queue = Mutex::new(shards.values_mut());
    let work = || {
        let mut buffer = vec![0_u8; CHUNK];
        let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
        while let Some(shard) = next() {
            let mut reader = ContentsReader { shard, faults: Vec::new(), zeros_left: zeros, buffer: &mut buffer };
            reader.run(root, entries.get(&shard.name));
            let faults = reader.faults;
            if faults.iter().any(|f| f.kind == FaultKind::ZeroTail) {
                // The header reader may already have reported a part of the zeros, from holes in the file.
                shard.faults.retain(|f| f.kind != FaultKind::ZeroTail);
            }
            shard.faults.extend(faults);
        }
    };
    thread::scope(|scope| {
        for _ in 1..threads {
            // Without another thread, this one does all of the work.
            let _started = thread::Builder::new().spawn_scoped(scope, work);
        }
        work();
    });
}

/// Whether two tensors of the same length have the same bytes; `None` when they cannot be read. Holes are zeros.
pub(super) fn same_bytes(root: &Path, one: (&Shard, &Tensor), other: (&Shard, &Tensor)) -> Option<bool> {
    let start = |(shard, tensor): (&Shard, &Tensor)| {
        let opened = open_regular(&root.join(&shard.name), u64::MAX).ok()?;
        let is_whole = opened.identity.size == shard.file_len && !shard.unread && shard.is_contiguous(&tensor.name);
        let start = shard.data_start.checked_add(tensor.begin)?;
        (is_whole && start.checked_add(tensor.len())? <= shard.file_len).then_some((opened, start))
    };
    let ((one_file, one_start), (other_file, other_start)) = (start(one)?, start(other)?);
    let [mut buffer, mut there] = [(); 2].map(|()| vec![0_u8; CHUNK]);
    let mut equal = one.1.len() == other.1.len();
    let mut readable = true;
    let mut at = other_start;
    let whole = each_piece(&one_file, one_start, one.1.len(), &mut buffer, |piece| {
        if equal && readable {
            match &piece {
                Piece::Data(bytes) => {
                    let there = there.get_mut(..bytes.len()).unwrap_or_default();
                    readable = other_file.read_exact_at(there, at).is_ok();
                    equal = *bytes == there;
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
pub(super) fn sample(root: &Path, shard: &Shard, tensor: &Tensor) -> Option<Vec<u8>> {
    let opened = open_regular(&root.join(&shard.name), u64::MAX).ok()?;
    if shard.unread || opened.identity.size != shard.file_len {
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
        opened.read_exact_at(&mut block, start.checked_add(at)?).ok()?;
        bytes.append(&mut block);
    }
    Some(bytes)
}

/// Maximum number of bytes of a tensor whose numbers are read: statistics have some hundred.
const NUMBERS: u64 = 64 << 10;

/// The numbers of a small tensor of floats; `None` for another dtype, a large tensor, and when the file does not have them.
pub(super) fn numbers(root: &Path, shard: &Shard, tensor: &Tensor) -> Option<Vec<f64>> {
    let is_small = tensor.len() <= NUMBERS && !shard.unread;
    let opened = is_small.then(|| open_regular(&root.join(&shard.name), u64::MAX).ok()).flatten()?;
    if opened.identity.size != shard.file_len {
        return None;
    }
    let mut bytes = vec![0; usize::try_from(tensor.len()).ok()?];
    opened.read_exact_at(&mut bytes, shard.data_start.checked_add(tensor.begin)?).ok()?;
    Some(match tensor.dtype {
        Dtype::F64 => bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        Dtype::F32 => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b).into()).collect(),
        Dtype::BF16 => bytes.as_chunks().0.iter().map(|b| half::bf16::from_le_bytes(*b).into()).collect(),
        Dtype::F16 => bytes.as_chunks().0.iter().map(|b| half::f16::from_le_bytes(*b).into()).collect(),
        _ => return None,
    })
}

/// State of reading one shard.
struct ContentsReader<'s> {
    shard: &'s Shard,
    faults: Vec<Fault>,
    /// Zeros in holes that may still be hashed.
    zeros_left: u64,
    buffer: &'s mut [u8],
}

impl ContentsReader<'_> {
    fn run(&mut self, root: &Path, entry: Option<&Entry>) {
        // Offsets of an unreadable header are not reliable; the header has its own faults.
        if self.shard.unread || self.shard.tensors.is_empty() {
            return;
        }
        let opened = match open_regular(&root.join(&self.shard.name), u64::MAX) {
            Ok(opened) => opened,
            Err(error) => return self.unread(&error.to_string()),
        };
        if opened.identity.size != self.shard.file_len {
            return self.unread("it changed while it was read");
        }
        if let Err(error) = self.tensors(&opened, entry) {
            let ended = error.kind() == std::io::ErrorKind::UnexpectedEof;
            self.unread(&if ended { "it became shorter while it was read".to_owned() } else { error.to_string() });
        }
    }

    fn unread(&mut self, reason: &str) {
        self.faults.push(Fault::new(FaultKind::ContentsUnread).at(self.shard.place()).with("reason", reason));
    }

    fn tensors(&mut self, opened: &Opened, entry: Option<&Entry>) -> std::io::Result<()> {
        let region = self.shard.file_len.saturating_sub(self.shard.data_start);
        let mut tensors: Vec<&Tensor> = self.shard.tensors.iter().filter(|t| t.begin <= t.end).collect();
        tensors.sort_by_key(|t| (t.begin, t.end, t.name.as_str()));
        // The file is hashed in the order of its tensors, which must cover all of it.
        let stated =
            entry.and_then(stated_digest).filter(|_| self.shard.faults.iter().all(|f| f.kind == FaultKind::ZeroTail));
        // Storages of a pickle are in any order, with other bytes between them, so its hash takes a pass of its own.
        let (mut whole, stated) = if self.shard.is_pickle() {
            self.pickle_hash(opened, stated)?;
            (Hash::none(), None)
        } else {
            (stated.as_ref().map_or_else(Hash::none, |_| Hash::new()), stated)
        };
        each_piece(opened, 0, self.shard.data_start, self.buffer, |piece| whole.add(&piece, &mut self.zeros_left))?;
        // End of the last nonzero byte, counted from the start of the data.
        let mut last_value = 0_u64;
        let mut read = 0_u64;
        let mut shared: Option<&Tensor> = None;
        // The other tensors of a truncated shard can still be read.
        for tensor in tensors.iter().filter(|tensor| tensor.end <= region) {
            // Tensors that overlap could name the same bytes any number of times.
            if !self.shard.is_contiguous(&tensor.name) {
                continue;
            }
            // Those of a pickle that share a storage whole are read once.
            if shared.is_some_and(|same: &Tensor| (same.begin, same.end) == (tensor.begin, tensor.end)) {
                continue;
            }
            shared = Some(*tensor).filter(|_| self.shard.is_pickle());
            read = read.saturating_add(tensor.len());
            if read > region.saturating_mul(2) {
                self.unread("its tensors overlap");
                return Ok(());
            }
            let mut numbers = NonFiniteCounter::new(tensor.dtype);
            let mut at = tensor.begin;
            let start = self.shard.data_start.saturating_add(tensor.begin);
            each_piece(opened, start, tensor.len(), self.buffer, |piece| {
                whole.add(&piece, &mut self.zeros_left);
                match &piece {
                    Piece::Data(bytes) => numbers.add(bytes),
                    Piece::Hole(len) => numbers.skip(*len),
                }
                if let Piece::Data(bytes) = &piece
                    && let Some(place) = bytes.iter().rposition(|byte| *byte != 0)
                {
                    last_value = at.saturating_add(as_u64(place)).saturating_add(1);
                }
                at = at.saturating_add(piece.len());
            })?;
            self.faults.extend(numbers.fault(self.shard, tensor));
        }
        if last_value < region && !self.shard.is_pickle() {
            let tail = zero_tail(self.shard, &tensors, last_value);
            self.faults.extend(tail);
        }
        match (whole.finish(), stated) {
            (Some(found), Some(stated)) if hex(&found) != stated => {
                let fault = Fault::new(FaultKind::ContentHashDiffers).at(self.shard.place());
                self.faults.push(fault.with("stated", stated).with("found", hex(&found)));
            }
            (None, Some(_)) => self.unread("its holes have more zeros than are hashed"),
            _ => {}
        }
        Ok(())
    }
}

impl ContentsReader<'_> {
    /// Compares the hash of a pickle with the one that its name states.
    fn pickle_hash(&mut self, opened: &Opened, stated: Option<String>) -> std::io::Result<()> {
        let Some(stated) = stated else { return Ok(()) };
        let mut whole = Hash::new();
        each_piece(opened, 0, self.shard.file_len, self.buffer, |piece| whole.add(&piece, &mut self.zeros_left))?;
        match whole.finish().map(|found| hex(&found)) {
            Some(found) if found != stated => {
                let fault = Fault::new(FaultKind::ContentHashDiffers).at(self.shard.place());
                self.faults.push(fault.with("stated", stated).with("found", found));
            }
            Some(_) => {}
            None => self.unread("its holes have more zeros than are hashed"),
        }
        Ok(())
    }
}

/// The SHA-256 in the name of a blob of the hub cache; names of smaller files are git hashes.
fn stated_digest(entry: &Entry) -> Option<String> {
    let name = entry.link.as_deref()?.rsplit('/').next()?;
    let is_digest = name.len() == 64 && name.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
    is_digest.then(|| name.to_owned())
}
