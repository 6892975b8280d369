//! Edits of the header of a shard, in place: its tensors are not copied.
//!
//! The new header ends where the old one did, or a whole number of blocks later. Then the file system inserts these blocks
//! before the file (`FALLOC_FL_INSERT_RANGE` of fallocate(2); ext4 and XFS have it). An insertion moves extent by extent, so
//! a power failure can leave a hole anywhere in the file; a file with holes of its own is therefore never edited this way.
//!
//! The folder of originals contains both headers before the shard is touched, so every state that a kill or a power failure
//! leaves can be recognised by its bytes and turned back into the original.

use std::fs::{File, Metadata, OpenOptions};
use std::io::{self, Seek as _, SeekFrom, Write as _};
use std::os::unix::fs::{FileExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::Path;
use std::time::{Duration, SystemTime};

use rustix::fs::OFlags;

use super::record::HeaderEdit;
use crate::checkpoint::open::{Identity, open_regular};
use crate::checkpoint::shard::MAX_HEADER;
use crate::surgery::align::BLOCK;
use crate::surgery::plan::{PlannedShard, TensorTransform};
use crate::surgery::writers::system::{collapse_range, custom, first_hole, insert_range, remove_file, retry};
use crate::surgery::writers::verify::accepted_by_safetensors;

/// The headers of a shard before and after an edit, from the length prefix to the last space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Headers {
    old: Vec<u8>,
    new: Vec<u8>,
    /// Number of bytes of the file before the edit.
    file_len: u64,
}

/// What the bytes of a shard show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum State {
    /// The old header.
    Old,
    /// The new header.
    New,
    /// Room for the new header, and parts of both headers in its place.
    Torn,
    /// The old header, and a hole at this offset, up to which an insertion or a removal of blocks came.
    Hole(u64),
    /// None of these: another program has changed the file.
    Other,
}

impl Headers {
    /// The headers of the edit that turns the shard at `path` into `plan`; `None` when it must be written as a new file: its
    /// tensors move, other names lead to the file, or it cannot be written to.
    ///
    /// `data_start` is the offset of the first tensor in the file.
    pub(super) fn of(plan: &PlannedShard, path: &Path, data_start: u64) -> Option<Self> {
        let file = open(path).ok()?;
        let metadata = file.metadata().ok().filter(|m| m.is_file() && m.nlink() == 1)?;
        let mut at = data_start;
        for tensor in &plan.tensors {
            let from = &tensor.source.from;
            if tensor.transform() != TensorTransform::Copy || from.path != path || from.offset != at {
                return None;
            }
            at = at.checked_add(from.len)?;
        }
        if at != metadata.len() {
            return None;
        }
        let mut old = vec![0; usize::try_from(data_start).ok()?];
        file.read_exact_at(&mut old, 0).ok()?;
        let headers = Self { old, new: plan.header(), file_len: metadata.len() };
        let is_in_place = match headers.inserted()? {
            0 => true,
            inserted => inserted.is_multiple_of(BLOCK) && first_hole(&file).ok()?.is_none(),
        };
        is_in_place.then_some(headers)
    }

    /// Writes both headers as one new file, and syncs it.
    pub(super) fn write(&self, path: &Path) -> io::Result<()> {
        let mut file = retry(|| OpenOptions::new().write(true).create_new(true).open(path))?;
        file.write_all(&self.old)?;
        file.write_all(&self.new)?;
        file.sync_all()
    }

    /// The headers that [`Self::write`] wrote for an edit of a file of `file_len` bytes; `None` when they are others, or too
    /// large for any header.
    pub(super) fn read(path: &Path, edit: &HeaderEdit, file_len: u64) -> io::Result<Option<Self>> {
        let len = edit.kept_len();
        if edit.new_len < edit.old_len || len > MAX_HEADER.saturating_add(8).saturating_mul(2) {
            return Ok(None);
        }
        let mut old = open_regular(path, len).and_then(|opened| opened.read_all(path)).map_err(io::Error::other)?;
        let at = usize::try_from(edit.old_len).unwrap_or(usize::MAX);
        let new = if old.len() as u64 == len { old.split_off(at) } else { return Ok(None) };
        Ok(Some(Self { old, new, file_len }))
    }

    /// The record in the journal.
    pub(super) fn record(&self, inode: u64) -> HeaderEdit {
        HeaderEdit { old_len: self.old.len() as u64, new_len: self.new.len() as u64, inode }
    }

    /// The header after the edit.
    pub(super) fn new_header(&self) -> &[u8] {
        &self.new
    }

    /// Number of bytes of the file after the edit.
    pub(super) fn new_file_len(&self) -> u64 {
        self.file_len.saturating_add(self.inserted().unwrap_or_default())
    }

    /// Number of bytes that the edit writes or inserts.
    pub(super) fn bytes(&self) -> u64 {
        let both = (self.old.len() as u64).saturating_add(self.new.len() as u64);
        both.saturating_add(self.inserted().unwrap_or_default())
    }

    /// Number of bytes that the new header has more.
    fn inserted(&self) -> Option<u64> {
        (self.new.len() as u64).checked_sub(self.old.len() as u64)
    }

    /// What the file at `path` contains, with its identity.
    pub(super) fn state(&self, path: &Path) -> io::Result<(State, Identity)> {
        let opened = open_regular(path, u64::MAX).map_err(io::Error::other)?;
        Ok((self.state_of(&opened.file, opened.identity.size)?, opened.identity))
    }

