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
use sha2::{Digest as _, Sha256};

use crate::checkpoint::hex;
use crate::checkpoint::journal::HeaderEdit;
use crate::checkpoint::open::{Identity, open_regular};
use crate::checkpoint::reserve::reserved;
use crate::checkpoint::shard::MAX_HEADER;
use crate::surgery::align::BLOCK;
use crate::surgery::plan::PlannedShard;
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
            let from = tensor.copied().filter(|from| from.path == path && from.offset == at)?;
            at = at.checked_add(from.len)?;
        }
        if at != metadata.len() {
            return None;
        }
        let mut old = reserved(usize::try_from(data_start).ok()?).ok()?;
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
        if edit.sha256.as_ref().is_some_and(|sha256| *sha256 != hex(&Sha256::digest(&old))) {
            return Ok(None);
        }
        let at = usize::try_from(edit.old_len).unwrap_or(usize::MAX);
        let new = if old.len() as u64 == len { old.split_off(at) } else { return Ok(None) };
        Ok(Some(Self { old, new, file_len }))
    }

    /// The record in the journal.
    pub(super) fn record(&self, inode: u64) -> HeaderEdit {
        let sha256 = Sha256::new().chain_update(&self.old).chain_update(&self.new).finalize();
        let (old_len, new_len) = (self.old.len() as u64, self.new.len() as u64);
        HeaderEdit { old_len, new_len, inode, sha256: Some(hex(&sha256)) }
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
    let mut bytes: Vec<u8> = reserved(len)?;
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

#[cfg(test)]
#[allow(clippy::disallowed_methods, clippy::arithmetic_side_effects, reason = "makes the files it reads")]
mod tests {
    use std::collections::BTreeMap;
    use std::fs;
    use std::path::PathBuf;

    use super::*;
    use crate::checkpoint::{Dtype, FileName};
    use crate::surgery::plan::format_pt;
    use crate::surgery::planned_tensor::PlannedTensor;
    use crate::surgery::tensor_ref::TensorRef;

    /// Number of bytes of the tensor: several blocks and a part of one.
    const LEN: usize = 5 * 4096 + 5;
    const MTIME: (i64, i64) = (1_000_000_000, 7);

    /// The plan of a shard at `path` with one tensor from `data_start` on.
    fn plan(path: &Path, data_start: u64, metadata: BTreeMap<String, String>) -> PlannedShard {
        let from = TensorRef {
            donor: String::new(),
            path: path.to_owned(),
            name: "a".to_owned(),
            dtype: Dtype::U8,
            shape: vec![LEN as u64],
            offset: data_start,
            len: LEN as u64,
            slice: None,
        };
        let tensor = PlannedTensor::copy("a".to_owned(), from);
        let name = FileName::parse("model.safetensors").unwrap();
        PlannedShard { name, tensors: vec![tensor], metadata, data_start: Some(data_start) }
    }

    /// A shard without metadata in its header, which has at least `room` spaces; and its header.
    fn shard(dir: &Path, room: usize) -> (PathBuf, Vec<u8>) {
        let path = dir.join("model.safetensors");
        let text = format!(r#"{{"a":{{"dtype":"U8","shape":[{LEN}],"data_offsets":[0,{LEN}]}}}}"#);
        let len = (text.len() + room).next_multiple_of(8);
        let mut header = (len as u64).to_le_bytes().to_vec();
        header.extend(format!("{text:len$}").bytes());
        fs::write(&path, [&header[..], &data()].concat()).unwrap();
        set_mtime(&open(&path).unwrap(), MTIME).unwrap();
        (path, header)
    }

    fn data() -> Vec<u8> {
        (0..LEN).map(|i| u8::try_from(i * 31 % 251).unwrap() + 1).collect()
    }

    /// The headers of the edit that adds the metadata `pt`.
    fn headers(path: &Path, old: &[u8]) -> Headers {
        Headers::of(&plan(path, old.len() as u64, format_pt()), path, old.len() as u64).unwrap()
    }

    fn seen(path: &Path) -> (Vec<u8>, (i64, i64)) {
        (fs::read(path).unwrap(), Identity::from_metadata(&fs::metadata(path).unwrap()).mtime)
    }

    /// Whether the file system of the tests can insert blocks. The states are the same without, but for those with a hole.
    fn inserts(dir: &Path) -> bool {
        let path = dir.join("probe");
        fs::write(&path, [1; 8192]).unwrap();
        insert_range(&open(&path).unwrap(), 0, BLOCK).unwrap()
    }

    #[test]
    fn a_header_is_edited_and_restored() {
        for room in [64, 0] {
            let dir = tempfile::tempdir().unwrap();
            let (path, old) = shard(dir.path(), room);
            let (before, headers) = (seen(&path), headers(&path, &old));
            assert_eq!(headers.new.len() - old.len(), if room == 0 { 4096 } else { 0 });
            assert_eq!(headers.apply(&path, |_| false).unwrap(), None);
            assert_eq!(seen(&path), before);
            let edited = headers.apply(&path, |m| m.len() == before.0.len() as u64).unwrap();
            assert_eq!(edited, Some(room > 0 || inserts(dir.path())));
            if edited == Some(false) {
                assert_eq!(seen(&path), before);
                continue;
            }
            assert_eq!(seen(&path).0, [&headers.new[..], &data()].concat());
            assert_eq!(headers.state(&path).unwrap().0, State::New);
            assert_eq!(headers.apply(&path, |_| true).unwrap(), None);
            assert!(headers.restore(&path, MTIME).unwrap());
            assert_eq!(seen(&path), before);
        }
    }

    /// What a kill or a power failure leaves of an edit or of its removal.
    #[test]
    fn every_state_is_recognised_and_restored() {
        let dir = tempfile::tempdir().unwrap();
        let inserts = inserts(dir.path());
        for room in [64, 0] {
            let (path, old) = shard(dir.path(), room);
            let (before, headers) = (seen(&path), headers(&path, &old));
            let shift = headers.new.len() - old.len();
            let inserted = [&vec![0; shift][..], &old].concat();
            let part = |cut: usize| [&headers.new[..cut], &inserted[cut..]].concat();
            let rear = |cut: usize| [&inserted[..cut], &headers.new[cut..]].concat();
            let mut states = vec![(old.clone(), State::Old), (headers.new.clone(), State::New)];
            for cut in [1, 9, 20, 60] {
                // With the same length, the first bytes of both headers agree.
                let state = |bytes: Vec<u8>| match bytes {
                    _ if bytes == headers.new => State::New,
                    _ if bytes == old => State::Old,
                    _ => State::Torn,
                };
                states.extend([part(cut), rear(cut)].map(|bytes| (bytes.clone(), state(bytes))));
            }
            if shift > 0 {
                states.extend([(inserted.clone(), State::Torn), (part(4096), State::Torn)]);
            }
            for cut in [0, 12, 40] {
                let mut other = headers.new.clone();
                other[cut] ^= 0x80;
                states.push((other, State::Other));
            }
            states.push(([&headers.new[..], b"more"].concat(), State::Other));
            for (head, want) in states {
                fs::write(&path, [&head[..], &data()].concat()).unwrap();
                assert_eq!(headers.state(&path).unwrap().0, want);
                let now = seen(&path);
                match headers.restore(&path, MTIME) {
                    Err(_) if want == State::Other => assert_eq!(seen(&path), now),
                    Ok(true) => assert_eq!(seen(&path).0, before.0),
                    Ok(false) => {
                        assert!(shift > 0 && !inserts);
                        let copy = dir.path().join("copy");
                        headers.copy(&path, &copy, MTIME).unwrap();
                        assert_eq!(seen(&copy), before);
                    }
                    other => panic!("{want:?}: {other:?}"),
                }
            }
        }
    }

    /// An insertion or a removal that a power failure has stopped, with all extents from an offset on moved.
    #[test]
    fn a_hole_of_an_insertion_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let inserts = inserts(dir.path());
        let (path, old) = shard(dir.path(), 0);
        let (before, headers) = (seen(&path), headers(&path, &old));
        for hole in [4096, 8192, 5 * 4096] {
            for (len, is_ours) in [(4096, true), (8192, false)] {
                fs::remove_file(&path).unwrap();
                let file = File::create(&path).unwrap();
                file.write_all_at(&before.0[..hole], 0).unwrap();
                let moved = if is_ours { hole } else { hole + 4096 };
                if let Some(rest) = before.0.get(moved..) {
                    file.write_all_at(rest, (hole + len) as u64).unwrap();
                }
                file.set_len(headers.new_file_len()).unwrap();
                let state = headers.state(&path).unwrap().0;
                if !is_ours {
                    assert_eq!(state, State::Other);
                    continue;
                }
                assert_eq!(state, State::Hole(hole as u64));
                match headers.restore(&path, MTIME) {
                    Ok(is_done) => assert!(is_done && inserts),
                    Err(error) => {
                        assert!(!inserts && error.kind() == io::ErrorKind::Unsupported);
                        continue;
                    }
                }
                assert_eq!(seen(&path), before);
            }
        }
    }

    /// Also when the file got the name after the edit: the other name keeps the edited file.
    #[test]
    fn a_file_with_two_names_is_copied() {
        let dir = tempfile::tempdir().unwrap();
        let (path, old) = shard(dir.path(), 64);
        let (before, headers) = (seen(&path), headers(&path, &old));
        assert_eq!(headers.apply(&path, |_| true).unwrap(), Some(true));
        let (linked, copy) = (dir.path().join("linked"), dir.path().join("copy"));
        fs::hard_link(&path, &linked).unwrap();
        let after = seen(&linked);
        assert!(!headers.restore(&path, MTIME).unwrap());
        headers.copy(&path, &copy, MTIME).unwrap();
        assert_eq!((seen(&copy), seen(&linked)), (before, after));
        fs::remove_file(&path).unwrap();
        fs::rename(&copy, &path).unwrap();
        fs::remove_file(&linked).unwrap();
        fs::hard_link(&path, &linked).unwrap();
        assert_eq!(Headers::of(&plan(&path, old.len() as u64, format_pt()), &path, old.len() as u64), None);
    }

    #[test]
    fn a_shard_is_written_anew_where_its_tensors_move() {
        let dir = tempfile::tempdir().unwrap();
        let (path, old) = shard(dir.path(), 0);
        let start = old.len() as u64;
        let of = |plan: &PlannedShard| Headers::of(plan, &path, start).is_some();
        let good = plan(&path, start, format_pt());
        assert!(of(&good));
        assert!(!of(&PlannedShard { data_start: None, ..good.clone() }), "another place in the block");
        assert!(!of(&plan(&path, start + 8, format_pt())), "a gap");
        assert!(!of(&plan(&dir.path().join("other"), start, format_pt())), "of another file");
        let mut converted = good.clone();
        converted.tensors[0] = converted.tensors[0].clone().started();
        assert!(!of(&converted));
        OpenOptions::new().append(true).open(&path).unwrap().write_all(b"more").unwrap();
        assert!(!of(&good), "bytes behind the tensors");
        for (room, is_edited) in [(0, false), (64, true)] {
            let (_, old) = shard(dir.path(), room);
            let (start, file) = (old.len() as u64, open(&path).unwrap());
            file.set_len(start).unwrap();
            file.set_len(start + LEN as u64).unwrap();
            // With a hole of its own, the file must not get blocks.
            let plan = plan(&path, start, format_pt());
            assert_eq!(Headers::of(&plan, &path, start).is_some(), is_edited);
        }
    }

    #[test]
    fn headers_of_another_size_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let (path, old) = shard(dir.path(), 0);
        let (headers, kept) = (headers(&path, &old), dir.path().join("kept"));
        headers.write(&kept).unwrap();
        let (edit, len) = (headers.record(1), headers.file_len);
        assert_eq!(Headers::read(&kept, &edit, len).unwrap(), Some(headers));
        for (old_len, new_len) in [(edit.new_len, edit.old_len), (edit.old_len, edit.new_len + 1), (0, u64::MAX)] {
            assert_eq!(Headers::read(&kept, &HeaderEdit { old_len, new_len, ..edit.clone() }, len).unwrap(), None);
        }
        assert!(Headers::read(&kept, &HeaderEdit { old_len: 1, new_len: 2, ..edit }, len).is_err(), "a larger file");
    }
}
