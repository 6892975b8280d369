//! Which settings file is for which checkpoint.

use std::path::{Component, Path, PathBuf};

use crate::checkpoint::is_checkpoint;

/// Name of a settings file.
pub const FILE: &str = "ckpt-doctor.json5";

/// What there is for a checkpoint.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Nearest {
    /// The file to go by.
    pub file: Option<PathBuf>,
    /// A nearer one that is not gone by, because it lies among the files of a checkpoint.
    pub passed_over: Option<PathBuf>,
}

/// The nearest settings file in the folders above a checkpoint.
///
/// A file among those of a checkpoint is passed over: it came with the download, and what is looked at has no say in
/// how it is looked at.
#[must_use]
pub fn nearest(checkpoint: &Path) -> Nearest {
    let mut found = Nearest::default();
    for dir in absolute(checkpoint).ancestors() {
        let file = dir.join(FILE);
        if file.symlink_metadata().is_err() {
            continue;
        }
        if !is_checkpoint(dir) {
            found.file = Some(file);
            break;
        }
        found.passed_over.get_or_insert(file);
    }
    found
}

/// The path from the root, symbolic links as they are: what lies above a link is above what it leads to.
#[must_use]
pub fn absolute(path: &Path) -> PathBuf {
    // Only the system knows what `..` after a link means.
    let plain = || std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let back = path.components().any(|part| part == Component::ParentDir);
    if back { path.canonicalize().unwrap_or_else(|_| plain()) } else { plain() }
}
