//! A repaired copy of a checkpoint: changed files are written, all others linked.

use std::fs;
use std::io::ErrorKind::{CrossesDevices, NotFound, PermissionDenied, TooManyLinks, Unsupported};
use std::io::{self, Write as _};
use std::os::unix::fs::{MetadataExt as _, symlink};
use std::path::Path;

use super::changes::{check_unchanged, explain_error, space, write_content};
use super::sharing::Sharing;
use super::staging::Staging;
use super::system::{check_space, create, retry};
use super::target::claim_target;
use crate::checkpoint::open::{OpenError, TOKENIZER_CAP, read_own, real_target};
use crate::checkpoint::platform::is_loop;
use crate::checkpoint::{Entry, EntryKind};
use crate::surgery::donor::DonorSnapshot;
use crate::surgery::error::{ApplyError, RepairError, io_at};
use crate::surgery::outcome::{RepairedCopy, Target};
use crate::surgery::repair::Repair;
use crate::surgery::stop::interrupted;

/// Creates the directory `out` with the repaired checkpoint. Unchanged files are hard links to the original's. On another file
/// system small ones are copied, and large ones, such as weights, are symbolic links. Hidden files are not copied.
///
/// `progress` receives the bytes written, from several threads.
///
/// # Errors
/// A [`RepairError`]; then the directory was not created.
pub fn overlay(repair: &Repair, out: &Path, progress: &(dyn Fn(u64) + Sync)) -> Result<RepairedCopy, RepairError> {
    let root = repair.directory()?;
    let Target { path: out, cleared } = claim_target(out, &[root])?;
    let parent = out.parent().unwrap_or_else(|| Path::new("/"));
    let donor = DonorSnapshot::record(root)?;
    let sharing = Sharing::of(parent);
    let mut sizes: Vec<u64> = repair.changes.iter().map(|change| space(&change.new, &sharing)).collect();
    sizes.extend(copied(repair, root, parent));
    let explained = |error| explain_error(error, parent, &sizes);
    let staging = Staging::new(&out).map_err(|error| explained(error.into()))?;
    let written = check_space(parent, &sizes)
        .map_err(RepairError::from)
        .and_then(|()| fill(repair, root, staging.content(), progress))
        .and_then(|()| Ok(donor.unchanged()?))
        .and_then(|()| Ok(interrupted()?))
        .and_then(|()| Ok(staging.publish(&out)?))
        .map_err(explained);
    match (written, staging.discard()) {
        (Ok(()), leftover) => Ok(RepairedCopy { cleared, leftover }),
        (Err(error), leftover) => Err(error.with_leftover(leftover)),
    }
}

fn fill(repair: &Repair, root: &Path, dir: &Path, progress: &(dyn Fn(u64) + Sync)) -> Result<(), RepairError> {
    for change in &repair.changes {
        interrupted()?;
        check_unchanged(repair, change, &root.join(&change.name))?;
        write_content(&dir.join(&change.name), &change.new, progress)?;
    }
    for (name, _) in unchanged(repair) {
        link(root, name, &dir.join(name))?;
    }
    Ok(())
}

/// The entries of the original that the repair leaves as they are.
fn unchanged(repair: &Repair) -> impl Iterator<Item = (&String, &Entry)> {
    let is_changed = |name: &str| repair.changes.iter().any(|change| change.name == name);
    repair.original.entries.iter().filter(move |(name, _)| !is_changed(name))
}

/// The sizes of the files that are copied to another file system, see [`link`].
fn copied(repair: &Repair, root: &Path, parent: &Path) -> Vec<u64> {
    let device = |path: &Path| fs::metadata(path).ok().map(|metadata| metadata.dev());
    let elsewhere = |name: &str| device(&root.join(name)) != device(parent);
    let is_small = |entry: &Entry| entry.kind == EntryKind::Regular && entry.size <= COPIED;
    let own = |name: &str| real_target(root, &[], &root.join(name)).is_ok();
    let files = unchanged(repair).filter(|(name, entry)| is_small(entry) && own(name) && elsewhere(name));
    files.map(|(_, entry)| entry.size).collect()
}

/// Links the target of a file of the original under a second name or, where the system refuses that, copies it if it is small;
/// a broken link is skipped. A file outside of the original gets no second name and is not copied: a symbolic link leads to it,
/// as in the original.
fn link(root: &Path, name: &str, to: &Path) -> Result<(), ApplyError> {
    let from = &root.join(name);
    let real = match fs::canonicalize(from) {
        Ok(real) => real,
        Err(error) if error.kind() == NotFound || is_loop(&error) => return Ok(()),
        // A call that failed for another reason does not make the link broken.
        Err(error) => return Err(io_at(from, "resolving")(error)),
    };
    let metadata = fs::metadata(&real).map_err(io_at(from, "reading metadata"))?;
    let size = metadata.len();
    let is_own = match real_target(root, &[], from) {
        Ok(_) => true,
        Err(OpenError::Io { source, .. }) => return Err(io_at(from, "resolving")(source)),
        Err(_) => false,
    };
    if metadata.is_file() && is_own {
        match retry(|| fs::hard_link(&real, to)) {
            Ok(()) => return Ok(()),
            // Another file system, no hard links, or a file of another user. A check reads no document behind a symbolic link.
            Err(e) if is_refused(&e) && size <= COPIED => return copy(root, name, to),
            Err(e) if is_refused(&e) => {}
            Err(e) => return Err(io_at(to, "linking")(e)),
        }
    }
    retry(|| symlink(&real, to)).map_err(io_at(to, "linking"))
}

/// Largest file that is copied where it cannot have a second name: the limits of documents and tokenizers.
const COPIED: u64 = TOKENIZER_CAP;

fn is_refused(error: &io::Error) -> bool {
    matches!(error.kind(), CrossesDevices | PermissionDenied | Unsupported | TooManyLinks)
}

fn copy(root: &Path, name: &str, to: &Path) -> Result<(), ApplyError> {
    let from = &root.join(name);
    let bytes = read_own(root, &[], name, COPIED).map_err(|error| io_at(from, "reading")(io::Error::other(error)))?;
    let mut file = create(to)?;
    file.write_all(&bytes).map_err(io_at(to, "writing"))?;
    file.sync_all().map_err(io_at(to, "syncing"))
}
