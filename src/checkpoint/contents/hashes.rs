//! Compares files with the hashes that a download or git recorded beside them; read only for `check --hash`.
//!
//! Three records state what a file must contain: the name of a blob in the hub cache, what huggingface_hub writes for each
//! file of a `local_dir`, and the index of a git work tree. Of the last, only weights are compared: git may convert the
//! line ends of text. Files are hashed by all cores, each by one thread.

use sha1::Sha1;
use sha2::{Digest as _, Sha256};

use super::git_index::{GitIndex, IndexEntry};
use super::pieces::{Hash, each_piece};
use super::read::Progress;
use super::tally::as_u64;
use super::{CHUNK, HASHED_ZEROS};
use crate::checkpoint::{
    Checkpoint, Entry, EntryKind, Fault, FaultKind, OpenError, Place, Source, SourceFile, hex, parallel,
};

/// The folder in which huggingface_hub keeps what it knows of the files of a `local_dir`, after those around it. Source: `_local_folder.py` in huggingface_hub 1.0.
const RECORDS: [&str; 3] = [".cache", ".cache/huggingface", ".cache/huggingface/download"];
/// Maximum number of bytes of such a record: three short lines.
const RECORD_CAP: u64 = 4096;
/// Largest weights that are hashed as a file of git in the same reading. Larger ones are nearly always in Git LFS, where git has a
/// pointer, and are read again where that differs.
const PLAIN_CAP: u64 = 64 << 20;

/// What a record says of a file.
enum Record {
    /// Its SHA-256.
    Sha256(String),
    /// Its SHA-1 as a git object.
    Git(String),
    /// The SHA-1 of the file, or of its LFS pointer, as a git object.
    GitOrPointer(String),
}

/// A file that is hashed.
struct Stated<'c> {
    name: &'c str,
    size: u64,
    record: Record,
    /// Where the record is, for messages: `its name in the cache is`.
    source: &'static str,
    /// Time after which a change of the file is an edit; `None` when it never is one.
    since: Option<Since>,
}

/// When a record was true.
enum Since {
    /// Seconds since 1970; the file was not changed later.
    At(f64),
    /// The time of the last change of the file itself, in seconds and nanoseconds, of which git keeps 32 bits each.
    Same(u32, u32),
}

/// How many files were compared with recorded hashes. `check --hash` prints it: agreement says nothing of a file without a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HashedFiles {
    /// Files whose hash was computed, equal to the recorded one or not.
    pub compared: usize,
    /// Other regular files: their hash is not recorded, or they could not be read.
    pub others: usize,
}

/// What came of a file whose hash is recorded.
enum HashMatch {
    Equal,
    Differs(Fault),
    /// It could not be read whole.
    Unread(Option<Fault>),
}

/// Hashes the files of a checkpoint of which a record states the hash, and returns a fault for each that differs or cannot
/// be read. Called for `check --hash`; `progress` is called by every thread, after each read.
pub(in crate::checkpoint) fn check(
    checkpoint: &Checkpoint,
    progress: &(dyn Fn(Progress<'_>) + Sync),
) -> (Vec<Fault>, HashedFiles) {
    let files = &checkpoint.source;
    let records = Records::new(files);
    let regular = checkpoint.entries.iter().filter(|(_, entry)| entry.kind == EntryKind::Regular);
    let mut all: usize = 0;
    let mut stated: Vec<Stated<'_>> = regular
        .inspect(|_| all = all.saturating_add(1))
        .filter(|(_, entry)| entry.lfs.is_none())
        .filter_map(|(name, entry)| {
            let is_weights = checkpoint.shards.contains_key(name) || checkpoint.pickles.contains_key(name);
            records.of(files, name, entry, is_weights)
        })
        .collect();
    // The largest first, so that no thread starts one when the others have nothing left.
    stated.sort_by(|one, other| (other.size, one.name).cmp(&(one.size, other.name)));
    let total = stated.iter().fold(0_u64, |sum, file| sum.saturating_add(file.size));
    let zeros = HASHED_ZEROS.checked_div(as_u64(stated.len())).unwrap_or(0);
    let compared = parallel::map(
        parallel::threads(),
        &stated,
        || vec![0_u8; CHUNK],
        |buffer, file| {
            let read = |bytes| progress(Progress { file: file.name, bytes, total });
            compare(files, file, buffer, zeros, &read)
        },
    );
    let unread = compared.iter().filter(|one| matches!(one, HashMatch::Unread(_))).count();
    let compared_files = compared.len().saturating_sub(unread);
    let mut faults: Vec<Fault> = compared.into_iter().filter_map(HashMatch::fault).collect();
    faults.sort_by_cached_key(|fault| fault.places.first().and_then(|place| place.file.clone()));
    (faults, HashedFiles { compared: compared_files, others: all.saturating_sub(compared_files) })
}

/// The records beside the files of a checkpoint.
struct Records {
    /// Whether there may be records of huggingface_hub.
    has_downloads: bool,
    git: Option<GitIndex>,
}

impl Records {
    fn new(files: &Source) -> Self {
        // A link could lead to the records of other files.
        let has_downloads = RECORDS.iter().all(|folder| files.has_folder(folder));
        Self { has_downloads, git: GitIndex::read(files) }
    }

    /// What states the hash of this file, if anything does.
    fn of<'c>(&self, files: &Source, name: &'c str, entry: &Entry, is_weights: bool) -> Option<Stated<'c>> {
        let size = entry.size;
        let stated = |record, source, since| Stated { name, size, record, source, since };
        if let Some(record) = blob(entry) {
            return Some(stated(record, "its name in the cache is", None));
        }
        if let Some((record, since)) = self.has_downloads.then(|| download(files, name)).flatten() {
            return Some(stated(record, "its download is recorded with", Some(Since::At(since))));
        }
        let IndexEntry { id, mtime: (seconds, nanoseconds) } = self.git.as_ref()?.get(name).filter(|_| is_weights)?;
        let since = Since::Same(*seconds, *nanoseconds);
        Some(stated(Record::GitOrPointer(hex(id)), "git recorded", Some(since)))
    }
}

