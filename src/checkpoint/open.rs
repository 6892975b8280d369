//! The only way a file is opened; [`super::Source`] calls it for the files of a checkpoint.
//!
//! A plain `open` would block for ever on a FIFO named like a config, and a sparse "config" of six gigabytes would fill
//! the memory. [`open_regular`] refuses both.

use std::ffi::OsStr;
use std::fs::{File, Metadata};
use std::io::Read as _;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::platform::{self, is_windows_file_name};
use super::{EntryKind, Fault, FaultKind, Place};

/// Maximum number of bytes read of a JSON document.
pub const JSON_CAP: u64 = 64 << 20;
/// Maximum number of bytes read of a vocabulary file or of `tokenizer.json`; the largest published one has 34 MB.
pub const TOKENIZER_CAP: u64 = 64 << 20;
/// Maximum number of bytes read of a Python module.
pub const MODULE_CAP: u64 = 4 << 20;

/// Identity of a file: tells it from other files, and detects changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Device number.
    pub dev: u64,
    /// Inode number.
    pub ino: u64,
    /// Length in bytes.
    pub size: u64,
    /// Time of the last change of content: seconds and nanoseconds since 1970.
    pub mtime: (i64, i64),
}

impl Identity {
    /// Reads the identity from a file's metadata.
    #[must_use]
    pub fn from_metadata(metadata: &Metadata) -> Self {
        platform::identity(metadata)
    }
}

/// An open regular file with its identity.
#[derive(Debug)]
pub struct Opened {
    /// The file, open for reading only.
    pub file: File,
    /// The identity at the time of opening.
    pub identity: Identity,
    cap: u64,
}

/// Why a file or directory could not be opened.
#[derive(Debug, Error)]
pub enum OpenError {
    /// No file of this name.
    #[error("{} does not exist", path.display())]
    NotFound {
        /// The given path.
        path: PathBuf,
    },
    /// Not a regular file.
    #[error("{} is a {kind}, not a regular file", path.display())]
    NotRegular {
        /// The given path.
        path: PathBuf,
        /// The kind of the entry.
        kind: EntryKind,
    },
    /// A file in place of a directory.
    #[error("{} is not a directory", path.display())]
    NotADirectory {
        /// The given path.
        path: PathBuf,
    },
    /// More bytes than the limit for such a file.
    #[error("{} has {size} bytes; at most {cap} are read of such a file", path.display())]
    TooLarge {
        /// The given path.
        path: PathBuf,
        /// Bytes in the file.
        size: u64,
        /// Bytes allowed.
        cap: u64,
    },
    /// A symbolic link with a missing target.
    #[error("{} is a symbolic link to {}, which does not exist", path.display(), target.display())]
    DanglingLink {
        /// The given path.
        path: PathBuf,
        /// Target of the link.
        target: PathBuf,
    },
    /// A loop of symbolic links.
    #[error("{} is a symbolic link that leads back to itself", path.display())]
    SymlinkLoop {
        /// The given path.
        path: PathBuf,
    },
    /// A symbolic link that leads out of the checkpoint.
    #[error("{} is a symbolic link to {}, outside the directory; copy the file into the directory", path.display(), target.display())]
    Outside {
        /// The given path.
        path: PathBuf,
        /// Target of the link.
        target: PathBuf,
    },
    /// Any other error of the system.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The given path.
        path: PathBuf,
        /// The system's own error.
        source: std::io::Error,
    },
}

/// Why nothing was read of a file. Its reader adds a fault; verdicts ask for this state, because a load of the file is then
/// unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NotRead {
    /// Files before it took the budget of the checkpoint.
    OverBudget,
    /// It is larger than any file of its kind that is read.
    TooLarge,
    /// It is a link out of the directory.
    Outside,
    /// It cannot be opened or read, or is not a file. The loader fails, too.
    Unreadable,
}

impl NotRead {
    /// Says of the file why it was not read: `is a link out of the directory`.
    #[must_use]
    pub const fn words(self) -> &'static str {
        match self {
            Self::OverBudget => "is beyond the size of a checkpoint that is read whole",
            Self::TooLarge => "is too large",
            Self::Outside => "is a link out of the directory",
            Self::Unreadable => "is unreadable",
        }
    }
}

impl OpenError {
    /// The state of a file that this error kept from being read.
    #[must_use]
    pub const fn not_read(&self) -> NotRead {
        match self {
            Self::TooLarge { .. } => NotRead::TooLarge,
            Self::Outside { .. } => NotRead::Outside,
            Self::NotFound { .. }
            | Self::NotRegular { .. }
            | Self::NotADirectory { .. }
            | Self::DanglingLink { .. }
            | Self::SymlinkLoop { .. }
            | Self::Io { .. } => NotRead::Unreadable,
        }
    }

