//! Digests and faults from the bytes of the tensors; read only for `check --deep`.
//!
//! Every byte of every shard passes once through one buffer, independent of the size of the weights. Reads are
//! positioned instead of memory-mapped: a file that shrinks during the read gives a fault instead of a signal.

use std::collections::BTreeMap;
use std::os::unix::fs::FileExt as _;
use std::path::Path;

use sha2::{Digest as _, Sha256};

use super::open::{Opened, open_regular};
use super::shard::tail::zero_tail;
use super::text::hex;
use super::{Entry, Fault, FaultKind, Shard, Tensor};

mod numbers;

use numbers::{NonFiniteCounter, as_u64};

/// Bytes read at a time: a multiple of every element width, so that no element is split between two reads.
const CHUNK: usize = 1 << 20;

/// SHA-256 digests of the tensors, by shard and tensor name.
#[derive(Debug, Clone, Default)]
pub struct Contents {
    digests: BTreeMap<String, BTreeMap<String, [u8; 32]>>,
}

impl Contents {
    /// Reads the bytes of every tensor of `shards`, and adds the faults that only the bytes reveal.
    pub(super) fn read(root: &Path, entries: &BTreeMap<String, Entry>, shards: &mut BTreeMap<String, Shard>) -> Self {
        let mut contents = Self::default();
        for shard in shards.values_mut() {
            let mut reader = ContentsReader { shard, digests: BTreeMap::new(), faults: Vec::new() };
            reader.run(root, entries.get(&shard.name));
            let ContentsReader { digests, faults, .. } = reader;
            contents.digests.insert(shard.name.clone(), digests);
            if faults.iter().any(|f| f.kind == FaultKind::ZeroTail) {
                // The header reader may already have reported a part of the zeros, from holes in the file.
                shard.faults.retain(|f| f.kind != FaultKind::ZeroTail);
            }
            shard.faults.extend(faults);
        }
        contents
    }

    /// SHA-256 of a tensor's bytes; `None` when they could not be read.
    #[must_use]
    pub fn digest(&self, shard: &str, tensor: &str) -> Option<&[u8; 32]> {
        self.digests.get(shard)?.get(tensor)
    }
}

/// State of reading one shard.
struct ContentsReader<'s> {
    shard: &'s Shard,
    digests: BTreeMap<String, [u8; 32]>,
    faults: Vec<Fault>,
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
        let mut buffer = vec![0_u8; CHUNK];
        let region = self.shard.file_len.saturating_sub(self.shard.data_start);
        let mut tensors: Vec<&Tensor> = self.shard.tensors.iter().filter(|t| t.begin <= t.end).collect();
        tensors.sort_by_key(|t| (t.begin, t.end, t.name.as_str()));
        // The file is hashed in the order of its tensors, which must cover all of it.
        let stated =
            entry.and_then(stated_digest).filter(|_| self.shard.faults.iter().all(|f| f.kind == FaultKind::ZeroTail));
        let mut whole = stated.as_ref().map(|_| Sha256::new());
        if let Some(whole) = &mut whole {
            each_chunk(opened, 0, self.shard.data_start, &mut buffer, |bytes| whole.update(bytes))?;
        }
        // End of the last nonzero byte, counted from the start of the data.
        let mut last_value = 0_u64;
        for tensor in &tensors {
            // The other tensors of a truncated shard can still be read.
            if tensor.end > region {
                continue;
            }
            let mut digest = Sha256::new();
            let mut numbers = NonFiniteCounter::new(tensor.dtype);
            let mut at = tensor.begin;
            let start = self.shard.data_start.saturating_add(tensor.begin);
            each_chunk(opened, start, tensor.len(), &mut buffer, |bytes| {
                digest.update(bytes);
                if let Some(whole) = &mut whole {
                    whole.update(bytes);
                }
                numbers.add(bytes);
                if let Some(place) = bytes.iter().rposition(|byte| *byte != 0) {
                    last_value = at.saturating_add(as_u64(place)).saturating_add(1);
                }
                at = at.saturating_add(as_u64(bytes.len()));
            })?;
            self.digests.insert(tensor.name.clone(), digest.finalize().into());
            self.faults.extend(numbers.fault(self.shard, tensor));
        }
        if last_value < region {
            let tail = zero_tail(self.shard, &tensors, last_value);
            self.faults.extend(tail);
        }
        if let (Some(whole), Some(stated)) = (whole, stated) {
            let found = hex(&whole.finalize());
            if found != stated {
                let fault = Fault::new(FaultKind::ContentHashDiffers).at(self.shard.place());
                self.faults.push(fault.with("stated", stated).with("found", found));
            }
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

/// Calls `each` with the `len` bytes from `start` on, one chunk at a time.
fn each_chunk(
    opened: &Opened,
    start: u64,
    len: u64,
    buffer: &mut [u8],
    mut each: impl FnMut(&[u8]),
) -> std::io::Result<()> {
    let (mut at, mut left) = (start, len);
    while left > 0 {
        let size = usize::try_from(left).unwrap_or(usize::MAX).min(buffer.len());
        let Some(piece) = buffer.get_mut(..size) else { return Ok(()) };
        opened.file.read_exact_at(piece, at)?;
        each(piece);
        at = at.saturating_add(as_u64(size));
        left = left.saturating_sub(as_u64(size));
    }
    Ok(())
}
