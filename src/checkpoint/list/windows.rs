//! Listing on Windows, where closing a directory of the standard library does not panic.

use std::fs::{ReadDir, read_dir};
use std::io;
use std::path::Path;

use super::ListedEntry;

/// The entries of a directory, unsorted, without `.` and `..`.
pub struct Listing(ReadDir);

/// Lists the directory `path`; a link is followed.
///
/// # Errors
/// When `path` is missing, is not a directory or cannot be opened.
#[expect(clippy::disallowed_methods, reason = "this is the function to use in its place")]
pub fn list(path: &Path) -> io::Result<Listing> {
    Ok(Listing(read_dir(path)?))
}

impl Iterator for Listing {
    type Item = io::Result<ListedEntry>;

    fn next(&mut self) -> Option<Self::Item> {
        let listed = |entry: std::fs::DirEntry| ListedEntry {
            is_folder: entry.file_type().is_ok_and(|kind| kind.is_dir()),
            name: entry.file_name(),
        };
        Some(self.0.next()?.map(listed))
    }
}