    /// The error as a fault of the file `name`.
    #[must_use]
    pub fn fault(&self, name: &str) -> Fault {
        let fault = |kind| Fault::new(kind).at(Place::file(name));
        match self {
            Self::NotRegular { kind, .. } => fault(FaultKind::NotARegularFile).with("what", kind.name()),
            Self::TooLarge { size, cap, .. } => fault(FaultKind::FileTooLarge).with("size", *size).with("cap", *cap),
            Self::DanglingLink { target, .. } => {
                fault(FaultKind::DanglingSymlink).with("target", target.to_string_lossy().into_owned())
            }
            Self::SymlinkLoop { .. } => fault(FaultKind::SymlinkLoop),
            Self::Outside { target, .. } => {
                fault(FaultKind::LinkNotFollowed).with("target", target.to_string_lossy().into_owned())
            }
            Self::Io { source, .. } => fault(FaultKind::UnreadableFile).with("reason", source.to_string()),
            Self::NotFound { .. } | Self::NotADirectory { .. } => {
                fault(FaultKind::UnreadableFile).with("reason", "it does not exist")
            }
        }
    }

    /// The error for a failed system call on `path`.
    pub(crate) fn from_io(path: &Path, source: std::io::Error) -> Self {
        let path = path.to_owned();
        if platform::is_loop(&source) {
            return Self::SymlinkLoop { path };
        }
        if source.kind() == std::io::ErrorKind::NotFound {
            return match std::fs::read_link(&path) {
                Ok(target) => Self::DanglingLink { path, target },
                Err(_) => Self::NotFound { path },
            };
        }
        Self::Io { path, source }
    }
}

/// Opens a regular file of at most `cap` bytes for reading; symbolic links are followed.
///
/// The kind is checked before opening, because opening a device can have effects, and again after, because the file may
/// have been replaced in between.
///
/// # Errors
/// When the file is missing, is not regular, or has more than `cap` bytes.
pub fn open_regular(path: &Path, cap: u64) -> Result<Opened, OpenError> {
    open_at(path, path, cap, true)
}

/// Opens a file of the checkpoint in `root`, as [`open_regular`] does. A symbolic link is followed if its target lies in
/// the checkpoint or in one of the `followed` directories, or is a blob of the hub cache.
///
/// Everything that is copied, linked or quoted is opened here: a link in a download can name any file of the user.
///
/// # Errors
/// As [`open_regular`], and [`OpenError::Outside`].
pub fn open_own(root: &Path, followed: &[PathBuf], name: &str, cap: u64) -> Result<Opened, OpenError> {
    let path = root.join(name);
    let real = real_target(root, followed, &path)?;
    // A link that somebody puts there now is not followed.
    open_at(real.as_deref().unwrap_or(&path), &path, cap, false)
}

/// Reads a whole file of the checkpoint in `root`, see [`open_own`].
///
/// # Errors
/// As [`open_own`], and when reading fails.
pub fn read_own(root: &Path, followed: &[PathBuf], name: &str, cap: u64) -> Result<Vec<u8>, OpenError> {
    open_own(root, followed, name, cap)?.read_all(&root.join(name))
}

/// The file that a symbolic link of the checkpoint in `root` leads to; `None` when `path` is no link. `followed` are real
/// directories that the user named.
///
/// # Errors
/// [`OpenError::Outside`], and those of a link without a target.
pub fn real_target(root: &Path, followed: &[PathBuf], path: &Path) -> Result<Option<PathBuf>, OpenError> {
    let io = |source| OpenError::from_io(path, source);
    if !std::fs::symlink_metadata(path).map_err(io)?.is_symlink() {
        return Ok(None);
    }
    let root = root.canonicalize().map_err(io)?;
    let real = path.canonicalize().map_err(io)?;
    // Devices and pipes have a clearer error of their own.
    let is_file = std::fs::metadata(&real).is_ok_and(|metadata| metadata.is_file());
    let is_inside = real.starts_with(&root) || followed.iter().any(|directory| real.starts_with(directory));
    if is_inside || is_blob(&root, &real) || is_shared_blob(&real) || !is_file {
        return Ok(Some(real));
    }
    let target = std::fs::read_link(path).map_err(io)?;
    Err(OpenError::Outside { path: path.to_owned(), target })
}

