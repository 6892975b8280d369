//! `undo`.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::bail;

use super::args::UndoArgs;
use super::exit::CLEAN;
use super::{fix, output, paths, signals};
use crate::checkpoint::journal::StateFolder;
use crate::checkpoint::{REPAIR_FOLDER, escape};
use crate::surgery::{Trust, Undone, interrupted, journal};

/// Runs `undo`. One checkpoint that cannot be undone does not keep the others from it.
pub fn run(args: &UndoArgs) -> anyhow::Result<u8> {
    signals::install()?;
    let trust = Trust { user: StateFolder::of_user(), adopts: args.adopt_journal };
    let dirs = repaired(&args.paths)?;
    let [dir] = dirs.as_slice() else {
        if args.adopt_journal {
            bail!("--adopt-journal is for one checkpoint, and {} of these have a repair", dirs.len());
        }
        return all(&dirs, &trust);
    };
    output::print(&undone(dir, &journal::undo(dir, &trust)?, "")?)?;
    Ok(CLEAN)
}

/// The checkpoints of these paths that a repair has changed; the paths themselves if there is none.
fn repaired(given: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let has_repair = |dir: &PathBuf| dir.join(REPAIR_FOLDER).symlink_metadata().is_ok();
    let (mut dirs, mut seen) = (Vec::new(), BTreeSet::new());
    for path in given {
        let found = paths::targets(std::slice::from_ref(path), true)?.dirs;
        // A directory may have lost what made it a checkpoint.
        let mut found: Vec<PathBuf> = [path.clone()].into_iter().chain(found).filter(has_repair).collect();
        if found.is_empty() {
            found.push(path.clone());
        }
        dirs.extend(found.into_iter().filter(|dir| seen.insert(dir.canonicalize().unwrap_or_else(|_| dir.clone()))));
    }
    Ok(dirs)
}

/// Undoes the latest repair of each. Fails if one of them cannot be undone, after the others.
fn all(dirs: &[PathBuf], trust: &Trust) -> anyhow::Result<u8> {
    let mut failed = 0_usize;
    for dir in dirs {
        interrupted()?;
        let shown = escape(&dir.display().to_string(), 300);
        match journal::undo(dir, trust) {
            Ok(done) => output::print(&undone(dir, &done, &format!("{shown}: "))?)?,
            Err(error) => {
                interrupted()?;
                failed = failed.saturating_add(1);
                output::note(&output::safe(&format!("error: {error}")));
            }
        }
    }
    if failed > 0 {
        bail!("{failed} of {} checkpoints were not undone", dirs.len());
    }
    Ok(CLEAN)
}

/// What was undone in a directory, one file per line after `prefix`.
fn undone(dir: &Path, done: &Undone, prefix: &str) -> Result<String, std::fmt::Error> {
    fix::show_recovery(dir, &done.recovery);
    let mut out = String::new();
    for (what, names) in [("restored", &done.restored), ("removed", &done.removed)] {
        for name in names {
            writeln!(out, "{prefix}{what} {}", escape(name, 200))?;
        }
    }
    if done.left > 0 {
        let earlier = if done.left == 1 { "repair" } else { "repairs" };
        writeln!(out, "{prefix}{} earlier {earlier} can be undone too", done.left)?;
    }
    if let Some(leftover) = &done.leftover {
        output::note(&output::safe(&leftover.to_string()));
    }
    Ok(out)
}
