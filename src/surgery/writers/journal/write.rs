//! Writes a repair into its checkpoint.

use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use super::folder::Folder;
use super::header::Headers;
use super::key::key;
use super::owner::copy_owner_and_mode;
use super::replay::Replay;
use crate::checkpoint::journal::{Journal, JournaledFile, Key, NewFile, OldFile, StateFolder, VERSION};
use crate::surgery::donor::DonorSnapshot;
use crate::surgery::error::{RepairError, io_at};
use crate::surgery::leftover::Leftover;
use crate::surgery::outcome::RepairWritten;
use crate::surgery::repair::{Change, Content, Repair};
use crate::surgery::stop::interrupted;
use crate::surgery::writers::changes::{check_unchanged, explain_error, space, write_content};
use crate::surgery::writers::sharing::Sharing;
use crate::surgery::writers::system::{check_space, look, sync_dir};

/// Replaces the changed files of a repair, all of them or none.
///
/// `user` has the key that signs the journal, or gets one. `progress` receives the bytes written, from several threads.
/// Call [`super::recover`] before the checkpoint is opened.
///
/// # Errors
/// A [`RepairError`]; then the checkpoint is unchanged, except with [`RepairError::Unfinished`].
pub fn write(
    repair: &Repair,
    user: &StateFolder,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<RepairWritten, RepairError> {
    let root = repair.directory()?;
    for change in &repair.changes {
        let path = root.join(&change.name);
        if look(&path)?.is_some_and(|m| m.is_symlink()) {
            let target = fs::read_link(&path).map_err(io_at(&path, "reading"))?;
            return Err(RepairError::Linked { path, target });
        }
    }
    let mut steps: Vec<Step<'_>> = repair.changes.iter().map(|change| Step::new(repair, change)).collect();
    let folder = Folder::create(root).map_err(|error| explain_error(error, root, &sizes(root, &steps)))?;
    let key = key(user, root);
    let written = loop {
        match attempt(repair, &steps, &folder, key.as_ref().ok(), progress) {
            // The second attempt edits nothing in place, so it is the last one.
            Ok(Attempt::NotInPlace) => steps.iter_mut().for_each(|step| step.headers = None),
            Ok(Attempt::Written(leftover)) => break Ok(leftover),
            Err(error) => break Err(error),
        }
    };
    match written {
        Ok(leftover) => Ok(RepairWritten { leftover: leftover.or(folder.tidy()), unsigned: key.err() }),
        Err(error) => Err(explain_error(error, root, &sizes(root, &steps)).with_leftover(folder.tidy())),
    }
}

/// How an attempt to write a repair ended.
enum Attempt {
    /// All changes are made; the staging folder, if it could not be removed.
    Written(Option<Leftover>),
    /// The file system cannot insert blocks for a header; nothing has changed.
    NotInPlace,
}

/// A change, and the headers if only the header of a shard changes, in place.
struct Step<'r> {
    change: &'r Change,
    headers: Option<Headers>,
}

impl<'r> Step<'r> {
    fn new(repair: &Repair, change: &'r Change) -> Self {
        let original = &repair.original;
        let headers = match (&change.new, original.shards.get(&change.name)) {
            (Content::Shard(plan), Some(shard)) => {
                Headers::of(plan, &original.source.path().join(&change.name), shard.data_start)
            }
            _ => None,
        };
        Self { change, headers }
    }

    /// Number of bytes to write.
    fn bytes(&self, sharing: &Sharing) -> u64 {
        self.headers.as_ref().map_or_else(|| space(&self.change.new, sharing), Headers::bytes)
    }
}

/// Number of bytes to write for each step in the checkpoint `root`.
fn sizes(root: &Path, steps: &[Step<'_>]) -> Vec<u64> {
    let sharing = Sharing::of(root);
    steps.iter().map(|step| step.bytes(&sharing)).collect()
}

/// Stages the changes and makes them.
fn attempt(
    repair: &Repair,
    steps: &[Step<'_>],
    folder: &Folder,
    key: Option<&Key>,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<Attempt, RepairError> {
    let journal = stage(repair, steps, folder, progress)?;
    let journal = match key {
        Some(key) => journal.signed(key),
        None => journal,
    };
    folder.begin(&journal)?;
    // This run has written the journal and what it names.
    let replay = Replay::new(folder, &journal, true);
    let undo = || folder.reopen(journal.number).and_then(|()| replay.roll_back());
    let unfinished = |error| RepairError::Unfinished { error: Box::new(error) };
    let finished = match replay.edit_headers() {
        Ok(false) => return replay.roll_back().map(|_| Attempt::NotInPlace).map_err(unfinished),
        Ok(true) => replay.finish(),
        Err(error) => Err(error),
    };
    finished.map(Attempt::Written).map_err(|error| match undo() {
        Ok(_) => error,
        Err(_) => unfinished(error),
    })
}

/// Stages the new files, and the headers of shards that are edited in place.
fn stage(
    repair: &Repair,
    steps: &[Step<'_>],
    folder: &Folder,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<Journal, RepairError> {
    let root = repair.directory()?;
    let donor = DonorSnapshot::record(root)?;
    if folder.pending()?.is_some() {
        return Err(RepairError::Busy { path: root.to_owned(), holder: "an interrupted run".to_owned() });
    }
    folder.clear()?;
    // One more block each for the journal and for the folder of new files, and two for the originals.
    let sizes: Vec<u64> = sizes(root, steps).into_iter().chain([1; 4]).collect();
    check_space(root, &sizes)?;
    let number = folder.next_number()?;
    let (staging, originals) = (folder.staged(), folder.originals(number));
    folder.folder(&staging)?;
    if steps.iter().any(|step| step.headers.is_some()) {
        folder.folder(&originals)?;
    }
    let mut files = Vec::new();
    for Step { change, headers } in steps {
        interrupted()?;
        let (target, path) = (root.join(&change.name), staging.join(&change.name));
        let old = look(&target)?;
        check_unchanged(repair, change, &target)?;
        let name = change.name.clone();
        if let (Some(headers), Some(old)) = (headers, &old) {
            let kept = originals.join(&name);
            headers.write(&kept).map_err(io_at(&kept, "writing"))?;
            progress(change.new.len());
            let (new, header) = (NewFile::of_headers(headers), Some(headers.record(old.ino())));
            files.push(JournaledFile { name, old: Some(OldFile::from_metadata(old)), new, header });
            continue;
        }
        write_content(&path, &change.new, progress)?;
        if let Some(old) = &old {
            copy_owner_and_mode(&path, &target, old)?;
        }
        let old = old.as_ref().map(OldFile::from_metadata);
        files.push(JournaledFile { name, old, new: NewFile::hash(&path)?, header: None });
    }
    sync_dir(&staging)?;
    if files.iter().any(|file| file.header.is_some()) {
        sync_dir(&originals)?;
    }
    donor.unchanged()?;
    interrupted()?;
    Ok(Journal { version: VERSION, number, folder: Some(folder.identity()?), files, authenticator: None })
}
