//! Finds the settings file for a checkpoint.

use std::path::{Component, Path, PathBuf};

use crate::checkpoint::is_checkpoint;

/// Name of a settings file.
pub const FILE: &str = "ckpt-doctor.json5";

/// Result of the search for a settings file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Nearest {
    /// The settings file to use.
    pub file: Option<PathBuf>,
    /// A nearer file that is ignored, because it is in a checkpoint directory.
    pub ignored: Option<PathBuf>,
}

/// Finds the nearest settings file in the folders above a checkpoint.
///
/// A file inside a checkpoint directory is ignored: it may come with the download, and a downloaded file must not
/// change how the checkpoint is checked.
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
        found.ignored.get_or_insert(file);
    }
    found
}

/// The path from the root, with symbolic links kept: settings above a link apply to its target.
#[must_use]
pub fn absolute(path: &Path) -> PathBuf {
    // Only the file system resolves `..` after a symbolic link.
    let plain = || std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let back = path.components().any(|part| part == Component::ParentDir);
    if back { path.canonicalize().unwrap_or_else(|_| plain()) } else { plain() }
}
