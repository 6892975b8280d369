//! The steps of a journal. Each step may already be done, because a run can be killed after any of them.
#![expect(clippy::disallowed_methods, reason = "surgery is where checkpoints are written")]

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::exchange::{Taken, exchange, keep, rename_new, take_away};
use super::folder::{Folder, remove_file, remove_tree};
use super::header::{Headers, State};
use super::owner::copy_owner_and_mode;
use crate::checkpoint::hex;
use crate::checkpoint::journal::{HeaderEdit, InodeIdentity, Journal, JournaledFile, NewFile, OldFile};
use crate::checkpoint::open::{Identity, open_regular};
use crate::surgery::error::{RepairError, io_at};
use crate::surgery::leftover::Leftover;
use crate::surgery::outcome::FileChange;
use crate::surgery::writers::system::{look, remove_folder, retry, sync_dir};

/// What the staging folder holds under the name of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Staged {
    /// Nothing: the new file was moved into place.
    Missing,
    /// The new file.
    New,
    /// The original, exchanged for the new file.
    Original,
    /// A file that another program saved between the link to the original and the exchange.
    Other,
}

/// A step that restores a file.
enum StepBack {
    /// Exchange the original for the new file, of this identity.
    Exchange(Identity),
    /// Take away the new file, of this identity, which the repair had added.
    TakeAway(Identity),
    /// Move the original back: links are not supported.
    MoveBack,
    /// Return a file of another program from the staging folder.
    Displaced,
    /// Restore the header of a shard.
    Header(Headers),
}

impl StepBack {
    /// What it does to the file.
    const fn change(&self) -> FileChange {
        match self {
            Self::Exchange(_) | Self::MoveBack | Self::Header(_) => FileChange::Restored,
            Self::TakeAway(_) => FileChange::Removed,
            Self::Displaced => FileChange::Returned,
        }
    }
}

/// A journal and its folder.
pub(super) struct Replay<'a> {
    folder: &'a Folder,
    journal: &'a Journal,
    /// Whether files in the folder that the journal does not account for are put into place too: another program may have saved
    /// them, or somebody else may have put them there.
    adopts: bool,
}

impl<'a> Replay<'a> {
    pub(super) const fn new(folder: &'a Folder, journal: &'a Journal, adopts: bool) -> Self {
        Self { folder, journal, adopts }
    }

    /// What the repair does to each file.
    pub(super) fn files(&self) -> Vec<(FileChange, String)> {
        let change = |entry: &JournaledFile| match (&entry.header, &entry.old) {
            (Some(_), _) => FileChange::Edited,
            (None, Some(_)) => FileChange::Replaced,
            (None, None) => FileChange::Added,
        };
        self.journal.files.iter().map(|entry| (change(entry), entry.name.clone())).collect()
    }

    fn target(&self, entry: &JournaledFile) -> PathBuf {
        self.folder.root.join(&entry.name)
    }

    fn staged(&self, entry: &JournaledFile) -> PathBuf {
        self.folder.staged().join(&entry.name)
    }

    fn originals(&self) -> PathBuf {
        self.folder.originals(self.journal.number)
    }

    fn original(&self, entry: &JournaledFile) -> PathBuf {
        self.originals().join(&entry.name)
    }

    /// What the staging folder holds under the name of this file.
    fn staged_file(&self, entry: &JournaledFile) -> Result<Staged, RepairError> {
        let staged = self.staged(entry);
        Ok(match (look(&staged)?, look(&self.original(entry))?) {
            (None, _) => Staged::Missing,
            (Some(there), Some(kept)) if is_same(&there, &kept) => Staged::Original,
            _ if entry.new.identity(&staged)?.is_some() => Staged::New,
            _ => Staged::Other,
        })
    }

    /// The headers of an edit in place; `None` when they are already removed.
    fn headers(&self, entry: &JournaledFile, edit: &HeaderEdit) -> Result<Option<Headers>, RepairError> {
        let kept = self.original(entry);
        if look(&kept)?.is_none() {
            return Ok(None);
        }
        let file_len = entry.old.as_ref().map_or(0, |old| old.len);
        let unusable = || RepairError::UnusableJournal {
            path: kept.clone(),
            reason: "it does not contain the two headers that the journal lists".to_owned(),
        };
        let headers = Headers::read(&kept, edit, file_len).map_err(io_at(&kept, "reading"))?;
        headers.ok_or_else(unusable).map(Some)
    }

