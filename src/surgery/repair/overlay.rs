//! A repaired copy beside the untouched original: changed files are written, all others linked.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use super::Repair;
use crate::surgery::apply::{ApplyError, check_target, interrupted, io_at};
use crate::surgery::journal::{JournalError, explained, write_content};
use crate::surgery::staging::Staging;
use crate::surgery::system::ask_for_room;

/// Makes the directory `out`: the repaired checkpoint, its unchanged files as hard links to the original's or, on
/// another file system, as symbolic links. Hidden files stay behind.
///
/// `progress` hears of bytes written.
///
/// # Errors
/// A [`JournalError`]; then there is no new directory.
pub fn overlay(repair: &Repair, out: &Path, progress: &mut dyn FnMut(u64)) -> Result<PathBuf, JournalError> {
    let original = &repair.original;
    let out = check_target(out, &[&original.root])?;
    let parent = out.parent().unwrap_or_else(|| Path::new("/"));
    ask_for_room(parent, &repair.sizes())?;
    let staging = Staging::new(&out)?;
    let written = fill(repair, staging.content(), progress)
        .and_then(|()| Ok(interrupted()?))
        .and_then(|()| Ok(staging.publish(&out)?))
        .map_err(|error| explained(error, repair));
    match (written, staging.discard()) {
        (Ok(()), _) => Ok(out), // what may be left is a marker that the next run removes
        (Err(error), _) => Err(error),
    }
}

fn fill(repair: &Repair, dir: &Path, progress: &mut dyn FnMut(u64)) -> Result<(), JournalError> {
    for change in &repair.changes {
        interrupted()?;
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
    // Another file system, no links, or somebody else's file: a symbolic link can always be made.
    if is_file && fs::hard_link(&real, to).is_ok() {
        return Ok(());
    }
    symlink(&real, to).map_err(io_at(to, "linking"))
}
