//! The journal of a repair, `.ckpt-doctor/journal.json` and `.ckpt-doctor/undo/N.json`, and whether this user wrote it here.
//!
//! A download can contain a journal, and a repair that is finished puts files into place. So `surgery` signs the journals that it
//! writes with a key of the user ([`StateFolder`]), and carries out no other. A reader of a checkpoint, which writes nothing, only
//! asks who wrote a journal: [`super::Checkpoint::recognise_journal`].

mod state;

use std::fs::{self, Metadata};
use std::io;
use std::path::Path;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

pub use state::{KEY_LEN, Key, NoKey, StateFolder};

use super::open::{JSON_CAP, OpenError, read_own};
use super::{is_plain_file_name, platform};

/// Version of the journal format. Version 1 had no edits of headers, version 2 no authenticator.
pub const VERSION: u32 = 3;

/// First bytes of what is authenticated, so that the key serves for nothing else.
const CONTEXT: &[u8] = b"ckpt-doctor journal\n";

/// The serialised journal of a repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Journal {
    /// At most [`VERSION`].
    pub version: u32,
    /// Number of the repair; the highest is undone first.
    pub number: u32,
    /// The folder `.ckpt-doctor` in which it was written; `None` before version 3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub folder: Option<InodeIdentity>,
    /// The files of the repair.
    pub files: Vec<JournaledFile>,
    /// Keyed hash of all of the above; `None` before version 3, and for a user without a key.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub authenticator: Option<String>,
}

/// A file of a repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JournaledFile {
    /// Its name in the checkpoint.
    pub name: String,
    /// The file before the repair; null when it did not exist.
    pub old: Option<OldFile>,
    /// The file after the repair.
    pub new: NewFile,
    /// The edit, if only the header of a shard changes, in place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub header: Option<HeaderEdit>,
}

/// An edit of the header of a shard, in place; `undo/N/NAME` contains the old header and then the new one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeaderEdit {
    /// Number of bytes before the tensors.
    pub old_len: u64,
    /// Number of bytes before the tensors after the edit.
    pub new_len: u64,
    /// Inode of the shard: a file of another one was saved by another program, and was never edited.
    pub inode: u64,
    /// Of both headers; `None` before version 3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
}

impl HeaderEdit {
    /// Number of bytes of both headers.
    #[must_use]
    pub const fn kept_len(&self) -> u64 {
        self.old_len.saturating_add(self.new_len)
    }
}

/// A file before the repair. The original itself is kept in `undo/`, as a second name of the same file, so no hash is needed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OldFile {
    /// Number of bytes.
    pub len: u64,
    /// Seconds and nanoseconds since 1970.
    pub mtime: (i64, i64),
    /// Permissions.
    pub mode: u32,
    /// By which the original in `undo/` is recognised; `None` before version 3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identity: Option<InodeIdentity>,
}

/// A file after the repair.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NewFile {
    /// Number of bytes.
    pub len: u64,
    /// Of the file; with [`JournaledFile::header`], of its header.
    pub sha256: String,
}

/// What tells the folder `.ckpt-doctor` of a journal, or an original in it, from every copy.
///
/// Renaming the checkpoint on its disk keeps both numbers, and so do a snapshot and a power failure; a copy, an archive and a
/// download get others. The number of the device is left out: it changes with every mount of a loop device, of a network file
/// system and of many others, and after a power failure the directory must be recognised. The time of creation is there
/// because the number of a removed entry may go to the next one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InodeIdentity {
    /// Inode.
    pub inode: u64,
    /// Seconds and nanoseconds since 1970; `None` where the file system does not say, and for 1970 itself: after a power
    /// failure, btrfs of Linux before 6.16 has lost the time (its log did not have it).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub created: Option<(u64, u32)>,
}

impl InodeIdentity {
    /// The identity of the entry at `path`. `surgery` calls it for a journal that it writes.
    ///
    /// # Errors
    /// When the entry cannot be inspected.
    pub fn of(path: &Path) -> io::Result<Self> {
        Ok(Self::from_metadata(&fs::symlink_metadata(path)?))
    }

    /// The identity of an entry with this metadata.
    #[must_use]
    pub fn from_metadata(metadata: &Metadata) -> Self {
        Self { inode: platform::identity(metadata).ino, created: created(metadata) }
    }

