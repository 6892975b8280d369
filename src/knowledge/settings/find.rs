//! Finds the settings file of a run, and decides which files around a checkpoint may say how it is judged.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use crate::checkpoint::is_checkpoint;
use crate::checkpoint::platform::{canonicalize, here, is_own};

/// Name of a settings file.
pub const FILE: &str = "ckpt-doctor.json5";

/// Result of the search for a settings file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Nearest {
    /// The settings file to use.
    pub file: Option<PathBuf>,
    /// Files that are ignored, with the reason.
    pub ignored: BTreeMap<PathBuf, Distrust>,
}

/// Why the files of a folder do not decide how checkpoints are judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Distrust {
    /// The folder is not above the working directory.
    Elsewhere,
    /// It is, or is in, a directory that is checked.
    Checked,
    /// It is a checkpoint.
    Checkpoint,
    /// It, or the file, belongs to another user.
    OtherOwner,
}

impl Distrust {
    /// The reason, as in `models/ckpt-doctor.json5 {reason}`.
    #[must_use]
    pub const fn reason(self) -> &'static str {
        match self {
            Self::Elsewhere => "is not above the working directory",
            Self::Checked => "is in the directory that is checked",
            Self::Checkpoint => "is inside a checkpoint",
            Self::OtherOwner => "belongs to another user",
        }
    }
}

/// The working directory and the directories that a run checks.
///
/// An attacker chooses every byte below a checked directory, and a download may have folders above the checkpoint. So
/// only the folders from the working directory upward have a say, and of these none that is checked.
#[derive(Debug, Clone, Default)]
pub struct Surroundings {
    here: Option<PathBuf>,
    checked: Vec<PathBuf>,
}

impl Surroundings {
    /// The surroundings of a run on these directories; files among them are passed over.
    #[must_use]
    pub fn new<'p>(checked: impl IntoIterator<Item = &'p Path>) -> Self {
        let checked = checked.into_iter().filter_map(|path| canonicalize(path).ok()).filter(|path| path.is_dir());
        Self { here: here(), checked: checked.collect() }
    }

    /// Why `name` in the folder `dir`, a path without links, has no say; `None` when it may decide.
    #[must_use]
    pub fn distrust(&self, dir: &Path, name: &str) -> Option<Distrust> {
        if is_checkpoint(dir) {
            return Some(Distrust::Checkpoint);
        }
        if self.checked.iter().any(|checked| dir.starts_with(checked)) {
            return Some(Distrust::Checked);
        }
        if !self.here.as_ref().is_some_and(|here| here.starts_with(dir)) {
            return Some(Distrust::Elsewhere);
        }
        (!is_own(dir) || !is_own(&dir.join(name))).then_some(Distrust::OtherOwner)
    }

    /// The settings file of the run: the nearest from the working directory upward that may decide. Those that may not,
    /// there and above each checked directory, are ignored.
    #[must_use]
    pub fn nearest(&self) -> Nearest {
        let mut found = Nearest::default();
        for dir in self.here.iter().flat_map(|here| here.ancestors()) {
            if found.file.is_none() {
                self.consider(dir, &mut found);
            }
        }
        for dir in self.checked.iter().flat_map(|checked| checked.ancestors()) {
            if !self.here.as_ref().is_some_and(|here| here.starts_with(dir)) {
                self.consider(dir, &mut found);
            }
        }
        found
    }

    fn consider(&self, dir: &Path, found: &mut Nearest) {
        let file = dir.join(FILE);
        if file.symlink_metadata().is_err() {
            return;
        }
        match self.distrust(dir, FILE) {
            None => found.file = Some(file),
            Some(why) => _ = found.ignored.insert(file, why),
        }
    }
}

/// The path from the root, with symbolic links kept: settings above a link apply to its target.
#[must_use]
pub fn absolute(path: &Path) -> PathBuf {
    // Only the file system resolves `..` after a symbolic link.
    let plain = || std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let back = path.components().any(|part| part == Component::ParentDir);
    if back { canonicalize(path).unwrap_or_else(|_| plain()) } else { plain() }
}
