//! The locked folder `.ckpt-doctor` of a checkpoint.
#![expect(clippy::disallowed_methods, reason = "surgery is where checkpoints are written")]

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::key::key;
use crate::checkpoint::journal::{InodeIdentity, Journal, VERSION};
use crate::checkpoint::{REPAIR_FOLDER, REPAIR_JOURNAL};
use crate::surgery::error::{ApplyError, RepairError, io_at};
use crate::surgery::leftover::Leftover;
use crate::surgery::trust::Trust;
use crate::surgery::writers::lock::{self, Lock, LockFile};
use crate::surgery::writers::system::{self, create, look, retry, sync_dir, with_figures};

/// Excludes the folder from version control, as caches of other tools do.
const IGNORE: (&str, &str) = (".gitignore", "# created by ckpt-doctor for undoing repairs\n*\n");

/// Folder of staged files.
const NEW: &str = "new";

/// Folder of the originals and journals of finished repairs.
const UNDO: &str = "undo";

/// The journal while it is being written.
const DRAFT: &str = "journal.json.part";

/// The lock file; contains the process of the run.
const LOCK: &str = "lock";

/// What an ended run left in the folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Remains {
    /// Nothing: there is no folder, or it holds the originals of repairs.
    None,
    /// A folder without a repair that can be undone.
    Empty,
    /// A journal or staged files.
    Interrupted,
}

/// The folder; the lock is held while this value exists.
pub(super) struct Folder {
    pub(super) root: PathBuf,
    path: PathBuf,
    _lock: LockFile,
}

impl Folder {
    /// What an ended run left; decided without the lock.
    pub(super) fn remains(root: &Path) -> Result<Remains, RepairError> {
        let path = root.join(REPAIR_FOLDER);
        if look(&path)?.is_none_or(|m| !m.is_dir()) {
            return Ok(Remains::None);
        }
        only_folders(&path)?;
        if [REPAIR_JOURNAL, DRAFT, NEW].iter().any(|name| fs::symlink_metadata(path.join(name)).is_ok()) {
            return Ok(Remains::Interrupted);
        }
        let ours = |name: &String| [IGNORE.0, LOCK, UNDO].contains(&name.as_str());
        let is_empty = numbers(&path)?.is_empty() && names(&path)?.iter().all(ours);
        Ok(if is_empty { Remains::Empty } else { Remains::None })
    }

    /// Locks the folder of a checkpoint; `None` when the folder does not exist.
    pub(super) fn open(root: &Path) -> Result<Option<Self>, RepairError> {
        let path = root.join(REPAIR_FOLDER);
        only_folders(&path)?;
        match lock::take(&path.join(LOCK))? {
            // Without lock support, users must not run two repairs at once.
            Lock::Ours(mut lock) | Lock::Unknown(mut lock) => {
                // The signature is only for the message of other runs. Writing it may fail on a full disk, where `undo`
                // still works.
                let _ = lock::sign(&mut lock);
                Ok(Some(Self { root: root.to_owned(), path, _lock: lock }))
            }
            Lock::Theirs(holder) => Err(RepairError::Busy { path: root.to_owned(), holder }),
            Lock::Gone => Ok(None),
        }
    }

