//! A repaired copy beside the untouched original: changed files are written, all others linked.

use std::fs;
use std::io::ErrorKind::{CrossesDevices, PermissionDenied, TooManyLinks, Unsupported};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use super::changes::{check_unchanged, explain_error, write_content};
use super::donor::AtRest;
use super::error::{ApplyError, RepairError, io_at};
use super::repair::Repair;
use super::staging::Staging;
use super::stop::interrupted;
use super::system::{ask_for_room, retry};
use super::target::check_target;

/// Makes the directory `out`: the repaired checkpoint, its unchanged files as hard links to the original's or, on
/// another file system, as symbolic links. Hidden files stay behind.
///
/// `progress` hears of bytes written.
///
/// # Errors
/// A [`RepairError`]; then there is no new directory.
pub fn overlay(repair: &Repair, out: &Path, progress: &mut dyn FnMut(u64)) -> Result<PathBuf, RepairError> {
    let original = &repair.original;
    let out = check_target(out, &[&original.root])?;
    let parent = out.parent().unwrap_or_else(|| Path::new("/"));
    let donor = AtRest::record(&original.root)?;
    let explained = |error| explain_error(error, parent, repair);
    let staging = Staging::new(&out).map_err(|error| explained(error.into()))?;
    let written = ask_for_room(parent, &repair.sizes())
        .map_err(RepairError::from)
        .and_then(|()| fill(repair, staging.content(), progress))
        .and_then(|()| Ok(donor.unchanged()?))
        .and_then(|()| Ok(interrupted()?))
        .and_then(|()| Ok(staging.publish(&out)?))
        .map_err(explained);
    match (written, staging.discard()) {
        (Ok(()), _) => Ok(out), // what may be left is a marker that the next run removes
        (Err(error), _) => Err(error),
    }
}

fn fill(repair: &Repair, dir: &Path, progress: &mut dyn FnMut(u64)) -> Result<(), RepairError> {
    for change in &repair.changes {
        interrupted()?;
        check_unchanged(repair, change, &repair.original.root.join(&change.name))?;
        write_content(&dir.join(&change.name), &change.new, progress)?;
    }
    let original = &repair.original;
    for name in original.entries.keys().filter(|name| repair.changes.iter().all(|change| change.name != **name)) {
        link(&original.root.join(name), &dir.join(name))?;
    }
    Ok(())
}

/// Gives what `from` leads to a second name; a link that leads nowhere stays behind.
fn link(from: &Path, to: &Path) -> Result<(), ApplyError> {
    let Ok(real) = fs::canonicalize(from) else { return Ok(()) };
    let is_file = fs::metadata(&real).map_err(io_at(from, "looking at"))?.is_file();
    if is_file {
        match retry(|| fs::hard_link(&real, to)) {
            Ok(()) => return Ok(()),
            // Another file system, no links, or somebody else's file: a symbolic link can be made.
            Err(e) if matches!(e.kind(), CrossesDevices | PermissionDenied | Unsupported | TooManyLinks) => {}
            Err(e) => return Err(io_at(to, "linking")(e)),
        }
    }
    retry(|| symlink(&real, to)).map_err(io_at(to, "linking"))
}
