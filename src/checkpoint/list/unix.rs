//! Listing on Unix.
//!
//! The standard library's `read_dir` and `remove_dir_all` panic when closing a directory fails
//! (<https://doc.rust-lang.org/src/std/sys/fs/unix.rs.html>, `impl Drop for DirStream`), and close(2) may fail on network
//! file systems.

use std::ffi::OsStr;
use std::fs::OpenOptions;
use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::{AtFlags, Dir, FileType, OFlags, statat};

use super::ListedEntry;

/// The entries of a directory, unsorted, without `.` and `..`. An error on closing the directory is ignored.
pub struct Listing(Dir);

/// Lists the directory `path`; a symbolic link is followed.
///
/// # Errors
/// When `path` is missing, is not a directory or cannot be opened.
pub fn list(path: &Path) -> io::Result<Listing> {
    open(path, OFlags::DIRECTORY)
}

/// Lists the directory `path`, for removing its files through [`Listing::folder`]; a symbolic link is refused.
///
/// # Errors
/// As [`list`].
pub(crate) fn list_real(path: &Path) -> io::Result<Listing> {
    open(path, OFlags::DIRECTORY | OFlags::NOFOLLOW)
}

fn open(path: &Path, flags: OFlags) -> io::Result<Listing> {
    let flags = i32::try_from(flags.bits()).unwrap_or_default();
    let folder = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    Ok(Listing(Dir::new(OwnedFd::from(folder))?))
}

impl Listing {
    /// The open directory.
    pub(crate) fn folder(&self) -> io::Result<BorrowedFd<'_>> {
        Ok(self.0.fd()?)
    }
}

impl Iterator for Listing {
    type Item = io::Result<ListedEntry>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let entry = match self.0.next()? {
                Ok(entry) => entry,
                Err(error) => return Some(Err(error.into())),
            };
            let name = entry.file_name();
            if matches!(name.to_bytes(), b"." | b"..") {
                continue;
            }
            let kind = match (entry.file_type(), self.0.fd()) {
                // Some file systems do not store the kind with the name.
                (FileType::Unknown, Ok(folder)) => statat(folder, name, AtFlags::SYMLINK_NOFOLLOW)
                    .map_or(FileType::Unknown, |stat| FileType::from_raw_mode(stat.st_mode)),
                (kind, _) => kind,
            };
            let name = OsStr::from_bytes(name.to_bytes()).to_owned();
            return Some(Ok(ListedEntry { name, is_folder: kind == FileType::Directory }));
        }
    }
}
