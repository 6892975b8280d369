//! Finds the checkpoints for a path given by the user, and names the weights beside them that are not read.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use super::list::{ListedEntry, list};

/// Depth of folders to which checkpoints are searched for.
const MAX_DEPTH: usize = 6;

/// The result of a search for checkpoints.
#[derive(Debug, Default)]
pub struct Found {
    /// The checkpoint directories, sorted.
    pub checkpoints: Vec<PathBuf>,
    /// Weights outside of them in formats that are not read, by the name of the format.
    pub foreign: BTreeMap<&'static str, ForeignFiles>,
    /// Folders that cannot be listed, with the error.
    pub unlisted: Vec<(PathBuf, io::Error)>,
}

/// Files or folders of one format that is not read.
#[derive(Debug, PartialEq, Eq)]
pub struct ForeignFiles {
    /// The first one by name.
    pub first: PathBuf,
    /// Their number.
    pub count: usize,
}

/// Finds the checkpoint directories at or below `path`.
///
/// A file stands for its checkpoint, if any, even when it was deleted ([`owner`]). A directory that is a checkpoint is the only result, and
/// folders inside it (`checkpoint-500`, ONNX copies) are not searched; any other directory is searched to a depth of
/// six. Hidden folders and links to folders are not followed.
#[must_use]
pub fn find_checkpoints(path: &Path) -> Found {
    let mut found = Found::default();
    if path.is_dir() {
        found.search(path, MAX_DEPTH);
        found.checkpoints.sort();
        found.unlisted.sort_by(|(a, _), (b, _)| a.cmp(b));
    } else if let Some(owner) = owner(path) {
        found.checkpoints.push(owner);
    } else if path.exists()
        && let Some(format) = foreign_format(&path.file_name().unwrap_or_default().to_string_lossy(), false)
    {
        found.add_foreign(format, path.to_owned());
    }
    found
}

impl Found {
    fn search(&mut self, dir: &Path, depth: usize) {
        let entries = match list(dir) {
            Ok(entries) => entries,
            Err(error) => return self.unlisted.push((dir.to_owned(), error)),
        };
        let mut folders = Vec::new();
        let mut foreign = Vec::new();
        for entry in entries.flatten() {
            let name = entry.name.to_string_lossy();
            let path = dir.join(&entry.name);
            let is_folder = entry.is_folder;
            if !is_folder && marks_checkpoint(&name) {
                return self.checkpoints.push(dir.to_owned());
            }
            if let Some(format) = foreign_format(&name, is_folder) {
                foreign.push((format, path));
            } else if is_folder && !name.starts_with('.') {
                folders.push(path);
            }
        }
        for (format, path) in foreign {
            self.add_foreign(format, path);
        }
        if let Some(depth) = depth.checked_sub(1) {
            for folder in folders {
                self.search(&folder, depth);
            }
        }
    }

    fn add_foreign(&mut self, format: &'static str, path: PathBuf) {
        match self.foreign.get_mut(format) {
            Some(files) => {
                files.count = files.count.saturating_add(1);
                if path < files.first {
                    files.first = path;
                }
            }
            None => _ = self.foreign.insert(format, ForeignFiles { first: path, count: 1 }),
        }
    }
}

/// The format of weights that is not read, by the name of a file or folder.
fn foreign_format(name: &str, is_folder: bool) -> Option<&'static str> {
    if is_folder {
        let step = name.strip_prefix("global_step")?;
        let is_step = !step.is_empty() && step.chars().all(|c| c.is_ascii_digit());
        return is_step.then_some("a DeepSpeed checkpoint");
    }
    let (stem, ending) = name.rsplit_once('.')?;
    Some(match ending {
        "gguf" => "GGUF",
        "onnx" => "ONNX",
        "pth" | "pt" | "ckpt" => "a PyTorch pickle",
        // Other files of this ending hold any data.
        "bin" if stem.contains("model") => "a PyTorch pickle",
        "distcp" => "a part of an FSDP checkpoint",
        "msgpack" => "Flax msgpack",
        "h5" | "keras" => "TensorFlow HDF5",
        "tflite" => "TensorFlow Lite",
        "nemo" => "a NeMo archive",
        "pdparams" => "Paddle",
        _ => return None,
    })
}

/// The checkpoint that a file belongs to, whether or not the file exists: the nearest folder above it that is a
/// checkpoint. The search ends at the root of the git work tree and, for a relative path, at the current directory.
#[must_use]
fn owner(file: &Path) -> Option<PathBuf> {
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

/// Whether a directory is a checkpoint itself.
#[must_use]
pub fn is_checkpoint(dir: &Path) -> bool {
    let marks = |entry: ListedEntry| !entry.is_folder && marks_checkpoint(&entry.name.to_string_lossy());
    list(dir).is_ok_and(|entries| entries.flatten().any(marks))
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