/// Whether a path is a blob of the hub cache of this checkpoint, or of any repository in a hub cache. A blob is named by
/// the hash of its content: <https://huggingface.co/docs/huggingface_hub/guides/manage-cache>.
fn is_blob(root: &Path, real: &Path) -> bool {
    let Some(blobs) = real.parent().filter(|dir| dir.file_name() == Some("blobs".as_ref())) else { return false };
    let Some(repository) = blobs.parent() else { return false };
    let name = real.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    let is_hash = matches!(name.len(), 40 | 64) && name.bytes().all(|b| b.is_ascii_hexdigit());
    let folder = repository.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    is_hash && (root.starts_with(repository) || folder.starts_with("models--"))
}

/// The file that marks the store of blobs for all repositories of a hub cache. Source: `utils/_shared_blobs.py` in
/// huggingface_hub 2.4.0.
const STORE_MARKER: &str = ".huggingface-shared-blobs";

/// Whether a path is a blob for all repositories of a hub cache, `blobs/4d/4d7a…`, to which the blob of a repository links. It
/// is named by the Xet hash of its content. Source: as [`STORE_MARKER`].
fn is_shared_blob(real: &Path) -> bool {
    let name = real.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    let is_hash = name.len() == 64 && name.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
    let prefix = real
        .parent()
        .filter(|dir| is_hash && dir.file_name().is_some_and(|p| Some(p) == name.get(..2).map(OsStr::new)));
    let Some(store) = prefix.and_then(Path::parent) else { return false };
    let is_marked = || std::fs::symlink_metadata(store.join(STORE_MARKER)).is_ok_and(|marker| marker.is_file());
    store.file_name() == Some("blobs".as_ref()) && is_marked()
}

/// Opens `path`, which errors call `shown`; a link is refused unless `follow`.
fn open_at(path: &Path, shown: &Path, cap: u64, follow: bool) -> Result<Opened, OpenError> {
    let io = |source| OpenError::from_io(shown, source);
    let regular = |metadata: &Metadata| match EntryKind::from_metadata(metadata) {
        EntryKind::Regular => Ok(()),
        kind => Err(OpenError::NotRegular { path: shown.to_owned(), kind }),
    };
    if cfg!(windows) && !path.file_name().is_some_and(|name| is_windows_file_name(&name.to_string_lossy())) {
        return Err(OpenError::NotFound { path: shown.to_owned() });
    }
    regular(&std::fs::metadata(path).map_err(io)?)?;
    let file = platform::open(path, follow).map_err(io)?;
    let metadata = file.metadata().map_err(io)?;
    regular(&metadata)?;
    let identity = Identity::from_metadata(&metadata);
    if identity.size > cap {
        return Err(OpenError::TooLarge { path: shown.to_owned(), size: identity.size, cap });
    }
    Ok(Opened { file, identity, cap })
}

/// Reads a whole regular file of at most `cap` bytes, even if it grows during the read.
///
/// # Errors
/// As [`open_regular`], and when reading fails.
pub fn read_capped(path: &Path, cap: u64) -> Result<Vec<u8>, OpenError> {
    open_regular(path, cap)?.read_all(path)
}

impl Opened {
    /// Fills the buffer with the bytes from `at` on. Called by the readers of shards and pickles, in any order.
    ///
    /// # Errors
    /// When the file ends before, or reading fails.
    pub(crate) fn read_exact_at(&self, buffer: &mut [u8], at: u64) -> std::io::Result<()> {
        platform::read_exact_at(&self.file, buffer, at)
    }

    /// Reads the whole file, up to the cap it was opened with.
    ///
    /// # Errors
    /// When reading fails or the file has more bytes than the cap; `path` is used in the message.
    pub fn read_all(&self, path: &Path) -> Result<Vec<u8>, OpenError> {
        let mut bytes = Vec::new();
        let reserved = bytes.try_reserve_exact(usize::try_from(self.identity.size).unwrap_or(usize::MAX));
        reserved.map_err(|_| OpenError::from_io(path, std::io::ErrorKind::OutOfMemory.into()))?;
        let limit = self.cap.saturating_add(1);
        (&self.file).take(limit).read_to_end(&mut bytes).map_err(|source| OpenError::from_io(path, source))?;
        let size = u64::try_from(bytes.len()).unwrap_or(u64::MAX);
        if size > self.cap {
            return Err(OpenError::TooLarge { path: path.to_owned(), size, cap: self.cap });
        }
        Ok(bytes)
    }
}

/// Whether a string from a checkpoint may be used as a file name: one plain component.
///
/// Refuses separators of any system, drive letters and streams (`:`), control characters, `.` and `..`, the empty name,
/// and more than 255 bytes.
#[must_use]
pub fn is_plain_file_name(name: &str) -> bool {
    !name.is_empty()
        && name.len() <= 255
        && name != "."
        && name != ".."
        && !name.chars().any(|c| c.is_control() || matches!(c, '/' | '\\' | ':'))
}