    /// Locks the folder of a checkpoint; creates it when missing.
    pub(super) fn create(root: &Path) -> Result<Self, RepairError> {
        let path = root.join(REPAIR_FOLDER);
        for _ in 0..8 {
            let made = retry(|| fs::create_dir(&path));
            let new = made.is_ok();
            match made {
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem) =>
                {
                    return Err(RepairError::ReadOnly { path: root.to_owned(), error });
                }
                Err(e) if e.kind() != io::ErrorKind::AlreadyExists => return Err(io_at(&path, "creating")(e).into()),
                _ => {}
            }
            match Self::open(root) {
                Ok(None) => {}
                Ok(Some(folder)) => return folder.write_gitignore(),
                Err(error) => {
                    if new && !matches!(error, RepairError::Busy { .. }) {
                        let _ = system::remove_file(&path.join(LOCK));
                        let _ = system::remove_dir(&path);
                    }
                    return Err(error);
                }
            }
        }
        Err(RepairError::Busy { path: root.to_owned(), holder: "it has just ended".to_owned() })
    }

    fn write_gitignore(self) -> Result<Self, RepairError> {
        let (name, text) = IGNORE;
        let path = self.path.join(name);
        let write = || -> Result<(), RepairError> {
            if look(&path)?.is_none() {
                create(&path)?.write_all(text.as_bytes()).map_err(io_at(&path, "writing"))?;
            }
            Ok(())
        };
        match write() {
            Ok(()) => Ok(self),
            Err(error) => {
                let _ = system::remove_file(&path);
                Err(error.with_leftover(self.tidy()))
            }
        }
    }

    /// Folder of staged files.
    pub(super) fn staged(&self) -> PathBuf {
        self.path.join(NEW)
    }

    /// Folder of the originals of a repair.
    pub(super) fn originals(&self, number: u32) -> PathBuf {
        self.path.join(UNDO).join(number.to_string())
    }

    /// Journal of a finished repair.
    pub(super) fn done(&self, number: u32) -> PathBuf {
        self.path.join(UNDO).join(format!("{number}.json"))
    }

    /// Journal of the current repair or undo.
    pub(super) fn journal(&self) -> PathBuf {
        self.path.join(REPAIR_JOURNAL)
    }

    /// The journal of an interrupted repair or undo; `None` when there is none.
    pub(super) fn pending(&self) -> Result<Option<Journal>, RepairError> {
        Self::read_journal(&self.journal())
    }

    /// The journal of the latest finished repair; `None` when there is none.
    pub(super) fn latest(&self) -> Result<Option<Journal>, RepairError> {
        let Some(number) = self.numbers()?.pop() else { return Ok(None) };
        let path = self.done(number);
        match Self::read_journal(&path)? {
            Some(journal) if journal.number != number => {
                let reason = format!("it is the journal of repair {}", journal.number);
                Err(RepairError::UnusableJournal { path, reason })
            }
            journal => Ok(journal),
        }
    }

    /// Reads a journal; `None` when the file is missing.
    fn read_journal(path: &Path) -> Result<Option<Journal>, RepairError> {
        let (folder, name) = (path.parent().unwrap_or(path), path.file_name().unwrap_or_default());
        let unusable = |reason| RepairError::UnusableJournal { path: path.to_owned(), reason };
        Journal::read(folder, &name.to_string_lossy()).map_err(unusable)
    }

    /// Refuses a journal, read from `path`, that this run must not carry out.
    pub(super) fn admit(&self, journal: &Journal, path: PathBuf, trust: &Trust) -> Result<(), RepairError> {
        if trust.adopts {
            return Ok(());
        }
        match journal.distrust(&self.path, || trust.user.key(&self.root)) {
            None => Ok(()),
            Some(why) => Err(RepairError::ForeignJournal { path, why, folder: self.path.clone() }),
        }
    }

    /// What a journal records of this folder.
    pub(super) fn identity(&self) -> Result<InodeIdentity, RepairError> {
        Ok(InodeIdentity::of(&self.path).map_err(io_at(&self.path, "reading metadata"))?)
    }

    /// The number of the next repair.
    pub(super) fn next_number(&self) -> Result<u32, RepairError> {
        let latest = self.numbers()?.pop().unwrap_or_default();
        let unusable = || RepairError::UnusableJournal {
            path: self.done(latest),
            reason: "no further repair can have a higher number; delete it".to_owned(),
        };
        latest.checked_add(1).ok_or_else(unusable)
    }

    /// Writes the journal; from here on the next run would finish the repair.
    pub(super) fn begin(&self, journal: &Journal) -> Result<(), RepairError> {
        let text = serde_json::to_vec_pretty(journal).unwrap_or_default();
        self.publish(&text).map_err(|error| {
            // Nothing has changed yet. If the journal cannot be removed, the next run finishes the repair.
            let _ = system::remove_file(&self.journal());
            let _ = system::remove_file(&self.path.join(DRAFT));
            with_figures(error, &self.root, &[text.len() as u64]).into()
        })
    }

    /// A pending journal as the user's own, where they adopt it from somebody else: `undo` of the repair then needs no option.
    /// It stays as it is where it cannot be written.
    pub(super) fn adopted(&self, journal: Journal, trust: &Trust) -> Journal {
        let is_own = || journal.distrust(&self.path, || trust.user.key(&self.root)).is_none();
        if !trust.adopts || is_own() {
            return journal;
        }
        let (Ok(key), Ok(here)) = (key(&trust.user, &self.root), self.identity()) else { return journal };
        let own = Journal { version: VERSION, folder: Some(here), ..journal.clone() }.signed(&key);
        let text = serde_json::to_vec_pretty(&own).unwrap_or_default();
        // A rename puts one of two whole journals in place.
        if self.publish(&text).is_ok() { own } else { journal }
    }

    /// Replaces the journal at once.
    fn publish(&self, text: &[u8]) -> Result<(), ApplyError> {
        let (path, draft) = (self.journal(), self.path.join(DRAFT));
        system::remove_file(&draft).map_err(io_at(&draft, "removing"))?;
        let mut file = create(&draft)?;
        file.write_all(text).map_err(io_at(&draft, "writing"))?;
        file.sync_all().map_err(io_at(&draft, "syncing"))?;
        retry(|| fs::rename(&draft, &path)).map_err(io_at(&path, "publishing"))?;
        sync_dir(&self.path)?;
        sync_dir(&self.root)
    }

    /// Creates and syncs a folder inside this one.
    pub(super) fn folder(&self, path: &Path) -> Result<(), RepairError> {
        let inner = path.strip_prefix(&self.path).unwrap_or(Path::new(""));
        let mut made = self.path.clone();
        for step in inner {
            made.push(step);
            match retry(|| fs::create_dir(&made)) {
                Err(e) if e.kind() != io::ErrorKind::AlreadyExists => return Err(io_at(&made, "creating")(e).into()),
                _ => {}
            }
        }
        let parents = path.ancestors().skip(1).take_while(|p| p.starts_with(&self.path));
        for parent in parents {
            sync_dir(parent)?;
        }
        Ok(())
    }

    /// Makes the journal of a finished repair the current one again, so that the repair can be undone; does nothing while
    /// there is a current one. A rename needs no space, so this works on a full disk.
    ///
    /// A run killed afterwards leaves a repair that the next run finishes or rolls back, as after any other kill.
    pub(super) fn reopen(&self, number: u32) -> Result<(), RepairError> {
        let (journal, done) = (self.journal(), self.done(number));
        if look(&journal)?.is_some() {
            return Ok(());
        }
        retry(|| fs::rename(&done, &journal)).map_err(io_at(&journal, "publishing"))?;
        sync_dir(&self.path).and_then(|()| done.parent().map_or(Ok(()), sync_dir)).map_err(|error| {
            // Nothing has changed yet. If this fails, the next run finishes the repair, which changes nothing.
            let _ = retry(|| fs::rename(&journal, &done));
            error.into()
        })
    }

    /// Numbers of the repairs that can be undone, in ascending order.
    pub(super) fn numbers(&self) -> Result<Vec<u32>, RepairError> {
        numbers(&self.path)
    }

    /// Removes files of a run that was killed before it wrote a journal.
    pub(super) fn clear(&self) -> Result<(), RepairError> {
        remove_tree(&self.staged())?;
        remove_file(&self.path.join(DRAFT))?;
        let kept = self.numbers()?;
        for name in names(&self.path.join(UNDO))? {
            if name.parse::<u32>().is_ok_and(|n| !kept.contains(&n)) {
                remove_tree(&self.path.join(UNDO).join(name))?;
            }
        }
        Ok(())
    }

    /// Removes the folder when no repair can be undone, or else the files of a failed run. Returns the folder if it could
    /// not be removed; [`super::recover`] tries again.
    pub(super) fn tidy(&self) -> Option<Leftover> {
        let leftover = |why| Leftover { path: self.path.clone(), why };
        match look(&self.journal()) {
            Ok(None) => self.remove_unused().err().map(leftover),
            _ => None, // the next run needs it
        }
    }

    fn remove_unused(&self) -> io::Result<()> {
        self.clear().map_err(io::Error::other)?;
        if !self.numbers().map_err(io::Error::other)?.is_empty() {
            return Ok(());
        }
        match system::remove_dir(&self.path.join(UNDO)) {
            Err(e) if e.kind() != io::ErrorKind::DirectoryNotEmpty => return Err(e),
            _ => {}
        }
        if system::names(&self.path)?.into_iter().any(|name| name != IGNORE.0 && name != LOCK) {
            return Ok(()); // files of somebody else
        }
        system::remove_file(&self.path.join(IGNORE.0))?;
        // The lock goes last: without it another run may begin, and then the folder stays.
        system::remove_file(&self.path.join(LOCK))?;
        match system::remove_dir(&self.path) {
            Err(e) if e.kind() == io::ErrorKind::DirectoryNotEmpty => Ok(()),
            other => other,
        }
    }
}

