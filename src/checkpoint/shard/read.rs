//! Reads the header of a shard.

use super::tail::zero_tail;
use super::{MAX_HEADER, Shard, Tensor};
use crate::checkpoint::budget::Budget;
use crate::checkpoint::platform::{next_data, next_hole};
use crate::checkpoint::reserve::grown;
use crate::checkpoint::sniff::looks_like;
use crate::checkpoint::{Fault, FaultKind, NotRead, Place, Source, SourceFile};

/// Enough bytes to recognise a file format, and to hold most small headers whole.
const SAMPLE: u64 = 4096;

impl Shard {
    /// Reads the header of the file `name`, which must be a plain file name. Never fails: every problem becomes a fault.
    #[must_use]
    pub(crate) fn read(source: &Source, name: &str) -> Self {
        Self::read_within(source, name, &mut Budget::default())
    }

    /// As [`Self::read`], with the budget of the checkpoint.
    pub(crate) fn read_within(source: &Source, name: &str, budget: &mut Budget) -> Self {
        match source.open_regular(name, u64::MAX) {
            Ok(file) => read(name, &file, budget),
            Err(error) => Self::unopened(name, &error),
        }
    }

    /// Counts the tensors of a shard that is not read because the checkpoint is too large.
    pub(crate) fn counted(source: &Source, name: &str) -> Self {
        match source.open_regular(name, u64::MAX).map(|file| (read_head(&file), file.len())) {
            Ok((Ok(head), size)) => Self::count_entries(name, size, &head),
            _ => Self::over_budget(name),
        }
    }

    /// Reads the header of an open file. Never fails: what is wrong becomes a fault.
    pub(crate) fn read_opened(name: &str, file: &SourceFile) -> Self {
        read(name, file, &mut Budget::default())
    }
}

fn read(name: &str, file: &SourceFile, budget: &mut Budget) -> Shard {
    let head = match read_head(file) {
        Ok(head) => head,
        Err(error) => {
            let fault = Fault::new(FaultKind::UnreadableFile).at(Place::file(name)).with("reason", error.to_string());
            let not_read = Some(NotRead::Unreadable);
            return Shard {
                name: name.to_owned(),
                file_len: file.len(),
                unread: true,
                not_read,
                faults: vec![fault],
                ..Shard::default()
            };
        }
    };
    budget.spend_header(head.len());
    let mut shard = Shard::parse_within(name, file.len(), &head, budget);
    name_trailing_bytes(&mut shard, file);
    shard.faults.extend(unwritten_tail(&shard, file));
    shard
}

/// Size of the largest block of a usual file system: bytes before a hole that may be zero although they were written.
const BLOCK: u64 = 64 << 10;
/// Maximum number of data stretches examined to find the last hole of a file.
const STRETCHES: usize = 10_000;

/// The fault of a shard whose end was never written, according to the file system's holes. A stopped download that
/// preallocated the file leaves such an end, and so does a power failure. All checks of the structure pass on such a
/// file.
fn unwritten_tail(shard: &Shard, file: &SourceFile) -> Option<Fault> {
    let opened = file.local()?;
    if shard.unread || !shard.faults.is_empty() {
        return None;
    }
    let mut at = shard.data_start;
    for _ in 0..STRETCHES {
        let hole = next_hole(&opened.file, at).ok()?;
        if hole >= shard.file_len {
            return None;
        }
        match next_data(&opened.file, hole) {
            Ok(Some(data)) if data > hole => at = data,
            Ok(None) => {
                let tensors: Vec<&Tensor> = shard.tensors.iter().collect();
                return zero_tail(shard, &tensors, written(file, shard.data_start, hole)?);
            }
            _ => return None,
        }
    }
    None
}

/// Start of the zeros that end in the hole, counted in the data. The block before the hole was written whole, so its
/// last bytes may be zeros as well.
fn written(file: &SourceFile, data_start: u64, hole: u64) -> Option<u64> {
    let end = hole.saturating_sub(data_start);
    let mut block = vec![0; usize::try_from(end.min(BLOCK)).ok()?];
    let begin = hole.saturating_sub(end.min(BLOCK));
    file.read_exact_at(&mut block, begin).ok()?;
    let last = block.iter().rposition(|byte| *byte != 0).map_or(0, |at| at.saturating_add(1));
    Some(begin.saturating_sub(data_start).saturating_add(u64::try_from(last).ok()?))
}

fn read_head(file: &SourceFile) -> std::io::Result<Vec<u8>> {
    let size = file.len();
    let mut head = vec![0; usize::try_from(size.min(SAMPLE)).unwrap_or(0)];
    file.read_exact_at(&mut head, 0)?;
    let Some(stated) = head.first_chunk().map(|b| u64::from_le_bytes(*b)) else { return Ok(head) };
    let end = stated.saturating_add(8);
    if stated > MAX_HEADER || end > size {
        return Ok(head);
    }
    let read = head.len();
    grown(&mut head, usize::try_from(end).unwrap_or(usize::MAX))?;
    if let Some(rest) = head.get_mut(read..) {
        file.read_exact_at(rest, u64::try_from(read).unwrap_or(u64::MAX))?;
    }
    Ok(head)
}

/// Adds the format of the bytes behind the last tensor, if recognised.
fn name_trailing_bytes(shard: &mut Shard, file: &SourceFile) {
    for fault in shard.faults.iter_mut().filter(|f| f.kind == FaultKind::TrailingBytes) {
        let Some(count) = fault.detail.get("count").and_then(serde_json::Value::as_u64) else { continue };
        let mut bytes = vec![0; usize::try_from(count.min(512)).unwrap_or(0)];
        if file.read_exact_at(&mut bytes, file.len().saturating_sub(count)).is_err() {
            continue;
        }
        let what = looks_like(&bytes).or_else(|| bytes.iter().all(|b| *b == 0).then_some("NUL bytes"));
        if let Some(what) = what {
            fault.detail.insert("looks_like".to_owned(), what.into());
        }
    }
}
