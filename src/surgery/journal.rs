//! Repairs in place, all files or none, that can be undone.
//!
//! `.ckpt-doctor/` in the checkpoint holds what a repair needs. New files are staged in `new/`; then `journal.json`
//! says what is about to happen; then the originals are linked into `undo/N/` and the new files renamed over them; then
//! the journal becomes `undo/N.json`. A run that is killed before the journal is there has changed nothing; after that
//! the next run ([`recover`]) finishes what the journal says, or takes it back. The folder is locked meanwhile.

mod folder;
mod run;
mod undo;
mod write;

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::apply::ApplyError;

pub use undo::{Undone, undo};
pub use write::write;
pub(super) use write::{explained, unchanged, write_content};

use folder::Folder;
use run::Run;

/// Why a repair was not written or undone.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// A file that would change is a symbolic link, as all files of the hub's cache are.
    #[error("{path} is a symbolic link to {target}, and what it leads to is never written to; \
             `--fix --output DIR` makes a repaired copy", path = path.display(), target = target.display())]
    Linked {
        /// The link.
        path: PathBuf,
        /// What it says.
        target: PathBuf,
    },
    /// The directory cannot be written to.
    #[error("{path} cannot be written to ({error}); `--fix --output DIR` makes a repaired copy elsewhere", path = path.display())]
    ReadOnly {
        /// The directory.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// A new file could not be given the owner of the old one.
    #[error("{path} belongs to another user, whom a new file cannot be given to ({error}); \
             `--fix --output DIR` makes a repaired copy", path = path.display())]
    Owner {
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// Another run works there.
    #[error("{path}: another run is repairing this checkpoint ({holder}); wait for it", path = path.display())]
    Busy {
        /// The checkpoint.
        path: PathBuf,
        /// Who it is.
        holder: String,
    },
    /// Not enough room.
    #[error("{path}: {cause}: need {need} bytes, have {have}; free some, or use `--fix --output DIR` on another disk", path = path.display())]
    Space {
        /// The checkpoint.
        path: PathBuf,
        /// `no space`, or what the system said.
        cause: String,
        /// Bytes the new files take.
        need: u64,
        /// Bytes free.
        have: u64,
    },
    /// A file is not what it was when the repair was planned.
    #[error("{path} changed while the repair was planned; nothing was written, run again when it is at rest", path = path.display())]
    Moved {
        /// The file.
        path: PathBuf,
    },
    /// A file is not what the repair made of it.
    #[error("{path} has changed since the repair and is left alone; the originals lie in {originals}",
        path = path.display(), originals = originals.display())]
    Changed {
        /// The file.
        path: PathBuf,
        /// Where the originals are.
        originals: PathBuf,
    },
    /// There is no repair to undo.
    #[error("{path} has no repair to undo", path = path.display())]
    Nothing {
        /// The checkpoint.
        path: PathBuf,
    },
    /// The journal is not one of ours.
    #[error("{path} cannot be used: {reason}", path = path.display())]
    Journal {
        /// The journal.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Something went wrong while files were put in place, and taking it back did too.
    #[error("{error}; this is not finished: run `ckpt-doctor undo` or `check --fix` again when the cause is gone")]
    Half {
        /// What went wrong.
        error: Box<JournalError>,
    },
    /// Whatever else goes wrong with files.
    #[error(transparent)]
    Apply(#[from] ApplyError),
}

type Result<T> = std::result::Result<T, JournalError>;

/// What a journal is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Repair,
    Undo,
}

/// A repair, as it is written down.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Journal {
    version: u32,
    kind: Kind,
    /// Number of the repair: the latest is undone first.
    number: u32,
    files: Vec<Entry>,
}

/// A file of a repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    /// What was there; null when nothing was.
    old: Option<Old>,
    new: New,
}

/// A file before the repair. Its bytes lie in `undo/`, so that no hash is needed to tell that they are the same.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Old {
    len: u64,
    /// Seconds and nanoseconds since 1970.
    mtime: (i64, i64),
    mode: u32,
}

/// A file after the repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct New {
    len: u64,
    sha256: String,
}

/// What became of a repair that was interrupted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recovered {
    /// It is complete now.
    Finished,
    /// The checkpoint is as it was before.
    TakenBack,
}

/// Finishes or takes back a repair that was interrupted; `None` when there is none.
///
/// # Errors
/// A [`JournalError`]; then everything is as it was, the journal included.
pub fn recover(root: &Path) -> Result<Option<Recovered>> {
    // What is read only, and has nothing left over, needs no lock.
    if !Folder::left_over(root) {
        return Ok(None);
    }
    match Folder::open(root)? {
        None => Ok(None),
        Some(folder) => {
            let recovered = recover_in(&folder)?;
            folder.tidy();
            Ok(recovered)
        }
    }
}

fn recover_in(folder: &Folder) -> Result<Option<Recovered>> {
    let Some(journal) = folder.pending()? else {
        folder.clear()?;
        return Ok(None);
    };
    let run = Run::new(folder, &journal);
    let recovered = match journal.kind {
        Kind::Undo => {
            run.restore()?;
            Recovered::Finished
        }
        Kind::Repair if run.can_finish()? => {
            run.finish()?;
            Recovered::Finished
        }
        Kind::Repair => {
            run.take_back()?;
            Recovered::TakenBack
        }
    };
    Ok(Some(recovered))
}
