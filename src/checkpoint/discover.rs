//! Finds the checkpoints for a path given by the user.

use std::fs;
use std::path::{Path, PathBuf};

/// Depth of folders to which checkpoints are searched for.
const MAX_DEPTH: usize = 6;

/// The checkpoint directories at or below `path`, sorted.
///
/// A file stands for its checkpoint, if any ([`owner`]). A directory that is a checkpoint is the only result, and
/// folders inside it (`checkpoint-500`, ONNX copies) are not searched; any other directory is searched to a depth of
/// six. Hidden folders and links to folders are not followed. A path that does not exist is returned unchanged, so that
/// opening it reports the error.
#[must_use]
pub fn find_checkpoints(path: &Path) -> Vec<PathBuf> {
    if path.is_dir() {
        let mut found = Vec::new();
        search(path, MAX_DEPTH, &mut found);
        found.sort();
        return found;
    }
    if path.exists() {
        return owner(path).into_iter().collect();
    }
    vec![path.to_owned()]
}

/// The checkpoint that a file belongs to, whether or not the file exists: the nearest folder above it that is a
/// checkpoint. The search ends at the root of the git work tree and, for a relative path, at the current directory.
#[must_use]
pub fn owner(file: &Path) -> Option<PathBuf> {
    for dir in file.ancestors().skip(1).take(MAX_DEPTH) {
        let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
        if is_checkpoint(dir) {
            return Some(dir.to_owned());
        }
        if dir.join(".git").symlink_metadata().is_ok() {
            return None;
        }
    }
    None
}

fn search(dir: &Path, depth: usize, found: &mut Vec<PathBuf>) {
    let Ok(entries) = fs::read_dir(dir) else { return };
    let mut folders = Vec::new();
    for entry in entries.flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let is_folder = entry.file_type().is_ok_and(|t| t.is_dir());
        if !is_folder && marks_checkpoint(&name) {
            found.push(dir.to_owned());
            return;
        }
        if is_folder && !name.starts_with('.') {
            folders.push(entry.path());
        }
    }
    if let Some(depth) = depth.checked_sub(1) {
        for folder in folders {
            search(&folder, depth, found);
        }
    }
}

/// Whether a directory is a checkpoint itself.
#[must_use]
pub fn is_checkpoint(dir: &Path) -> bool {
    let is_file = |entry: &fs::DirEntry| !entry.file_type().is_ok_and(|t| t.is_dir());
    let marks = |entry: fs::DirEntry| is_file(&entry) && marks_checkpoint(&entry.file_name().to_string_lossy());
    fs::read_dir(dir).is_ok_and(|entries| entries.flatten().any(marks))
}

/// Whether a file of this name makes its directory a checkpoint.
fn marks_checkpoint(name: &str) -> bool {
    !name.starts_with('.')
        && (name == "config.json"
            || name == "adapter_config.json"
            || name.ends_with(".safetensors")
            || name.ends_with(".safetensors.index.json")
            || name == "pytorch_model.bin.index.json")
}
