//! Where the bytes of a checkpoint come from.
//!
//! The readers of a checkpoint list, inspect and open its files here and nowhere else, so that a new place for checkpoints is
//! a new variant of [`Source`]. Those who write, or open files by their paths, ask for [`Source::directory`]; those who map a
//! file or find its holes, for [`SourceFile::local`].

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod file;
mod memory;
#[cfg(test)]
mod tests;

pub use file::SourceFile;
pub use memory::MemoryFiles;

use super::list::{ListedEntry, list};
use super::open::{open_own, open_regular, read_own, real_target};
use super::{EntryKind, OpenError};

/// Entries of a folder, unsorted.
type Entries = Box<dyn Iterator<Item = std::io::Result<ListedEntry>>>;

/// The place of a checkpoint's files. File names are relative to it, with `/` between folders.
#[derive(Debug, Clone)]
pub enum Source {
    /// A directory of the file system.
    Directory(LocalDirectory),
    /// Files in memory: those of a caller, or none for a checkpoint that is only planned.
    Memory(MemoryFiles),
}

/// A directory of the file system, and others that links in it may lead to.
#[derive(Debug, Clone)]
pub struct LocalDirectory {
    path: PathBuf,
    /// Real paths, without links.
    followed: Arc<[PathBuf]>,
}

impl Default for Source {
    fn default() -> Self {
        Self::Memory(MemoryFiles::default())
    }
}

impl Source {
    /// The directory at `path`.
    ///
    /// # Errors
    /// When it is missing, or is not a directory.
    pub fn open(path: &Path) -> Result<Self, OpenError> {
        let metadata = fs::metadata(path).map_err(|source| OpenError::from_io(path, source))?;
        if !metadata.is_dir() {
            return Err(OpenError::NotADirectory { path: path.to_owned() });
        }
        Ok(Self::from(path))
    }

    /// The same, with links followed that lead into these directories: real paths of those that the user names. Files in memory
    /// have no links.
    #[must_use]
    pub fn following(self, directories: &Arc<[PathBuf]>) -> Self {
        match self {
            Self::Directory(LocalDirectory { path, .. }) => {
                Self::Directory(LocalDirectory { path, followed: Arc::clone(directories) })
            }
            Self::Memory(files) => Self::Memory(files),
        }
    }

    /// The path of the directory or, of files in memory, the one that was given to them. Messages show it, settings match it,
    /// and some rules read its last component; only [`Self::directory`] can be opened.
    #[must_use]
    pub fn path(&self) -> &Path {
        match self {
            Self::Directory(directory) => &directory.path,
            Self::Memory(files) => files.path(),
        }
    }

    /// The directory, for those who write to it or open its files by their paths; `None` for files in memory.
    #[must_use]
    pub fn directory(&self) -> Option<&Path> {
        match self {
            Self::Directory(directory) => Some(&directory.path),
            Self::Memory(_) => None,
        }
    }

    /// The source at a relative path from this one: a folder of it or, of a directory, any other. `None` for files in memory
    /// when the path leaves them. Called for the base model of an
    /// adapter, and for the records of a download.
    pub(crate) fn join(&self, path: &Path) -> Option<Self> {
        match self {
            Self::Directory(LocalDirectory { path: root, followed }) => {
                let followed = Arc::clone(followed);
                Some(Self::Directory(LocalDirectory { path: root.join(path), followed }))
            }
            Self::Memory(files) => files.folder(path).map(Self::Memory),
        }
    }

    /// Lists the folder of this name; the name of the checkpoint itself is empty.
    ///
    /// # Errors
    /// When it is missing, is not a folder or cannot be opened.
    pub(crate) fn list(&self, folder: &str) -> std::io::Result<Entries> {
        Ok(match self {
            Self::Directory(LocalDirectory { path: root, .. }) if folder.is_empty() => Box::new(list(root)?),
            Self::Directory(LocalDirectory { path: root, .. }) => Box::new(list(&root.join(folder))?),
            Self::Memory(files) => Box::new(files.list(folder)?.into_iter().map(Ok)),
        })
    }

