//! `undo`: the latest repair is taken back, byte for byte.

use std::path::Path;

use super::folder::Folder;
use super::run::Run;
use super::{Journal, JournalError, Kind, Recovered, Result, recover_in};
use crate::surgery::apply::interrupted;

/// What was undone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Undone {
    /// Files that are as they were before.
    pub restored: Vec<String>,
    /// Files that the repair had added, and that are gone.
    pub removed: Vec<String>,
    /// Repairs before this one, that can be undone next.
    pub left: usize,
}

/// Undoes the latest repair of a checkpoint. One that was interrupted is finished or taken back first.
///
/// # Errors
/// [`JournalError::Nothing`] when there is none, [`JournalError::Changed`] when a file is no longer what the repair
/// made of it; then nothing is touched.
pub fn undo(root: &Path) -> Result<Undone> {
    let Some(folder) = Folder::open(root)? else { return Err(JournalError::Nothing { path: root.to_owned() }) };
    let pending = folder.pending()?;
    let recovered = recover_in(&folder)?;
    if let Some(journal) = pending
        && (journal.kind == Kind::Undo || recovered == Some(Recovered::TakenBack))
    {
        // That was the undoing that is asked for.
        return Ok(undone(&folder, &journal));
    }
    let numbers = folder.numbers()?;
    let read = numbers.last().map(|number| Folder::read(&folder.done(*number))).transpose()?.flatten();
    let Some(journal) = read else {
        folder.tidy();
        return Err(JournalError::Nothing { path: root.to_owned() });
    };
    let journal = Journal { kind: Kind::Undo, ..journal };
    let run = Run::new(&folder, &journal);
    if let Some(path) = run.changed()? {
        return Err(JournalError::Changed { path, originals: folder.originals(journal.number) });
    }
    interrupted()?;
    folder.begin(&journal)?;
    run.restore().map_err(|error| JournalError::Half { error: Box::new(error) })?;
    Ok(undone(&folder, &journal))
}

fn undone(folder: &Folder, journal: &Journal) -> Undone {
    let left = folder.numbers().map_or(0, |numbers| numbers.len());
    folder.tidy();
    let (restored, removed): (Vec<_>, Vec<_>) = journal.files.iter().partition(|f| f.old.is_some());
    let names = |entries: Vec<&super::Entry>| entries.into_iter().map(|f| f.name.clone()).collect();
    Undone { restored: names(restored), removed: names(removed), left }
}
