//! The folder `.ckpt-doctor` of a checkpoint, locked.
#![expect(clippy::disallowed_methods, reason = "surgery is where checkpoints are written")]

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;

use super::{Journal, JournalError, Result};
use crate::checkpoint::open::{JSON_CAP, OpenError, read_capped};
use crate::checkpoint::{REPAIR_FOLDER, REPAIR_JOURNAL, is_plain_file_name};
use crate::surgery::apply::io_at;
use crate::surgery::system::{self, create, custom, retry, sync_dir};

/// Says that the folder is nothing for version control, as caches of other tools say it.
const IGNORE: (&str, &str) = (".gitignore", "# made by ckpt-doctor, so that a repair can be undone\n*\n");

/// The version of the journal that this program writes and reads.
pub(super) const VERSION: u32 = 1;

/// The folder, locked for as long as this lives.
pub(super) struct Folder {
    pub(super) root: PathBuf,
    path: PathBuf,
    _lock: File,
}

impl Folder {
    /// Locks the folder of a checkpoint; `None` when it has none.
    pub(super) fn open(root: &Path) -> Result<Option<Self>> {
        let path = root.join(REPAIR_FOLDER);
        let flags = custom(OFlags::DIRECTORY | OFlags::NOFOLLOW);
        let lock = match OpenOptions::new().read(true).custom_flags(flags).open(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            other => other.map_err(io_at(&path, "opening"))?,
        };
        loop {
            match lock.try_lock() {
                Ok(()) => break,
                Err(TryLockError::WouldBlock) => return Err(JournalError::Busy { path: root.to_owned() }),
                Err(TryLockError::Error(e)) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(TryLockError::Error(e)) => return Err(io_at(&path, "locking")(e).into()),
            }
        }
        let held = lock.metadata().map_err(io_at(&path, "looking at"))?;
        // A run that ended between our open and our lock may have taken the folder with it.
        let same = fs::symlink_metadata(&path).is_ok_and(|m| (m.dev(), m.ino()) == (held.dev(), held.ino()));
        Ok(same.then(|| Self { root: root.to_owned(), path, _lock: lock }))
    }