    /// The kind of an entry, and its size in bytes if it is a file; links are followed.
    ///
    /// # Errors
    /// When it is missing, or is a link without a target.
    pub(super) fn stat(&self, name: &str) -> Result<(EntryKind, u64), OpenError> {
        match self {
            Self::Directory(LocalDirectory { path: root, .. }) => {
                let path = root.join(name);
                let metadata = fs::metadata(&path).map_err(|source| OpenError::from_io(&path, source))?;
                let kind = EntryKind::from_metadata(&metadata);
                Ok((kind, if kind == EntryKind::Regular { metadata.len() } else { 0 }))
            }
            Self::Memory(files) => files.stat(name),
        }
    }

    /// Whether an entry of this name exists, even as a link without a target.
    pub(super) fn exists(&self, name: &str) -> bool {
        match self {
            Self::Directory(LocalDirectory { path: root, .. }) => fs::symlink_metadata(root.join(name)).is_ok(),
            Self::Memory(files) => files.stat(name).is_ok(),
        }
    }

    /// Whether a folder of this name exists and is not a link.
    pub(crate) fn has_folder(&self, name: &str) -> bool {
        match self {
            Self::Directory(LocalDirectory { path: root, .. }) => {
                fs::symlink_metadata(root.join(name)).is_ok_and(|metadata| metadata.is_dir())
            }
            Self::Memory(files) => matches!(files.stat(name), Ok((EntryKind::Directory, _))),
        }
    }

    /// The target of a symbolic link, as the link states it; `None` when the entry is not a link.
    pub(super) fn link(&self, name: &str) -> Option<String> {
        match self {
            Self::Directory(LocalDirectory { path: root, .. }) => {
                Some(fs::read_link(root.join(name)).ok()?.to_string_lossy().into_owned())
            }
            Self::Memory(_) => None,
        }
    }

    /// Whether an entry may be opened by [`Self::open_own`].
    ///
    /// # Errors
    /// [`OpenError::Outside`] for a link that leaves the checkpoint, and those of a link without a target.
    pub(crate) fn check_link(&self, name: &str) -> Result<(), OpenError> {
        match self {
            Self::Directory(LocalDirectory { path, followed }) => {
                real_target(path, followed, &path.join(name)).map(drop)
            }
            Self::Memory(files) => files.stat(name).map(drop),
        }
    }

    /// Opens a file of at most `cap` bytes; links are followed wherever they lead. For headers and tensors, which are not
    /// quoted.
    ///
    /// # Errors
    /// As [`super::open_regular`].
    pub(super) fn open_regular(&self, name: &str, cap: u64) -> Result<SourceFile, OpenError> {
        match self {
            Self::Directory(LocalDirectory { path: root, .. }) => {
                open_regular(&root.join(name), cap).map(SourceFile::Local)
            }
            Self::Memory(files) => files.open(name, cap).map(SourceFile::Memory),
        }
    }

    /// Opens a file of at most `cap` bytes; a link that leaves the checkpoint is refused. For what is quoted, copied or hashed.
    ///
    /// # Errors
    /// As [`super::open::open_own`].
    pub(crate) fn open_own(&self, name: &str, cap: u64) -> Result<SourceFile, OpenError> {
        match self {
            Self::Directory(LocalDirectory { path, followed }) => {
                open_own(path, followed, name, cap).map(SourceFile::Local)
            }
            Self::Memory(files) => files.open(name, cap).map(SourceFile::Memory),
        }
    }

    /// Reads a whole file, which is opened as in [`Self::open_own`].
    ///
    /// # Errors
    /// As [`Self::open_own`], and when reading fails.
    pub(crate) fn read_own(&self, name: &str, cap: u64) -> Result<Vec<u8>, OpenError> {
        match self {
            Self::Directory(LocalDirectory { path, followed }) => read_own(path, followed, name, cap),
            Self::Memory(files) => files.open(name, cap).map(|bytes| bytes.to_vec()),
        }
    }
}

impl From<&Path> for Source {
    /// The directory at this path, which need not exist.
    fn from(path: &Path) -> Self {
        Self::Directory(LocalDirectory { path: path.to_owned(), followed: Arc::default() })
    }
}
