//! The changed files of a repair; shared by repairs in place and repaired copies.

use std::io::{self, Write};
use std::path::Path;

use serde_json::Value;
use sha2::{Digest as _, Sha256};

use super::shards::write_shards;
use super::sharing::Sharing;
use super::system::{create, look, with_figures};
use crate::checkpoint::open::{OpenError, TOKENIZER_CAP, read_capped};
use crate::checkpoint::{Checkpoint, FaultKind, HashAlgorithm, Shard, hex};
use crate::surgery::error::{ApplyError, RepairError, io_at};
use crate::surgery::repair::{Change, Content, Repair};
use crate::surgery::written::Writing;

/// Fails when a file no longer matches the checkpoint for which the repair was planned, or when its new content is the old
/// one: then no other program is at fault.
pub(super) fn check_unchanged(repair: &Repair, change: &Change, path: &Path) -> Result<(), RepairError> {
    let original = &repair.original;
    if changes_nothing(original, change) {
        return Err(RepairError::ChangesNothing { path: path.to_owned() });
    }
    let there = look(path)?;
    let mut unreadable = None;
    let same = match (&change.new, original.entries.get(&change.name)) {
        (_, None) => there.is_none(),
        (Content::Shard(_), Some(_)) => original.shards.get(&change.name).is_some_and(|was| {
            let now = Shard::read(&original.source, &change.name);
            if let Some(fault) = now.faults.iter().find(|f| f.kind == FaultKind::UnreadableFile) {
                let reason = fault.detail.get("reason").and_then(Value::as_str).unwrap_or_default();
                unreadable = Some(io::Error::other(reason.to_owned()));
            }
            (now.file_len, now.header_sha256()) == (was.file_len, was.header_sha256())
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
                // The text of a file that is not UTF-8 is not kept; only its size is compared.
                None => there.is_some_and(|m| m.len() == entry.size),
            }
        }
    };
    match unreadable {
        Some(error) => Err(io_at(path, "reading")(error).into()),
        None if same => Ok(()),
        None => Err(RepairError::ChangedWhilePlanned { path: path.to_owned() }),
    }
}

/// Whether a change would write the bytes that the file has.
fn changes_nothing(original: &Checkpoint, change: &Change) -> bool {
    match &change.new {
        Content::Text(new) => {
            let document = original.document(&change.name).and_then(|document| document.text.as_ref());
            let module = || original.modules.get(&change.name).and_then(|module| module.text.as_ref());
            document.or_else(module).is_some_and(|old| old == new)
        }
        Content::Shard(new) => original.shards.get(&change.name).is_some_and(|old| {
            new.file_len() == old.file_len && hex(&Sha256::digest(new.header())) == old.header_sha256()
        }),
    }
}

/// Number of bytes that a new file needs.
pub(super) fn space(content: &Content, sharing: &Sharing) -> u64 {
    match content {
        Content::Text(text) => text.len() as u64,
        Content::Shard(shard) => sharing.space(shard),
    }
}

/// Writes a new file and syncs it.
pub(super) fn write_content(
    path: &Path,
    content: &Content,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<(), RepairError> {
    match content {
        Content::Shard(shard) => {
            write_shards(&[(path.to_owned(), shard)], Writing::new(HashAlgorithm::None), progress)?;
        }
        Content::Text(text) => {
            let mut file = create(path)?;
            file.write_all(text.as_bytes()).map_err(io_at(path, "writing"))?;
            file.sync_all().map_err(io_at(path, "syncing"))?;
            progress(text.len() as u64);
        }
    }
    Ok(())
}

/// Converts an error of the system into an error of a repair, with the bytes needed and free.
///
/// `sizes` are those of the files to write.
pub(super) fn explain_error(error: RepairError, dir: &Path, sizes: &[u64]) -> RepairError {
    let RepairError::Apply(error) = error else { return error };
    match with_figures(error, dir, sizes) {
        ApplyError::Space { path, cause, need, have } => RepairError::Space { path, cause, need, have },
        other => other.into(),
    }
}
