//! The directory of a case: a checkpoint, and files around it that must not be touched.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use rustix::fs::{CWD, FileType, Mode, mknodat};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support;

/// The shard of most cases.
pub const SHARD: &str = "model.safetensors";
/// The index.
pub const INDEX: &str = "model.safetensors.index.json";

/// Directory of a case.
pub struct Dir {
    /// The checkpoint.
    pub root: PathBuf,
    /// The directory around it, with files that a path could reach from inside the checkpoint.
    pub outer: PathBuf,
}

impl Dir {
    /// Creates the surroundings below `room`, and an empty checkpoint.
    pub fn new(room: &Path) -> Self {
        let outer = room.join("outer");
        let root = outer.join("checkpoint");
        fs::create_dir_all(&root).unwrap();
        let dir = Self { root, outer };
        for name in ["evil.safetensors", "evil.py", "evil.json", "x.safetensors"] {
            fs::write(dir.outer.join(name), file(header(&entry("a", "U8", "[1]", 0, 1)), 1)).unwrap();
        }
        dir
    }

    /// Writes a file of the checkpoint.
    pub fn put(&self, name: &str, bytes: impl AsRef<[u8]>) {
        fs::write(self.root.join(name), bytes).unwrap();
    }

    /// A checkpoint of an unknown class with one tensor, so that all findings are about the case.
    pub fn small(&self) {
        self.put("config.json", r#"{"architectures": ["Unheard"], "model_type": "llama"}"#);
        self.entries(&entry("a", "U8", "[1]", 0, 1), 1);
    }

    /// The small checkpoint with another config.
    pub fn config(&self, text: impl AsRef<[u8]>) {
        self.small();
        self.put("config.json", text);
    }

    /// The small checkpoint with this shard.
    pub fn shard(&self, bytes: impl AsRef<[u8]>) {
        self.small();
        self.put(SHARD, bytes);
    }

    /// Writes a shard with these entries and `data` bytes.
    pub fn entries(&self, entries: &str, data: usize) {
        self.put(SHARD, file(header(entries), data));
    }

    /// The small checkpoint with a shard of these entries.
    pub fn tensors(&self, entries: &str, data: usize) {
        self.small();
        self.entries(entries, data);
    }

    /// The small checkpoint in two shards with this index.
    pub fn index(&self, text: impl AsRef<[u8]>) {
        self.small();
        fs::remove_file(self.root.join(SHARD)).unwrap();
        for (number, name) in [(1, "a"), (2, "b")] {
            self.put(&numbered(number), file(header(&entry(name, "U8", "[4]", 0, 4)), 4));
        }
        self.put(INDEX, text);
    }

    /// The small checkpoint in two shards, with these members in the `weight_map`.
    pub fn map(&self, members: &str) {
        self.index(format!(r#"{{"metadata": {{"total_size": 8}}, "weight_map": {{{members}}}}}"#));
    }

    /// A complete tiny Llama, including a tokenizer.
    pub fn llama(&self) {
        static BASE: LazyLock<TempDir> = LazyLock::new(|| {
            let dir = TempDir::new().unwrap();
            support::make_base("llama", dir.path());
            dir
        });
        support::copy(BASE.path(), &self.root);
    }

    /// The Llama with a value of its config changed; `null` is a value too.
    pub fn set(&self, pointer: &str, value: &Value) {
        self.llama();
        self.edit("config.json", pointer, value);
    }

    /// Sets a value of a document.
    pub fn edit(&self, name: &str, pointer: &str, value: &Value) {
        let path = self.root.join(name);
        let mut document: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap_or_else(|_| json!({}));
        let (above, key) = pointer.rsplit_once('/').unwrap();
        let above = document.pointer_mut(above).unwrap().as_object_mut().unwrap();
        above.insert(key.to_owned(), value.clone());
        fs::write(path, serde_json::to_string_pretty(&document).unwrap()).unwrap();
    }

    /// Creates a symbolic link.
    pub fn link(&self, name: &str, target: impl AsRef<Path>) {
        let _ = fs::remove_file(self.root.join(name));
        std::os::unix::fs::symlink(target, self.root.join(name)).unwrap();
    }

    /// Creates a FIFO.
    pub fn fifo(&self, name: &str) {
        let _ = fs::remove_file(self.root.join(name));
        mknodat(CWD, self.root.join(name), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    }

    /// Creates a directory.
    pub fn folder(&self, name: &str) {
        let _ = fs::remove_file(self.root.join(name));
        fs::create_dir(self.root.join(name)).unwrap();
    }

    /// Creates a sparse file of this size.
    pub fn sparse(&self, name: &str, bytes: u64) {
        File::create(self.root.join(name)).unwrap().set_len(bytes).unwrap();
    }

    /// Removes a file.
    pub fn remove(&self, name: &str) {
        fs::remove_file(self.root.join(name)).unwrap();
    }
}

/// The name of one of two shards.
pub fn numbered(number: usize) -> String {
    format!("model-{number:05}-of-00002.safetensors")
}

/// A file with this header and `data` bytes.
pub fn file(header: impl AsRef<[u8]>, data: usize) -> Vec<u8> {
    let header = header.as_ref();
    let mut bytes = u64::try_from(header.len()).unwrap().to_le_bytes().to_vec();
    bytes.extend(header);
    bytes.resize(bytes.len() + data, 7);
    bytes
}

/// A header with these entries.
pub fn header(entries: &str) -> String {
    format!(r#"{{"__metadata__":{{"format":"pt"}},{entries}}}"#)
}

/// One entry of a header.
pub fn entry(name: &str, dtype: &str, shape: &str, begin: u64, end: u64) -> String {
    format!(r#""{name}":{{"dtype":"{dtype}","shape":{shape},"data_offsets":[{begin},{end}]}}"#)
}

/// `depth` opening brackets, then as many closing ones.
pub fn nested(open: &str, close: &str, depth: usize) -> String {
    format!("{}0{}", open.repeat(depth), close.repeat(depth))
}