/// The hash in the name of a blob of the hub cache: SHA-256 of large files, git hashes of others. A blob for all repositories,
/// `blobs/4d/4d7a…`, has the Xet hash as its name, which is not computed here.
fn blob(entry: &Entry) -> Option<Record> {
    let mut parts = entry.link.as_deref()?.rsplit('/');
    let name = parts.next()?;
    let record = record(name)?;
    let folder = parts.next();
    let is_blob = match record {
        Record::Sha256(_) => folder != name.get(..2),
        _ => folder == Some("blobs"),
    };
    is_blob.then_some(record)
}

fn record(hash: &str) -> Option<Record> {
    let is_hash = hash.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
    match hash.len() {
        64 if is_hash => Some(Record::Sha256(hash.to_owned())),
        40 if is_hash => Some(Record::Git(hash.to_owned())),
        _ => None,
    }
}

/// What huggingface_hub recorded when it wrote this file: the hash, and the time in seconds since 1970. The lines of a record
/// are the commit, the hash and the time.
fn download(files: &Source, name: &str) -> Option<(Record, f64)> {
    let [.., folder] = RECORDS;
    let path = format!("{folder}/{name}.metadata");
    let text = String::from_utf8(files.read_own(&path, RECORD_CAP).ok()?).ok()?;
    let mut lines = text.lines().map(str::trim).skip(1);
    let record = record(lines.next()?)?;
    let time: f64 = lines.next()?.parse().ok()?;
    Some((record, time)).filter(|_| time.is_finite())
}

impl HashMatch {
    fn fault(self) -> Option<Fault> {
        match self {
            Self::Equal => None,
            Self::Differs(fault) => Some(fault),
            Self::Unread(fault) => fault,
        }
    }
}

/// Compares a file with its record.
fn compare(files: &Source, file: &Stated<'_>, buffer: &mut [u8], zeros: u64, read: &dyn Fn(u64)) -> HashMatch {
    let fault = |kind| Fault::new(kind).at(Place::file(file.name));
    let unread = |reason: &str| HashMatch::Unread(Some(fault(FaultKind::ContentsUnread).with("reason", reason)));
    let opened = match files.open_own(file.name, u64::MAX) {
        Ok(opened) => opened,
        // What a link outside the checkpoint leads to is no part of it.
        Err(OpenError::Outside { .. }) => return HashMatch::Unread(None),
        Err(error) => return unread(&error.to_string()),
    };
    let size = opened.len();
    let found = match Hashes::of(&opened, &file.record, buffer, zeros, read) {
        Ok(Some(found)) => found,
        Ok(None) => return unread("its holes have more zeros than are hashed"),
        Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
            return unread("it became shorter while it was read");
        }
        Err(error) => return unread(&error.to_string()),
    };
    let (algorithm, stated, found) = match &file.record {
        Record::Sha256(stated) => ("SHA-256", stated, found.sha256.unwrap_or_default()),
        Record::Git(stated) => ("git hash", stated, found.git.unwrap_or_default()),
        Record::GitOrPointer(stated) => {
            let pointer = pointer_hash(&found.sha256.unwrap_or_default(), size);
            let again = || Hashes::of(&opened, &Record::Git(stated.clone()), buffer, zeros, &|_| ()).ok()??.git;
            let git = if pointer == *stated { None } else { found.git.or_else(again) };
            ("git hash", stated, git.filter(|git| git == stated).unwrap_or(pointer))
        }
    };
    if found == *stated {
        return HashMatch::Equal;
    }
    let is_edited = match (&file.since, opened.modified()) {
        (None, _) | (_, None) => false,
        // huggingface_hub allows a second, too: not every file system keeps fractions.
        (Some(Since::At(time)), Some((seconds, _))) => as_f64(seconds) - 1.0 > *time,
        // Git stores the low bits.
        (Some(Since::Same(s, n)), Some((seconds, nanoseconds))) => {
            (seconds & 0xffff_ffff, nanoseconds) != ((*s).into(), (*n).into())
        }
    };
    let kind = if is_edited { FaultKind::ContentEdited } else { FaultKind::ContentHashDiffers };
    let fault = fault(kind).with("algorithm", algorithm).with("source", file.source);
    HashMatch::Differs(fault.with("stated", stated.as_str()).with("found", found))
}