    /// What a shard contains whose header is edited in place, and its inode; `None` when it is missing or no regular file.
    fn header_state(&self, entry: &JournaledFile, headers: &Headers) -> Result<Option<(State, u64)>, RepairError> {
        let target = self.target(entry);
        if !look(&target)?.is_some_and(|m| m.is_file()) {
            return Ok(None);
        }
        let (state, identity) = headers.state(&target).map_err(io_at(&target, "reading"))?;
        Ok(Some((state, identity.ino)))
    }

    /// Whether the shard of an entry has the new header.
    fn has_new_header(&self, entry: &JournaledFile, edit: &HeaderEdit) -> Result<bool, RepairError> {
        let Some(headers) = self.headers(entry, edit)? else { return Ok(false) };
        Ok(self.header_state(entry, &headers)?.is_some_and(|(state, _)| state == State::New))
    }

    /// Edits the headers of shards in place; called after the journal was written. `false` when the file system cannot do it:
    /// then nothing has changed but shards that were already edited.
    pub(super) fn edit_headers(&self) -> Result<bool, RepairError> {
        for entry in &self.journal.files {
            let Some(edit) = &entry.header else { continue };
            let Some(headers) = self.headers(entry, edit)? else { continue };
            let target = self.target(entry);
            let is_expected = |m: &Metadata| entry.old.as_ref().is_some_and(|old| old.is(m)) && m.ino() == edit.inode;
            match headers.apply(&target, is_expected).map_err(io_at(&target, "editing the header"))? {
                // Another program may have given the name to another file meanwhile.
                Some(true) if self.has_new_header(entry, edit)? => {}
                Some(false) => return Ok(false),
                _ => return Err(RepairError::ChangedWhileRepaired { path: target }),
            }
        }
        Ok(true)
    }

