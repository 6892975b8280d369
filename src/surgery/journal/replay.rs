//! The steps of a journal. Each step may already be done, because a run can be killed after any of them.
#![expect(clippy::disallowed_methods, reason = "surgery is where checkpoints are written")]

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags, renameat_with};
use sha2::{Digest, Sha256};

use super::folder::{Folder, remove_file, remove_tree};
use super::record::{Journal, JournaledFile, NewFile, OldFile};
use crate::checkpoint::hex;
use crate::checkpoint::open::open_regular;
use crate::surgery::error::{RepairError, io_at};
use crate::surgery::system::{look, retry, sync_dir};

/// A journal and its folder.
pub(super) struct Replay<'a> {
    folder: &'a Folder,
    journal: &'a Journal,
}

impl<'a> Replay<'a> {
    pub(super) const fn new(folder: &'a Folder, journal: &'a Journal) -> Self {
        Self { folder, journal }
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

    /// Whether all files needed to finish the repair are present and unchanged.
    pub(super) fn can_finish(&self) -> Result<bool, RepairError> {
        for entry in &self.journal.files {
            let target = self.target(entry);
            let ready = if look(&self.staged(entry))?.is_some() {
                let untouched = match (look(&target)?, &entry.old) {
                    (Some(is), Some(was)) => OldFile::from_metadata(&is) == *was,
                    (None, Some(_)) => look(&self.original(entry))?.is_some(),
                    (there, None) => there.is_none(),
                };
                untouched && entry.new.matches(&self.staged(entry))?
            } else {
                entry.new.matches(&target)?
            };
            if !ready {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Links the originals, moves the new files into place, and archives the journal.
    pub(super) fn finish(&self) -> Result<(), RepairError> {
        self.folder.folder(&self.originals())?;
        for entry in &self.journal.files {
            let (target, original) = (self.target(entry), self.original(entry));
            if entry.old.is_some() && look(&self.staged(entry))?.is_some() && look(&original)?.is_none() {
                keep(&target, &original).map_err(io_at(&target, "linking the original"))?;
            }
        }
        // The originals must be durable before they are replaced.
        sync_dir(&self.originals())?;
        sync_dir(&self.folder.root)?;
        for entry in &self.journal.files {
            let (staged, target) = (self.staged(entry), self.target(entry));
            if look(&staged)?.is_none() {
                continue;
            }
            let put = match entry.old {
                Some(_) => retry(|| fs::rename(&staged, &target)),
                None => rename_new(&staged, &target),
            };
            put.map_err(io_at(&target, "replacing"))?;
        }
        sync_dir(&self.folder.root)?;
        let (journal, done) = (self.folder.journal(), self.folder.done(self.journal.number));
        retry(|| fs::rename(&journal, &done)).map_err(io_at(&done, "publishing"))?;
        done.parent().map_or(Ok(()), sync_dir)?;
        journal.parent().map_or(Ok(()), sync_dir)?;
        remove_tree(&self.folder.staged())
    }

    /// Restores the originals that a repair has replaced, and removes its files.
    pub(super) fn roll_back(&self) -> Result<(), RepairError> {
        let mut back = Vec::new();
        for entry in &self.journal.files {
            let (target, original) = (self.target(entry), self.original(entry));
            match (look(&original)?, look(&target)?) {
                (Some(kept), Some(there)) if (kept.dev(), kept.ino()) == (there.dev(), there.ino()) => {}
                (Some(_), None) => back.push(entry),
                (Some(_) | None, Some(_)) if self.is_new(entry)? => back.push(entry),
                (Some(_), Some(_)) => {
                    return Err(RepairError::ChangedSinceRepair { path: target, originals: self.originals() });
                }
                (None, _) => {}
            }
        }
        for entry in back {
            let (target, original) = (self.target(entry), self.original(entry));
            if entry.old.is_some() {
                retry(|| fs::rename(&original, &target)).map_err(io_at(&target, "restoring"))?;
            } else {
                remove_file(&target)?;
            }
        }
        sync_dir(&self.folder.root)?;
        self.forget()
    }

    /// Whether the target is the repair's new file.
    fn is_new(&self, entry: &JournaledFile) -> Result<bool, RepairError> {
        let published = look(&self.staged(entry))?.is_none();
        Ok(published && entry.new.matches(&self.target(entry))?)
    }

    /// The first file that changed after the repair, or whose original is missing.
    pub(super) fn changed(&self) -> Result<Option<PathBuf>, RepairError> {
        for entry in &self.journal.files {
            let kept = look(&self.original(entry))?.map(|m| m.len());
            if !entry.new.matches(&self.target(entry))? {
                return Ok(Some(self.target(entry)));
            }
            if kept != entry.old.as_ref().map(|old| old.len) {
                return Ok(Some(self.original(entry)));
            }
        }
        Ok(None)
    }

    /// Undoes a finished repair; files that are already restored are skipped.
    pub(super) fn restore(&self) -> Result<(), RepairError> {
        for entry in &self.journal.files {
            let (target, original) = (self.target(entry), self.original(entry));
            if entry.old.is_none() {
                if entry.new.matches(&target)? {
                    remove_file(&target)?;
                }
            } else if look(&original)?.is_some() {
                retry(|| fs::rename(&original, &target)).map_err(io_at(&target, "restoring"))?;
            }
        }
        sync_dir(&self.folder.root)?;
        self.forget()
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

/// Links a file under a second name, so that the first always exists; moves it if links are not supported.
fn keep(target: &Path, original: &Path) -> io::Result<()> {
    retry(|| fs::hard_link(target, original)).or_else(|e| match e.kind() {
        io::ErrorKind::PermissionDenied | io::ErrorKind::Unsupported | io::ErrorKind::TooManyLinks => {
            retry(|| fs::rename(target, original))
        }
        _ => Err(e),
    })
}

/// Renames a file; fails if the new name exists.
fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    match rustix::io::retry_on_intr(|| renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE)) {
        // Some file systems do not support the flag.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) if fs::symlink_metadata(to).is_err() => {
            retry(|| fs::rename(from, to))
        }
        other => other.map_err(io::Error::from),
    }
}

impl OldFile {
    pub(super) fn from_metadata(metadata: &Metadata) -> Self {
        Self { len: metadata.len(), mtime: (metadata.mtime(), metadata.mtime_nsec()), mode: metadata.mode() & 0o7777 }
    }
}

impl NewFile {
    /// Hashes a file.
    pub(super) fn hash(path: &Path) -> Result<Self, RepairError> {
        let opened = open_regular(path, u64::MAX).map_err(|e| io_at(path, "reading")(io::Error::other(e)))?;
        let mut hasher = Hasher(Sha256::new());
        let len = io::copy(&mut &opened.file, &mut hasher).map_err(io_at(path, "reading"))?;
        Ok(Self { len, sha256: hex(&hasher.0.finalize()) })
    }

    /// Whether the file at `path` has this hash and size.
    fn matches(&self, path: &Path) -> Result<bool, RepairError> {
        let is_file = look(path)?.is_some_and(|m| m.is_file() && m.len() == self.len);
        Ok(is_file && Self::hash(path)? == *self)
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
