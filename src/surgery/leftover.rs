//! Files of a finished run that could not be removed.

use std::fmt;
use std::io;
use std::path::PathBuf;

/// A directory of temporary files that stays after its run succeeded. Nothing in it is needed, and the next run on the
/// same directory removes it.
#[derive(Debug)]
pub struct Leftover {
    /// The directory.
    pub path: PathBuf,
    /// Error of the removal.
    pub why: io::Error,
}

impl fmt::Display for Leftover {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { path, why } = self;
        write!(f, "{} could not be removed ({why}); remove it, or run the same command again", path.display())
    }
}