    /// Whether all files needed to finish the repair are present and unchanged.
    pub(super) fn can_finish(&self) -> Result<bool, RepairError> {
        for entry in &self.journal.files {
            let target = self.target(entry);
            if let Some(edit) = &entry.header {
                if !self.has_new_header(entry, edit)? {
                    return Ok(false);
                }
                continue;
            }
            let ready = match self.staged_file(entry)? {
                Staged::New => match (look(&target)?, &entry.old) {
                    (Some(is), Some(was)) => was.is(&is),
                    (None, Some(_)) => look(&self.original(entry))?.is_some(),
                    (there, None) => there.is_none(),
                },
                Staged::Missing | Staged::Original => entry.new.identity(&target)?.is_some(),
                Staged::Other => false,
            };
            if !ready {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Links the originals, moves the new files into place, and archives the journal; headers are already edited. Returns the
    /// staging folder if it could not be removed.
    pub(super) fn finish(&self) -> Result<Option<Leftover>, RepairError> {
        self.folder.folder(&self.originals())?;
        let staged: Vec<_> = self.journal.files.iter().filter(|entry| self.is_staged(entry)).collect();
        for entry in &staged {
            let (target, original) = (self.target(entry), self.original(entry));
            if entry.old.is_some() && look(&original)?.is_none() {
                keep(&target, &original).map_err(io_at(&target, "linking the original"))?;
            }
        }
        // The originals must be durable before they are replaced.
        sync_dir(&self.originals())?;
        sync_dir(&self.folder.root)?;
        for entry in staged {
            self.publish(entry)?;
        }
        sync_dir(&self.folder.root)?;
        let (journal, done) = (self.folder.journal(), self.folder.done(self.journal.number));
        retry(|| fs::rename(&journal, &done)).map_err(io_at(&done, "publishing"))?;
        done.parent().map_or(Ok(()), sync_dir)?;
        journal.parent().map_or(Ok(()), sync_dir)?;
        let staging = self.folder.staged();
        Ok(remove_folder(&staging).err().map(|why| Leftover { path: staging, why }))
    }

    /// Whether the new file is still in the staging folder, in a repair that can be finished.
    fn is_staged(&self, entry: &JournaledFile) -> bool {
        match (fs::symlink_metadata(self.staged(entry)), fs::symlink_metadata(self.original(entry))) {
            (Ok(there), Ok(kept)) => !is_same(&there, &kept),
            (there, _) => there.is_ok(),
        }
    }

    /// Moves a new file into place. The original stays in the staging folder, if the file system can exchange names.
    fn publish(&self, entry: &JournaledFile) -> Result<(), RepairError> {
        let (staged, target) = (self.staged(entry), self.target(entry));
        let taken = match (&entry.old, look(&self.original(entry))?) {
            // A missing target was moved to its original.
            (Some(old), Some(kept)) if look(&target)?.is_some() => exchange(
                &staged,
                &target,
                &Identity { size: old.len, mtime: old.mtime, ..Identity::from_metadata(&kept) },
            ),
            _ => rename_new(&staged, &target).map(|()| Taken::Expected),
        };
        match taken.map_err(io_at(&target, "replacing"))? {
            Taken::Expected => Ok(()),
            Taken::Changed => Err(RepairError::ChangedWhileRepaired { path: target }),
        }
    }

    /// Restores the originals that a repair has replaced, and removes its files. Files that another program has saved
    /// before they were replaced stay. Returns the files that were put back.
    ///
    /// `undo` calls this for a finished repair.
    pub(super) fn roll_back(&self) -> Result<Vec<(FileChange, String)>, RepairError> {
        let mut back = Vec::new();
        for entry in &self.journal.files {
            back.extend(self.step_back(entry)?.map(|step| (entry, step)));
        }
        let mut files = Vec::new();
        for (entry, step) in back {
            files.push((step.change(), entry.name.clone()));
            let (target, original) = (self.target(entry), self.original(entry));
            let taken = match step {
                StepBack::Exchange(new) => exchange(&original, &target, &new),
                StepBack::TakeAway(new) => take_away(&target, &original, &new),
                StepBack::MoveBack => rename_new(&original, &target).map(|()| Taken::Expected),
                StepBack::Displaced => retry(|| fs::rename(self.staged(entry), &target)).map(|()| Taken::Expected),
                StepBack::Header(headers) => {
                    self.restore_header(entry, &headers)?;
                    Ok(Taken::Expected)
                }
            };
            if taken.map_err(io_at(&target, "restoring"))? == Taken::Changed {
                return Err(self.changed_since(target));
            }
        }
        sync_dir(&self.folder.root)?;
        self.forget()?;
        Ok(files)
    }

    /// Restores the header of a shard, and the time of its last change.
    fn restore_header(&self, entry: &JournaledFile, headers: &Headers) -> Result<(), RepairError> {
        let (target, copy) = (self.target(entry), self.staged(entry));
        let mtime = entry.old.as_ref().map_or((0, 0), |old| old.mtime);
        if headers.restore(&target, mtime).map_err(io_at(&target, "restoring the header"))? {
            return Ok(());
        }
        self.folder.folder(&self.folder.staged())?;
        headers.copy(&target, &copy, mtime).map_err(io_at(&copy, "writing"))?;
        copy_owner_and_mode(&copy, &target, &fs::metadata(&target).map_err(io_at(&target, "reading metadata"))?)?;
        Ok(retry(|| fs::rename(&copy, &target)).map_err(io_at(&target, "restoring"))?)
    }

    /// The step that restores this file; `None` when it was never replaced, or is already restored.
    fn step_back(&self, entry: &JournaledFile) -> Result<Option<StepBack>, RepairError> {
        let (target, original) = (self.target(entry), self.original(entry));
        if let Some(edit) = &entry.header {
            let Some(headers) = self.headers(entry, edit)? else { return Ok(None) };
            return match self.header_state(entry, &headers)? {
                Some((State::Other, inode)) if inode == edit.inode => Err(self.changed_since(target)),
                None | Some((State::Old | State::Other, _)) => Ok(None),
                Some(_) => Ok(Some(StepBack::Header(headers))),
            };
        }
        let staged = self.staged_file(entry)?;
        let new = entry.new.identity(&target)?;
        let step = match (staged, look(&original)?, look(&target)?) {
            (Staged::Other, _, Some(_)) if new.is_some() => Some(StepBack::Displaced),
            (_, Some(_), None) if entry.new.identity(&original)?.is_some() => None,
            (_, Some(_), None) => Some(StepBack::MoveBack),
            (Staged::New, ..) | (_, None, None) => None,
            (_, Some(kept), Some(there)) if is_same(&kept, &there) => None,
            (_, Some(_), Some(_)) => match new {
                Some(new) => Some(StepBack::Exchange(new)),
                None if entry.new.identity(&original)?.is_some() => None,
                None => return Err(self.changed_since(target)),
            },
            (_, None, Some(_)) => match (new, &entry.old) {
                (Some(new), None) => Some(StepBack::TakeAway(new)),
                (Some(_), Some(_)) => return Err(self.changed_since(original)),
                (None, _) => None,
            },
        };
        match step {
            Some(StepBack::Displaced) if !self.adopts => Err(RepairError::Unaccounted { path: self.staged(entry) }),
            Some(StepBack::Exchange(_) | StepBack::MoveBack) if !self.is_original(entry)? => {
                Err(RepairError::Unaccounted { path: self.original(entry) })
            }
            step => Ok(step),
        }
    }

    /// Whether the kept original is the file that the journal recorded, and not one that somebody put there.
    fn is_original(&self, entry: &JournaledFile) -> Result<bool, RepairError> {
        let kept = look(&self.original(entry))?;
        let is_same = |old: &OldFile, kept: &Metadata| {
            old.is(kept) && old.identity.is_none_or(|was| InodeIdentity::from_metadata(kept).is(was))
        };
        let is_recorded = |old: &OldFile| kept.is_some_and(|kept| is_same(old, &kept));
        Ok(self.adopts || entry.old.as_ref().is_some_and(is_recorded))
    }

    fn changed_since(&self, path: PathBuf) -> RepairError {
        RepairError::ChangedSinceRepair { path, originals: self.originals() }
    }

    /// The first file that changed after the repair, or whose original is missing.
    pub(super) fn changed(&self) -> Result<Option<PathBuf>, RepairError> {
        for entry in &self.journal.files {
            let kept = look(&self.original(entry))?.map(|m| m.len());
            let expected = entry.header.as_ref().map(HeaderEdit::kept_len).or(entry.old.as_ref().map(|old| old.len));
            let is_recorded = entry.header.is_some() || entry.old.is_none() || self.is_original(entry)?;
            if kept != expected || !is_recorded {
                return Ok(Some(self.original(entry)));
            }
            let is_new = match &entry.header {
                Some(edit) => self.has_new_header(entry, edit)?,
                None => entry.new.identity(&self.target(entry))?.is_some(),
            };
            if !is_new {
                return Ok(Some(self.target(entry)));
            }
        }
        Ok(None)
    }

    /// Removes all files of a repair, the journal last.
    fn forget(&self) -> Result<(), RepairError> {
        remove_tree(&self.folder.staged())?;
        remove_file(&self.folder.done(self.journal.number))?;
        remove_tree(&self.originals())?;
        let journal = self.folder.journal();
        remove_file(&journal)?;
        Ok(journal.parent().map_or(Ok(()), sync_dir)?)
    }
}

/// Whether two names are those of one file.
fn is_same(a: &Metadata, b: &Metadata) -> bool {
    (a.dev(), a.ino()) == (b.dev(), b.ino())
}

impl OldFile {
    pub(super) fn from_metadata(metadata: &Metadata) -> Self {
        Self {
            len: metadata.len(),
            mtime: (metadata.mtime(), metadata.mtime_nsec()),
            mode: metadata.mode() & 0o7777,
            identity: Some(InodeIdentity::from_metadata(metadata)),
        }
    }

    /// Whether a file has the length, time and mode of this one. Its identity is another one in a copied directory.
    fn is(&self, metadata: &Metadata) -> bool {
        Self { identity: self.identity, ..Self::from_metadata(metadata) } == *self
    }
}

impl NewFile {
    /// The file after an edit of its header.
    pub(super) fn of_headers(headers: &Headers) -> Self {
        Self { len: headers.new_file_len(), sha256: hex(&Sha256::digest(headers.new_header())) }
    }

    /// Hashes a file.
    pub(super) fn hash(path: &Path) -> Result<Self, RepairError> {
        Ok(Self::hash_opened(path)?.0)
    }

    fn hash_opened(path: &Path) -> Result<(Self, Identity), RepairError> {
        let opened = open_regular(path, u64::MAX).map_err(|e| io_at(path, "reading")(io::Error::other(e)))?;
        let mut hasher = Hasher(Sha256::new());
        let len = io::copy(&mut &opened.file, &mut hasher).map_err(io_at(path, "reading"))?;
        Ok((Self { len, sha256: hex(&hasher.0.finalize()) }, opened.identity))
    }

    /// The identity of the file at `path`, if it has this hash and size.
    fn identity(&self, path: &Path) -> Result<Option<Identity>, RepairError> {
        if !look(path)?.is_some_and(|m| m.is_file() && m.len() == self.len) {
            return Ok(None);
        }
        let (is, identity) = Self::hash_opened(path)?;
        Ok((is == *self).then_some(identity))
    }
}

struct Hasher(Sha256);

impl io::Write for Hasher {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