    /// Locks the folder of a checkpoint, and makes it when there is none.
    pub(super) fn create(root: &Path) -> Result<Self> {
        let path = root.join(REPAIR_FOLDER);
        for _ in 0..8 {
            match retry(|| fs::create_dir(&path)) {
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem) =>
                {
                    return Err(JournalError::ReadOnly { path: root.to_owned(), error });
                }
                Err(e) if e.kind() != io::ErrorKind::AlreadyExists => return Err(io_at(&path, "creating")(e).into()),
                _ => {}
            }
            if let Some(folder) = Self::open(root)? {
                let (name, text) = IGNORE;
                let file = folder.path.join(name);
                if !file.exists() {
                    fs::write(&file, text).map_err(io_at(&file, "writing"))?;
                }
                return Ok(folder);
            }
        }
        Err(JournalError::Busy { path: root.to_owned() })
    }

    /// Where new files are staged.
    pub(super) fn staged(&self) -> PathBuf {
        self.path.join("new")
    }

    /// Where the originals of a repair are kept.
    pub(super) fn originals(&self, number: u32) -> PathBuf {
        self.path.join("undo").join(number.to_string())
    }

    /// The journal of a repair that is done.
    pub(super) fn done(&self, number: u32) -> PathBuf {
        self.path.join("undo").join(format!("{number}.json"))
    }

    /// The journal of what is under way.
    pub(super) fn journal(&self) -> PathBuf {
        self.path.join(REPAIR_JOURNAL)
    }

    /// What is under way, if anything is.
    pub(super) fn pending(&self) -> Result<Option<Journal>> {
        Self::read(&self.journal())
    }

    /// A journal; `None` when there is none of this name.
    pub(super) fn read(path: &Path) -> Result<Option<Journal>> {
        let unusable = |reason: String| JournalError::Journal { path: path.to_owned(), reason };
        let bytes = match read_capped(path, JSON_CAP) {
            Err(OpenError::NotFound { .. }) => return Ok(None),
            other => other.map_err(|e| unusable(e.to_string()))?,
        };
        let journal: Journal = serde_json::from_slice(&bytes).map_err(|e| unusable(e.to_string()))?;
        if journal.version != VERSION {
            return Err(unusable(format!("version {} is not known", journal.version)));
        }
        // Whoever wrote it: nothing outside the checkpoint is touched.
        match journal.files.iter().find(|f| !is_plain_file_name(&f.name) || f.name.starts_with('.')) {
            Some(file) => Err(unusable(format!("{:?} is no plain file name", file.name))),
            None => Ok(Some(journal)),
        }
    }

    /// Writes the journal of what begins now; from here on the next run would finish it.
    pub(super) fn begin(&self, journal: &Journal) -> Result<()> {
        let path = self.journal();
        let draft = path.with_extension("json.part");
        let text = serde_json::to_vec_pretty(journal).unwrap_or_default();
        remove_file(&draft)?;
        let mut file = create(&draft)?;
        file.write_all(&text).map_err(io_at(&draft, "writing"))?;
        file.sync_all().map_err(io_at(&draft, "syncing"))?;
        retry(|| fs::rename(&draft, &path)).map_err(io_at(&path, "publishing"))?;
        sync_dir(&self.path)?;
        Ok(sync_dir(&self.root)?)
    }

    /// Makes a folder in this one, and durable.
    pub(super) fn folder(&self, path: &Path) -> Result<()> {
        fs::create_dir_all(path).map_err(io_at(path, "creating"))?;
        let parents = path.ancestors().skip(1).take_while(|p| p.starts_with(&self.path));
        for parent in parents {
            sync_dir(parent)?;
        }
        Ok(())
    }

    /// Numbers of the repairs that can be undone, latest last.
    pub(super) fn numbers(&self) -> Result<Vec<u32>> {
        let undo = self.path.join("undo");
        let mut numbers = Vec::new();
        for name in names(&undo)? {
            numbers.extend(name.strip_suffix(".json").and_then(|n| n.parse::<u32>().ok()));
        }
        numbers.sort_unstable();
        Ok(numbers)
    }

    /// Removes what a run left that was killed before it had a journal.
    pub(super) fn clear(&self) -> Result<()> {
        remove_tree(&self.staged())?;
        remove_file(&self.journal().with_extension("json.part"))?;
        let kept = self.numbers()?;
        for name in names(&self.path.join("undo"))? {
            if name.parse::<u32>().is_ok_and(|n| !kept.contains(&n)) {
                remove_tree(&self.path.join("undo").join(name))?;
            }
        }
        Ok(())
    }

    /// Removes the folder when nothing can be undone any more. Best effort: an empty folder harms nobody.
    pub(super) fn tidy(&self) {
        if self.numbers().is_ok_and(|numbers| numbers.is_empty()) && !self.journal().exists() && self.clear().is_ok() {
            let _ = system::remove_dir(&self.path.join("undo"));
            let others = names(&self.path).unwrap_or_default().into_iter().any(|name| name != IGNORE.0);
            if !others {
                let _ = system::remove_file(&self.path.join(IGNORE.0));
                let _ = system::remove_dir(&self.path);
                let _ = sync_dir(&self.root);
            }
        }
    }
}

/// Names in a folder; none when it is not there.
fn names(path: &Path) -> Result<Vec<String>> {
    let entries = match fs::read_dir(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        other => other.map_err(io_at(path, "listing"))?,
    };
    let names: io::Result<Vec<_>> = entries.map(|e| e.map(|e| e.file_name())).collect();
    let names = names.map_err(io_at(path, "listing"))?;
    Ok(names.into_iter().map(|name| name.to_string_lossy().into_owned()).collect())
}

pub(super) fn remove_file(path: &Path) -> Result<()> {
    Ok(system::remove_file(path).map_err(io_at(path, "removing"))?)
}

pub(super) fn remove_tree(path: &Path) -> Result<()> {
    Ok(system::remove_dir_all(path).map_err(io_at(path, "removing"))?)
}
