//! Windows: what the standard library offers there without unsafe code.

use std::fs::{File, FileType, Metadata, OpenOptions};
use std::io::{self, ErrorKind};
use std::os::windows::fs::{FileExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use super::without_prefix;
use crate::checkpoint::EntryKind;
use crate::checkpoint::open::Identity;

// https://learn.microsoft.com/windows/win32/fileio/file-attribute-constants
const FILE_ATTRIBUTE_REPARSE_POINT: u32 = 0x400;
// https://learn.microsoft.com/windows/win32/api/fileapi/nf-fileapi-createfilew
const FILE_FLAG_OPEN_REPARSE_POINT: u32 = 0x0020_0000;
const FILE_SHARE_READ: u32 = 1;
const FILE_SHARE_WRITE: u32 = 2;
// https://learn.microsoft.com/windows/win32/debug/system-error-codes--1700-3999-
const ERROR_CANT_RESOLVE_FILENAME: i32 = 1921;
// https://learn.microsoft.com/windows/win32/debug/system-error-codes--0-499-
const ERROR_TOO_MANY_OPEN_FILES: i32 = 4;

/// Opens a file for reading; a link (symbolic link or junction) is refused unless `follow`.
///
/// # Errors
/// Those of the system, and one for which [`is_loop`] is true when the link is refused.
pub(crate) fn open(path: &Path, follow: bool) -> io::Result<File> {
    if follow {
        return File::open(path);
    }
    let mut options = OpenOptions::new();
    let options = options.read(true).custom_flags(FILE_FLAG_OPEN_REPARSE_POINT);
    // No one can rename or delete the entry while this handle is open.
    let entry = options.share_mode(FILE_SHARE_READ | FILE_SHARE_WRITE).open(path)?;
    let metadata = entry.metadata()?;
    if metadata.file_type().is_symlink() {
        return Err(io::Error::from_raw_os_error(ERROR_CANT_RESOLVE_FILENAME));
    }
    if metadata.file_attributes() & FILE_ATTRIBUTE_REPARSE_POINT == 0 {
        return Ok(entry);
    }
    // The content of this file is elsewhere, such as in a cloud or a store of equal blocks: its driver has to open it.
    File::open(path)
}

/// The kind of what is neither a file nor a directory.
pub(crate) const fn special_kind(_: FileType) -> EntryKind {
    EntryKind::Device
}

/// The identity of a file from its metadata. The number of the file is not stable in the standard library; its time of
/// creation stands for it.
pub(crate) fn identity(metadata: &Metadata) -> Identity {
    let written = i64::try_from(metadata.last_write_time()).unwrap_or(i64::MAX);
    Identity { dev: 0, ino: metadata.creation_time(), size: metadata.len(), mtime: (written, 0) }
}

/// Whether the error says that a link leads back to itself, or that a link was not followed.
pub(crate) fn is_loop(error: &io::Error) -> bool {
    error.raw_os_error() == Some(ERROR_CANT_RESOLVE_FILENAME)
}

/// Whether the error says that this process may open no more files.
pub(crate) fn is_out_of_descriptors(error: &io::Error) -> bool {
    error.raw_os_error() == Some(ERROR_TOO_MANY_OPEN_FILES)
}

/// Fills the buffer with the bytes from `at` on.
///
/// # Errors
/// When the file ends before, or reading fails.
pub(crate) fn read_exact_at(file: &File, buffer: &mut [u8], mut at: u64) -> io::Result<()> {
    let mut rest = buffer;
    while !rest.is_empty() {
        match file.seek_read(rest, at) {
            Ok(0) => return Err(io::Error::new(ErrorKind::UnexpectedEof, "failed to fill whole buffer")),
            Ok(read) => {
                rest = rest.get_mut(read..).unwrap_or_default();
                at = at.saturating_add(read as u64);
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Holes of sparse files are read as zeros: the standard library does not tell them.
///
/// # Errors
/// Always.
pub(crate) fn next_data(_: &File, _: u64) -> io::Result<Option<u64>> {
    Err(ErrorKind::Unsupported.into())
}

/// As [`next_data`].
///
/// # Errors
/// Always.
pub(crate) fn next_hole(_: &File, _: u64) -> io::Result<u64> {
    Err(ErrorKind::Unsupported.into())
}

/// Whether the user of this process owns the entry: the standard library does not tell owners, so this is assumed.
pub(crate) const fn is_own(_: &Path) -> bool {
    true
}

/// Why a file is not one that the user of this process alone can read and write: the standard library does not tell.
pub(crate) fn why_not_private(_: &Metadata) -> Option<String> {
    Some("may be open to other users, which this system does not tell".to_owned())
}

/// The path without links, in the case in which its folders are stored.
///
/// # Errors
/// When it does not exist, or cannot be resolved.
pub(crate) fn canonicalize(path: &Path) -> io::Result<PathBuf> {
    let real = path.canonicalize()?;
    Ok(real.to_str().map(without_prefix).map_or_else(|| real.clone(), PathBuf::from))
}

/// The working directory, as [`canonicalize`].
pub(crate) fn here() -> Option<PathBuf> {
    canonicalize(&std::env::current_dir().ok()?).ok()
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    use super::*;

    #[test]
    fn reads_by_position_and_refuses_links() {
        let dir = tempfile::tempdir().unwrap();
        let (path, link) = (dir.path().join("file"), dir.path().join("link"));
        std::fs::write(&path, b"0123456789").unwrap();
        let file = open(&path, false).unwrap();
        let mut buffer = [0; 4];
        read_exact_at(&file, &mut buffer, 3).unwrap();
        assert_eq!(&buffer, b"3456");
        assert_eq!(read_exact_at(&file, &mut buffer, 8).unwrap_err().kind(), ErrorKind::UnexpectedEof);
        // Links need a right that not every user has. Wine, which sets this variable, follows them in spite of the flag.
        let is_wine = std::env::var_os("WINEHOMEDIR").is_some();
        if !is_wine && std::os::windows::fs::symlink_file(&path, &link).is_ok() {
            assert!(is_loop(&open(&link, false).unwrap_err()));
            open(&link, true).unwrap();
        }
    }
}

/// Maps nothing: the caller reads instead.
pub(crate) fn with_window<T>(_: &File, _: u64, _: usize, _: impl FnOnce(&[u8]) -> T) -> Option<io::Result<T>> {
    None
}
