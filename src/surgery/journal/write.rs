//! Writes a repair into its checkpoint.

use crate::checkpoint::FaultKind;
use std::fs::{self, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;

use super::folder::{Folder, VERSION};
use super::run::{Run, look};
use super::{Entry, Journal, JournalError, Kind, New, Old, Result};
use crate::checkpoint::Shard;
use crate::checkpoint::open::{OpenError, TOKENIZER_CAP, read_capped};
use crate::surgery::apply::{ApplyError, interrupted, io_at, write_shard};
use crate::surgery::donor::AtRest;
use crate::surgery::repair::{Change, Content, Repair};
use crate::surgery::system::{ask_for_room, create, explain, retry, sync_dir};

/// Writes the changed files of a repair in place of the originals, all of them or none.
///
/// `progress` hears of bytes written. Call [`super::recover`] before the checkpoint is opened.
///
/// # Errors
/// A [`JournalError`]; then the checkpoint is as it was, but for [`JournalError::Half`], which says so.
pub fn write(repair: &Repair, progress: &mut dyn FnMut(u64)) -> Result<()> {
    let root = &repair.original.root;
    for change in &repair.changes {
        let path = root.join(&change.name);
        if look(&path)?.is_some_and(|m| m.is_symlink()) {
            let target = fs::read_link(&path).map_err(io_at(&path, "reading"))?;
            return Err(JournalError::Linked { path, target });
        }
    }
    let folder = Folder::create(root).map_err(|error| explained(error, root, repair))?;
    let written = staged(repair, &folder, progress).and_then(|journal| {
        folder.begin(&journal)?;
        let run = Run::new(&folder, &journal);
        run.finish().map_err(|error| match run.take_back() {
            Ok(()) => error,
            Err(_) => JournalError::Half { error: Box::new(error) },
        })
    });
    if written.is_err() && !folder.journal().exists() {
        // What went wrong is what the caller hears; the next run would clear this too.
        let _ = folder.clear();
    }
    folder.tidy();
    written.map_err(|error| explained(error, root, repair))
}

/// Gives an error of the system its figures, in the words of a repair.
pub(in crate::surgery) fn explained(error: JournalError, dir: &Path, repair: &Repair) -> JournalError {
    let JournalError::Apply(error) = error else { return error };
    match explain(error, dir, &repair.sizes()) {
        ApplyError::Space { path, cause, need, have } => JournalError::Space { path, cause, need, have },
        other => other.into(),
    }
}

/// Writes the new files where they do not count yet.
fn staged(repair: &Repair, folder: &Folder, progress: &mut dyn FnMut(u64)) -> Result<Journal> {
    let root = &repair.original.root;
    let donor = AtRest::see(root)?;
    if folder.pending()?.is_some() {
        return Err(JournalError::Busy { path: root.clone(), holder: "one that was interrupted".to_owned() });
    }
    folder.clear()?;
    // And a block for each: the journal, the new files' folder, and two for the originals.
    let sizes: Vec<u64> = repair.sizes().into_iter().chain([1; 4]).collect();
    ask_for_room(root, &sizes)?;
    let number = folder.numbers()?.last().map_or(1, |n| n.saturating_add(1));
    let staging = folder.staged();
    folder.folder(&staging)?;
    let mut files = Vec::new();
    for change in &repair.changes {
        interrupted()?;
        let (target, path) = (root.join(&change.name), staging.join(&change.name));
        let old = look(&target)?;
        unchanged(repair, change, &target)?;
        write_content(&path, &change.new, progress)?;
        if let Some(old) = &old {
            like(&path, old)?;
        }
        files.push(Entry { name: change.name.clone(), old: old.as_ref().map(Old::of), new: New::of(&path)? });
    }
    sync_dir(&staging)?;
    donor.unchanged()?;
    interrupted()?;
    Ok(Journal { version: VERSION, kind: Kind::Repair, number, files })
}

/// Writes a file that is not there yet, and makes it durable.
pub(in crate::surgery) fn write_content(path: &Path, content: &Content, progress: &mut dyn FnMut(u64)) -> Result<()> {
    match content {
        Content::Shard(shard) => write_shard(path, shard, progress)?,
        Content::Text(text) => {
            let mut file = create(path)?;
            file.write_all(text.as_bytes()).map_err(io_at(path, "writing"))?;
            file.sync_all().map_err(io_at(path, "syncing"))?;
            progress(text.len() as u64);
        }
    }
    Ok(())
}

/// Gives a new file the owner and the mode of the old one.
fn like(path: &Path, old: &fs::Metadata) -> Result<()> {
    let new = fs::metadata(path).map_err(io_at(path, "looking at"))?;
    if (new.uid(), new.gid()) != (old.uid(), old.gid()) {
        retry(|| std::os::unix::fs::chown(path, Some(old.uid()), Some(old.gid())))
            .map_err(|error| JournalError::Owner { path: path.to_owned(), error })?;
    }
    // After the owner: changing that may take bits away.
    retry(|| fs::set_permissions(path, Permissions::from_mode(old.mode() & 0o7777)))
        .map_err(io_at(path, "setting the mode of"))?;
    Ok(fs::File::open(path).and_then(|f| f.sync_all()).map_err(io_at(path, "syncing"))?)
}

/// Makes sure that a file is still what the repair was planned for.
pub(in crate::surgery) fn unchanged(repair: &Repair, change: &Change, path: &Path) -> Result<()> {
    let original = &repair.original;
    let there = look(path)?;
    let mut unreadable = None;
    let same = match (&change.new, original.entries.get(&change.name)) {
        (_, None) => there.is_none(),
        (Content::Shard(_), Some(_)) => original.shards.get(&change.name).is_some_and(|was| {
            let now = Shard::read(&original.root, &change.name);
            if let Some(fault) = now.faults.iter().find(|f| f.kind == FaultKind::UnreadableFile) {
                let reason = fault.detail.get("reason").and_then(serde_json::Value::as_str).unwrap_or_default();
                unreadable = Some(io::Error::other(reason.to_owned()));
            }
            (now.file_len, &now.header_sha256) == (was.file_len, &was.header_sha256)
        }),
        (Content::Text(_), Some(entry)) => {
            let document = original.document(&change.name).and_then(|d| d.text.clone());
            let text = document.or_else(|| original.modules.get(&change.name).and_then(|m| m.text.clone()));
            match text {
                Some(text) => match read_capped(path, TOKENIZER_CAP) {
                    Ok(bytes) => bytes == text.as_bytes(),
                    Err(error) => {
                        if let OpenError::Io { source, .. } = error {
                            unreadable = Some(source);
                        }
                        false
                    }
                },
                // Not UTF-8, so that the text is not kept.
                None => there.is_some_and(|m| m.len() == entry.size),
            }
        }
    };
    match unreadable {
        Some(error) => Err(io_at(path, "reading")(error).into()),
        None if same => Ok(()),
        None => Err(JournalError::Moved { path: path.to_owned() }),
    }
}
