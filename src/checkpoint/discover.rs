//! Finds the checkpoints for a path given by the user, and names the weights beside them that are not read.

use super::files;
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

/// Folders to leave out of a search, when the names in their directory mark it as one of a known kind.
///
/// Called with the sorted names in a directory; those of folders end with `/`. `None` for a directory of no known kind.
pub type Recognise<'r> = &'r dyn Fn(&[String]) -> Option<Vec<String>>;

/// Finds the checkpoint directories at or below `path`, to a depth of six.
///
/// A file stands for its checkpoint, if any, even when it was deleted ([`owner`]). A directory is a result when it has a file of
/// a checkpoint, or when `recognise` knows its kind. The folders in it are searched too: the parts of a pipeline,
/// `checkpoint-500`. Below the first level, a config without weights makes no checkpoint there: it may be any program's. Hidden
/// folders and links to folders are not followed.
#[must_use]
pub fn find_checkpoints(path: &Path, recognise: Recognise<'_>) -> Found {
    let mut found = Found::default();
    if path.is_dir() {
        found.search(path, MAX_DEPTH, 0, recognise);
        found.checkpoints.sort();
        found.unlisted.sort_by(|(a, _), (b, _)| a.cmp(b));
    } else if let Some(owner) = owner(path) {
        found.checkpoints.push(owner);
    } else if path.exists()
        && let Some(format) = foreign_format(&path.file_name().unwrap_or_default().to_string_lossy())
    {
        found.add_foreign(format, path.to_owned());
    }
    found
}

impl Found {
    /// `inside`: number of folders below the nearest checkpoint above; 0 when there is none.
    fn search(&mut self, dir: &Path, depth: usize, inside: usize, recognise: Recognise<'_>) {
        let entries = match list(dir) {
            Ok(entries) => entries,
            // Only what is inside of a checkpoint may be left out.
            Err(_) if inside > 0 => return,
            Err(error) => return self.unlisted.push((dir.to_owned(), error)),
        };
        let named = |entry: ListedEntry| {
            let slash = if entry.is_folder { "/" } else { "" };
            (format!("{}{slash}", entry.name.to_string_lossy()), dir.join(entry.name))
        };
        let mut entries: Vec<(String, PathBuf)> = entries.flatten().map(named).collect();
        entries.retain(|(name, _)| !name.starts_with('.'));
        entries.sort_unstable();
        let names: Vec<String> = entries.iter().map(|(name, _)| name.clone()).collect();
        let recognised = recognise(&names);
        let is_checkpoint = match inside {
            0 => recognised.is_some() || names.iter().any(|name| marks_checkpoint(name)),
            levels => names.iter().any(|name| marks_checkpoint(name) && (levels == 1 || name != files::CONFIG)),
        };
        if is_checkpoint {
            self.checkpoints.push(dir.to_owned());
        }
        if !is_checkpoint && inside == 0 {
            for (name, path) in &entries {
                if let Some(format) = foreign_format(name) {
                    self.add_foreign(format, path.clone());
                }
            }
        }
        let Some(depth) = depth.checked_sub(1) else { return };
        let left_out = recognised.unwrap_or_default();
        let inside = if is_checkpoint { 1 } else { inside.saturating_add(usize::from(inside > 0)) };
        for (name, path) in &entries {
            if name.ends_with('/') && !left_out.contains(name) {
                self.search(path, depth, inside, recognise);
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

/// The format of weights that is not read, by the name of a file.
fn foreign_format(name: &str) -> Option<&'static str> {
    let (stem, ending) = name.rsplit_once('.')?;
    Some(match ending {
        "gguf" => "GGUF",
        "onnx" => "ONNX",
        "pth" | "pt" | "ckpt" => "a PyTorch pickle",
        // Other files of this ending hold any data.
        "bin" if stem.contains("model") => "a PyTorch pickle",
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
        && (name == files::CONFIG
            || name == files::ADAPTER_CONFIG
            || name.ends_with(".safetensors")
            || name.ends_with(".safetensors.index.json")
            || name == files::PICKLE_INDEX)
}
