//! The checkpoints for the paths on the command line.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::output;
use crate::checkpoint::platform::shown;
use crate::checkpoint::{ForeignFiles, Found, find_checkpoints};
use crate::knowledge::directories::Directories;
use crate::knowledge::source::DataError;
use crate::report::model::UncheckedPath;

/// The checkpoints to check, and the paths that cannot be checked.
#[derive(Default)]
pub struct Targets {
    /// Checkpoint directories, each once, in the order of the arguments.
    pub dirs: Vec<PathBuf>,
    /// Paths that are missing, contain no checkpoint, or cannot be listed.
    pub unchecked: Vec<UncheckedPath>,
}

/// Finds the checkpoints for the paths given by the user. Notes on standard error name weights that are not read, unless
/// `quiet`.
///
/// # Errors
/// [`DataError`] when the built-in kinds of directories are malformed.
pub fn targets(paths: &[PathBuf], quiet: bool) -> Result<Targets, DataError> {
    let kinds = Directories::embedded()?;
    let mut targets = Targets::default();
    let mut seen = BTreeSet::new();
    let mut outside: Vec<&Path> = Vec::new();
    for path in paths {
        let found = find_checkpoints(path, &|names| kinds.recognise(names));
        for (folder, error) in &found.unlisted {
            let reason = format!("cannot be listed: {error}");
            targets.unchecked.push(UncheckedPath { path: shown(folder), reason });
        }
        if let Some(reason) = nothing(path, &found) {
            // pre-commit passes all files of a commit; those outside of checkpoints are no reason to fail.
            if path.is_file() && found.foreign.is_empty() {
                outside.push(path);
            } else if found.unlisted.is_empty() || !found.foreign.is_empty() {
                targets.unchecked.push(UncheckedPath { path: shown(path), reason });
            }
            continue;
        }
        if !found.foreign.is_empty() && !quiet {
            output::note(&output::safe(&format!("note: {}: {}", path.display(), unread(path, &found))));
        }
        // pre-commit passes several files of one checkpoint; it is checked once.
        let new = found.checkpoints.into_iter();
        targets.dirs.extend(new.filter(|dir| seen.insert(dir.canonicalize().unwrap_or_else(|_| dir.clone()))));
    }
    if let Some(first) = outside.first().filter(|_| targets.dirs.is_empty() && targets.unchecked.is_empty()) {
        let more = match outside.len().saturating_sub(1) {
            0 => String::new(),
            n => format!(" (and {n} more files)"),
        };
        output::note(&output::safe(&format!("note: {}: the file belongs to no checkpoint{more}", first.display())));
    }
    Ok(targets)
}

/// Why there is nothing to check at a path; `None` if there is a checkpoint.
pub fn nothing(path: &Path, found: &Found) -> Option<String> {
    if !found.checkpoints.is_empty() {
        return None;
    }
    if !path.exists() {
        return Some("no such file or directory".to_owned());
    }
    if !found.foreign.is_empty() {
        return Some(format!("nothing to check: {}", unread(path, found)));
    }
    if let Some((folder, error)) = found.unlisted.first() {
        return Some(format!("{} cannot be listed: {error}", folder.display()));
    }
    Some("no checkpoint found (no config.json, adapter_config.json, index or *.safetensors)".to_owned())
}

/// Names the weights that are not read: `llama.gguf is GGUF, which is not read`.
fn unread(path: &Path, found: &Found) -> String {
    let sentence = |(format, files): (&&str, &ForeignFiles)| {
        let below = files.first.strip_prefix(path).unwrap_or(&files.first);
        let file = if below.as_os_str().is_empty() { Path::new(path.file_name().unwrap_or_default()) } else { below };
        match files.count.saturating_sub(1) {
            0 => format!("{} is {format}, which is not read", file.display()),
            n => format!("{} (and {n} more) is {format}, which is not read", file.display()),
        }
    };
    found.foreign.iter().map(sentence).collect::<Vec<_>>().join("; ")
}