    /// Whether this is the entry that was recorded; a time that one side lacks decides nothing.
    #[must_use]
    pub fn is(self, recorded: Self) -> bool {
        let is_same_time = self.created.zip(recorded.created).is_none_or(|(is, was)| is == was);
        self.inode == recorded.inode && is_same_time
    }
}

fn created(metadata: &Metadata) -> Option<(u64, u32)> {
    let since = metadata.created().ok()?.duration_since(SystemTime::UNIX_EPOCH).ok()?;
    (since.as_secs() > 0).then(|| (since.as_secs(), since.subsec_nanos()))
}

/// Why a journal is not carried out.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum JournalDistrust {
    /// Nobody asked; the journal of a checkpoint in memory, or of one that a caller opened without a key.
    #[error("it was not verified who wrote it")]
    Unverified,
    /// It cannot be read.
    #[error("it is no journal that can be used ({0})")]
    Unusable(String),
    /// It has no authenticator.
    #[error("it has no authenticator, so whoever made the checkpoint may have written it")]
    Unsigned,
    /// This user has no key.
    #[error("its authenticator cannot be verified, because {0}")]
    NoKey(NoKey),
    /// The authenticator is not that of the document under this user's key.
    #[error("its authenticator is not that of your key: another user or computer wrote it, or it was changed")]
    OtherKey,
    /// The journal is authentic, and lies in another folder than it was written in.
    #[error("it was written in another directory, of which this one is a copy")]
    OtherFolder,
}

impl Journal {
    /// Reads the journal of this name in the folder `.ckpt-doctor`; `None` when the file is missing. The caller asks
    /// [`Self::distrust`] before it acts on it.
    ///
    /// # Errors
    /// When the file is not a journal of a known version, or names a file that is not one of the checkpoint: a sentence.
    pub fn read(folder: &Path, name: &str) -> Result<Option<Self>, String> {
        // A download may have a journal that is a link.
        let bytes = match read_own(folder, &[], name, JSON_CAP) {
            Err(OpenError::NotFound { .. }) => return Ok(None),
            other => other.map_err(|e| e.to_string())?,
        };
        let journal: Self = serde_json::from_slice(&bytes).map_err(|e| e.to_string())?;
        if !(1..=VERSION).contains(&journal.version) {
            return Err(format!("version {} is unknown", journal.version));
        }
        // The checkpoint may come from elsewhere: nothing outside it may be changed.
        match journal.files.iter().find(|f| !is_plain_file_name(&f.name) || f.name.starts_with('.')) {
            Some(file) => Err(format!("{:?} is not a plain file name", file.name)),
            None => Ok(Some(journal)),
        }
    }

    /// Adds the authenticator. `surgery` calls it for a journal that it writes; the folder must be recorded.
    #[must_use]
    pub fn signed(self, key: &Key) -> Self {
        let authenticator = self.authenticate(key).map(|hash| hash.to_hex().to_string());
        Self { authenticator, ..self }
    }

    /// Why this user did not write this journal in this folder `.ckpt-doctor`; `None` when they did.
    ///
    /// `key` is called for a journal with an authenticator, and reads the key of the user.
    pub fn distrust(&self, folder: &Path, key: impl FnOnce() -> Result<Key, NoKey>) -> Option<JournalDistrust> {
        let (Some(stated), Some(recorded)) = (&self.authenticator, self.folder) else {
            return Some(JournalDistrust::Unsigned);
        };
        let key = match key() {
            Ok(key) => key,
            Err(why) => return Some(JournalDistrust::NoKey(why)),
        };
        // Hashes are compared in constant time.
        let stated = blake3::Hash::from_hex(stated).ok();
        if stated.is_none() || self.authenticate(&key) != stated {
            return Some(JournalDistrust::OtherKey);
        }
        let is_here = InodeIdentity::of(folder).is_ok_and(|folder| folder.is(recorded));
        (!is_here).then_some(JournalDistrust::OtherFolder)
    }

    /// The keyed hash of the whole document without its authenticator: what is parsed is what is authenticated, and the parser
    /// knows no other key. Staged files and headers are covered by their hashes, originals by their identities.
    fn authenticate(&self, key: &Key) -> Option<blake3::Hash> {
        let unsigned = Self { authenticator: None, ..self.clone() };
        let mut hasher = key.hasher();
        hasher.update(CONTEXT);
        serde_json::to_writer(&mut hasher, &unsigned).ok()?;
        Some(hasher.finalize())
    }
}