/// Numbers of the repairs that can be undone in the folder `path`, in ascending order.
fn numbers(path: &Path) -> Result<Vec<u32>, RepairError> {
    let mut numbers = Vec::new();
    for name in names(&path.join(UNDO))? {
        numbers.extend(name.strip_suffix(".json").and_then(|n| n.parse::<u32>().ok()));
    }
    numbers.sort_unstable();
    Ok(numbers)
}

/// Refuses files and symbolic links in place of folders: through a link, a checkpoint from elsewhere could move files outside it.
fn only_folders(path: &Path) -> Result<(), RepairError> {
    let is_there = |folder: &Path| match look(folder)? {
        Some(meta) if !meta.is_dir() => {
            Err(RepairError::UnusableJournal { path: folder.to_owned(), reason: "it is not a directory".to_owned() })
        }
        meta => Ok(meta.is_some()),
    };
    let undo = path.join(UNDO);
    if is_there(path)? && is_there(&undo)? {
        for name in names(&undo)?.iter().filter(|name| name.parse::<u32>().is_ok()) {
            is_there(&undo.join(name))?;
        }
    }
    is_there(&path.join(NEW)).map(|_| ())
}

/// Names in a folder; empty when it is missing.
fn names(path: &Path) -> Result<Vec<String>, RepairError> {
    let names = match system::names(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        other => other.map_err(io_at(path, "listing"))?,
    };
    Ok(names.into_iter().map(|name| name.to_string_lossy().into_owned()).collect())
}

pub(super) fn remove_file(path: &Path) -> Result<(), RepairError> {
    Ok(system::remove_file(path).map_err(io_at(path, "removing"))?)
}

pub(super) fn remove_tree(path: &Path) -> Result<(), RepairError> {
    Ok(system::remove_folder(path).map_err(io_at(path, "removing"))?)
}