    fn state_of(&self, file: &File, len: u64) -> io::Result<State> {
        let inserted = self.inserted().unwrap_or_default();
        let shift = usize::try_from(inserted).unwrap_or(usize::MAX);
        if len == self.file_len && read(file, self.old.len(), None)? == self.old {
            return Ok(State::Old);
        }
        if len != self.new_file_len() {
            return Ok(State::Other);
        }
        let head = read(file, self.new.len(), None)?;
        if head == self.new {
            return Ok(State::New);
        }
        // Where the new header is not yet written: zeros in the inserted blocks, then the old header.
        let before = std::iter::repeat_n(&0, shift).chain(&self.old);
        if head.iter().zip(&self.new).zip(before).all(|((is, new), old)| is == new || is == old) {
            return Ok(State::Torn);
        }
        match first_hole(file)? {
            Some(hole) if inserted > 0 && hole.end.saturating_sub(hole.start) == inserted => {
                let is_old = read(file, self.old.len(), Some((hole.start, inserted)))? == self.old;
                Ok(if is_old { State::Hole(hole.start) } else { State::Other })
            }
            _ => Ok(State::Other),
        }
    }

    /// Makes the edit in the file at `path`, if `is_expected` says so of its metadata and it has the old header; syncs it, and
    /// reads the new header with the safetensors crate. `None` when the file is another one, `false` when the file system
    /// cannot insert blocks; then nothing has changed.
    pub(super) fn apply(&self, path: &Path, is_expected: impl FnOnce(&Metadata) -> bool) -> io::Result<Option<bool>> {
        let file = open(path)?;
        let metadata = file.metadata()?;
        if !is_expected(&metadata) || self.state_of(&file, metadata.len())? != State::Old {
            return Ok(None);
        }
        let inserted = self.inserted().unwrap_or_default();
        if inserted > 0 {
            if !insert_range(&file, 0, inserted)? {
                return Ok(Some(false));
            }
            // The header goes to blocks of the old one: these must not reach the disk before the insertion does.
            file.sync_all()?;
        }
        file.write_all_at(&self.new, 0)?;
        file.sync_all()?;
        accepted_by_safetensors(&file)?;
        Ok(Some(true))
    }

    /// Restores the old header of the file at `path`, and the time of its last change. `false` when [`Self::copy`] must make the
    /// original: other names lead to the file, or the checkpoint was copied to a file system that cannot remove blocks.
    ///
    /// # Errors
    /// Also when the state is [`State::Other`].
    pub(super) fn restore(&self, path: &Path, mtime: (i64, i64)) -> io::Result<bool> {
        let file = open(path)?;
        let inserted = self.inserted().unwrap_or_default();
        let metadata = file.metadata()?;
        let hole = match self.state_of(&file, metadata.len())? {
            State::Old => return Ok(true),
            State::Other => return Err(io::Error::other("another program has changed it")),
            State::Hole(at) => at,
            State::New | State::Torn if metadata.nlink() > 1 => return Ok(false),
            State::New | State::Torn => {
                // Behind the inserted blocks, so that their removal leaves the old header whole or with a hole.
                file.write_all_at(&self.old, inserted)?;
                file.sync_all()?;
                0
            }
        };
        if inserted > 0 && !collapse_range(&file, hole, inserted)? {
            // A hole elsewhere was left by a file system that can remove it.
            return if hole == 0 { Ok(false) } else { Err(io::ErrorKind::Unsupported.into()) };
        }
        set_mtime(&file, mtime)?;
        file.sync_all()?;
        Ok(true)
    }

    /// Writes the original of the edited file at `path` to `copy`, with the time of its last change.
    pub(super) fn copy(&self, path: &Path, copy: &Path, mtime: (i64, i64)) -> io::Result<()> {
        remove_file(copy)?;
        let mut from = open(path)?;
        from.seek(SeekFrom::Start(self.new.len() as u64))?;
        let mut file = retry(|| OpenOptions::new().write(true).create_new(true).open(copy))?;
        file.write_all(&self.old)?;
        io::copy(&mut from, &mut file)?;
        set_mtime(&file, mtime)
    }
}

/// Opens a shard for reading and writing.
fn open(path: &Path) -> io::Result<File> {
    let flags = custom(OFlags::NOFOLLOW | OFlags::NONBLOCK);
    retry(|| OpenOptions::new().read(true).write(true).custom_flags(flags).open(path))
}

/// The first `len` bytes of a file, without the range `skipped`: offset and length.
fn read(file: &File, len: usize, skipped: Option<(u64, u64)>) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; len];
    let (hole, gap) = skipped.unwrap_or((u64::MAX, 0));
    let (head, tail) = bytes.split_at_mut(usize::try_from(hole).unwrap_or(usize::MAX).min(len));
    file.read_exact_at(head, 0)?;
    file.read_exact_at(tail, (head.len() as u64).saturating_add(gap))?;
    Ok(bytes)
}

/// Sets the time of the last change: seconds and nanoseconds since 1970.
fn set_mtime(file: &File, (seconds, nanoseconds): (i64, i64)) -> io::Result<()> {
    let whole = Duration::from_secs(seconds.unsigned_abs());
    let part = Duration::from_nanos(nanoseconds.unsigned_abs());
    let epoch = SystemTime::UNIX_EPOCH;
    let start = if seconds < 0 { epoch.checked_sub(whole) } else { epoch.checked_add(whole) };
    match start.and_then(|start| start.checked_add(part)) {
        Some(time) => file.set_modified(time),
        None => Ok(()),
    }
}
