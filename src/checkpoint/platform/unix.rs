//! Linux and macOS.

use std::fs::{File, FileType, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{FileExt as _, FileTypeExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use rustix::fs::{OFlags, SeekFrom, seek};
use rustix::io::Errno;

use crate::checkpoint::EntryKind;
use crate::checkpoint::open::Identity;

/// Opens a file for reading, without waiting for the other end of a FIFO; a link is refused unless `follow`.
///
/// # Errors
/// Those of the system.
pub(crate) fn open(path: &Path, follow: bool) -> io::Result<File> {
    let more = if follow { OFlags::empty() } else { OFlags::NOFOLLOW };
    let flags = OFlags::NONBLOCK | OFlags::CLOEXEC | OFlags::NOCTTY | more;
    let flags = i32::try_from(flags.bits()).unwrap_or(0);
    OpenOptions::new().read(true).custom_flags(flags).open(path)
}

/// The kind of what is neither a file nor a directory.
pub(crate) fn special_kind(kind: FileType) -> EntryKind {
    if kind.is_fifo() {
        EntryKind::Fifo
    } else if kind.is_socket() {
        EntryKind::Socket
    } else {
        EntryKind::Device
    }
}

/// The identity of a file from its metadata.
pub(crate) fn identity(metadata: &Metadata) -> Identity {
    Identity {
        dev: metadata.dev(),
        ino: metadata.ino(),
        size: metadata.len(),
        mtime: (metadata.mtime(), metadata.mtime_nsec()),
    }
}

/// Whether the error says that a link leads back to itself, or that a link was not followed.
pub(crate) fn is_loop(error: &io::Error) -> bool {
    error.raw_os_error() == Some(Errno::LOOP.raw_os_error())
}

/// Whether the error says that this process, or the system, may open no more files.
pub(crate) fn is_out_of_descriptors(error: &io::Error) -> bool {
    [Errno::MFILE, Errno::NFILE].iter().any(|errno| error.raw_os_error() == Some(errno.raw_os_error()))
}

/// Fills the buffer with the bytes from `at` on.
///
/// # Errors
/// When the file ends before, or reading fails.
pub(crate) fn read_exact_at(file: &File, buffer: &mut [u8], at: u64) -> io::Result<()> {
    file.read_exact_at(buffer, at)
}

/// Start of the first data at or behind `at`; `None` when only a hole follows. Moves the offset of the file, which no
/// reader uses: all reads are positioned.
///
/// # Errors
/// When the file system does not tell holes.
pub(crate) fn next_data(file: &File, at: u64) -> io::Result<Option<u64>> {
    match seek(file, SeekFrom::Data(at)) {
        Ok(data) => Ok(Some(data)),
        Err(Errno::NXIO) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Start of the first hole at or behind `at`. Every file has an implicit hole at its end.
///
/// # Errors
/// As [`next_data`].
pub(crate) fn next_hole(file: &File, at: u64) -> io::Result<u64> {
    Ok(seek(file, SeekFrom::Hole(at))?)
}

/// Whether the user of this process owns the entry; a link is not followed.
pub(crate) fn is_own(path: &Path) -> bool {
    let user = rustix::process::geteuid().as_raw();
    path.symlink_metadata().is_ok_and(|metadata| metadata.uid() == user)
}

/// Why a file is not one that the user of this process alone can read and write; `None` when it is.
pub(crate) fn why_not_private(metadata: &Metadata) -> Option<String> {
    if metadata.uid() != rustix::process::geteuid().as_raw() {
        return Some("belongs to another user".to_owned());
    }
    let mode = metadata.mode() & 0o7777;
    (mode & 0o077 != 0).then(|| format!("can be read or written by other users (its mode is {mode:04o}, not 0600)"))
}

/// The path without links.
///
/// # Errors
/// When it does not exist, or cannot be resolved.
pub(crate) fn canonicalize(path: &Path) -> io::Result<PathBuf> {
    path.canonicalize()
}

/// The working directory, without links.
pub(crate) fn here() -> Option<PathBuf> {
    std::env::current_dir().ok()
}
