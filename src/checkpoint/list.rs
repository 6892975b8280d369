//! The only way a directory is listed.

use std::ffi::OsString;

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(unix)]
pub use unix::list;
#[cfg(unix)]
pub(crate) use unix::list_real;
#[cfg(windows)]
pub use windows::list;

/// A directory entry.
pub struct ListedEntry {
    /// Its name.
    pub name: OsString,
    /// Whether it is a directory; `false` for a symbolic link to one.
    pub is_folder: bool,
}