#[expect(clippy::cast_precision_loss, reason = "seconds since 1970 have 31 bits")]
const fn as_f64(seconds: i64) -> f64 {
    seconds as f64
}

/// The hashes that a record needs, in hexadecimal.
struct Hashes {
    sha256: Option<String>,
    git: Option<String>,
}

impl Hashes {
    /// Reads the file once; `None` when it has more zeros in holes than are hashed.
    fn of(
        opened: &SourceFile,
        record: &Record,
        buffer: &mut [u8],
        mut zeros: u64,
        read: &dyn Fn(u64),
    ) -> std::io::Result<Option<Self>> {
        let size = opened.len();
        let mut sha256: Option<Hash<Sha256>> = (!matches!(record, Record::Git(_))).then(|| Hash::of(Sha256::new()));
        let is_git = matches!(record, Record::Git(_)) || matches!(record, Record::GitOrPointer(_)) && size <= PLAIN_CAP;
        let mut git: Option<Hash<Sha1>> = is_git.then(|| Hash::of(Sha1::new_with_prefix(format!("blob {size}\0"))));
        each_piece(opened, 0, size, buffer, |piece| {
            // Both take the same zeros.
            let mut left = zeros;
            if let Some(hash) = &mut sha256 {
                hash.add(&piece, &mut left);
            }
            if let Some(hash) = &mut git {
                hash.add(&piece, &mut zeros);
            }
            zeros = zeros.min(left);
            read(piece.len());
        })?;
        let is_whole = sha256.as_ref().is_none_or(Hash::is_whole) && git.as_ref().is_none_or(Hash::is_whole);
        let [sha256, git] = [sha256.and_then(Hash::finish), git.and_then(Hash::finish)];
        Ok(is_whole.then_some(Self { sha256, git }))
    }
}

/// SHA-1, as a git object, of the LFS pointer to a file with this SHA-256 and size. Source: git-lfs docs/spec.md.
fn pointer_hash(sha256: &str, size: u64) -> String {
    let text = format!("version https://git-lfs.github.com/spec/v1\noid sha256:{sha256}\nsize {size}\n");
    hex(&Sha1::digest(format!("blob {}\0{text}", text.len())))
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    use std::fs;
    use std::process::Command;

    use super::*;

    const NAME: &str = "model.safetensors";

    /// A work tree as `git lfs` leaves it: the index has the pointer, the tree the content. A shell script stands for git-lfs.
    #[test]
    #[cfg(target_os = "linux")]
    fn weights_of_a_work_tree_are_those_of_the_pointer() {
        let dir = tempfile::tempdir().unwrap();
        let git = |arguments: &[&str]| {
            Command::new("git").current_dir(dir.path()).args(arguments).status().is_ok_and(|status| status.success())
        };
        assert!(git(&["init", "-q"]), "this test needs git");
        let clean = "cat > .git/t; printf 'version https://git-lfs.github.com/spec/v1\\noid sha256:%s\\nsize %s\\n' \
                     $(sha256sum < .git/t | cut -c1-64) $(wc -c < .git/t)";
        assert!(git(&["config", "filter.lfs.clean", clean]));
        let file = dir.path().join(NAME);
        fs::write(dir.path().join(".gitattributes"), "*.safetensors filter=lfs\n").unwrap();
        fs::write(&file, [7; 1000]).unwrap();
        assert!(git(&["add", "."]));
        let kinds = || {
            let mut checkpoint = Checkpoint::open(dir.path()).unwrap();
            checkpoint.shards.entry(NAME.to_owned()).or_default();
            check(&checkpoint, &|_| {}).0.into_iter().map(|fault| fault.kind).collect::<Vec<_>>()
        };
        assert_eq!(kinds(), []);
        let time = fs::metadata(&file).unwrap().modified().unwrap();
        fs::write(&file, [8; 1000]).unwrap();
        assert_eq!(kinds(), [FaultKind::ContentEdited]);
        fs::File::options().write(true).open(&file).unwrap().set_modified(time).unwrap();
        assert_eq!(kinds(), [FaultKind::ContentHashDiffers]);
        // Small weights outside of Git LFS.
        fs::write(dir.path().join(".gitattributes"), "").unwrap();
        assert!(git(&["add", "."]));
        assert_eq!(kinds(), []);
    }
}
