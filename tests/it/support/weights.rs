//! Shards that tests can edit.

use std::fs;
use std::path::Path;

use serde_json::{Map, Value, json};

/// A tensor with its bytes.
pub struct Tensor {
    pub name: String,
    pub dtype: String,
    pub shape: Vec<u64>,
    pub bytes: Vec<u8>,
}

/// A sound shard.
pub struct Shard {
    pub file: String,
    pub tensors: Vec<Tensor>,
}

/// All shards of a checkpoint.
#[derive(Default)]
pub struct Weights {
    pub shards: Vec<Shard>,
}

/// Bytes per element; 2 for an unknown type.
fn width(dtype: &str) -> u64 {
    match dtype {
        "F64" | "I64" | "U64" => 8,
        "F32" | "I32" | "U32" => 4,
        "U8" | "I8" | "BOOL" | "F8_E4M3" => 1,
        _ => 2,
    }
}

impl Shard {
    pub fn new(file: &str) -> Self {
        Self { file: file.to_owned(), tensors: Vec::new() }
    }

    /// Adds a tensor of small numbers.
    pub fn add(&mut self, name: &str, dtype: &str, shape: &[u64]) {
        let len = usize::try_from(shape.iter().product::<u64>() * width(dtype)).expect("a small tensor");
        let bytes = [0x12, 0x3c].into_iter().cycle().take(len).collect();
        self.tensors.push(Tensor { name: name.to_owned(), dtype: dtype.to_owned(), shape: shape.to_owned(), bytes });
    }

    fn read(path: &Path) -> Self {
        let bytes = fs::read(path).expect("a shard");
        let (header, data) = split(&bytes);
        let header: Map<String, Value> = serde_json::from_str(header).expect("a sound header");
        let entries = header.into_iter().filter(|(name, _)| name != "__metadata__");
        let tensors = entries
            .map(|(name, entry)| {
                let number = |pointer: &str| {
                    usize::try_from(entry.pointer(pointer).and_then(Value::as_u64).expect("an offset")).expect("small")
                };
                Tensor {
                    name,
                    dtype: entry["dtype"].as_str().expect("a dtype").to_owned(),
                    shape: serde_json::from_value(entry["shape"].clone()).expect("a shape"),
                    bytes: data[number("/data_offsets/0")..number("/data_offsets/1")].to_vec(),
                }
            })
            .collect();
        Self { file: path.file_name().expect("a name").to_string_lossy().into_owned(), tensors }
    }

    fn write(&self, dir: &Path) {
        let mut header = Map::from_iter([("__metadata__".to_owned(), json!({ "format": "pt" }))]);
        let mut data = Vec::new();
        for tensor in &self.tensors {
            let begin = data.len();
            data.extend_from_slice(&tensor.bytes);
            let entry = json!({ "dtype": tensor.dtype, "shape": tensor.shape, "data_offsets": [begin, data.len()] });
            header.insert(tensor.name.clone(), entry);
        }
        let mut header = Value::Object(header).to_string();
        while !header.len().is_multiple_of(8) {
            header.push(' ');
        }
        fs::write(dir.join(&self.file), join(header.as_bytes(), &data)).expect("write");
    }
}

/// Header text and data of a shard.
pub fn split(bytes: &[u8]) -> (&str, &[u8]) {
    let (length, rest) = bytes.split_first_chunk::<8>().expect("eight bytes");
    let (header, data) = rest.split_at(usize::try_from(u64::from_le_bytes(*length)).expect("small"));
    (std::str::from_utf8(header).expect("text"), data)
}

/// The bytes of a shard, with the correct header length.
pub fn join(header: &[u8], data: &[u8]) -> Vec<u8> {
    let length = u64::try_from(header.len()).expect("small").to_le_bytes();
    [&length, header, data].concat()
}

const INDEX: &str = "model.safetensors.index.json";

impl Weights {
    /// All shards of a directory.
    pub fn read(dir: &Path) -> Self {
        let mut names: Vec<_> = fs::read_dir(dir).expect("a directory").map(|e| e.expect("an entry").path()).collect();
        names.sort();
        let shards =
            names.iter().filter(|p| p.to_string_lossy().ends_with(".safetensors")).map(|p| Shard::read(p)).collect();
        Self { shards }
    }

    pub fn write(&self, dir: &Path) {
        self.shards.iter().for_each(|s| s.write(dir));
    }

    /// Writes an index of the shards.
    pub fn write_index(&self, dir: &Path) {
        let mut map = Map::new();
        let mut total = 0;
        for shard in &self.shards {
            for tensor in &shard.tensors {
                map.insert(tensor.name.clone(), shard.file.clone().into());
                total += tensor.bytes.len();
            }
        }
        map.sort_keys();
        let index = json!({ "metadata": { "total_size": total }, "weight_map": map });
        fs::write(dir.join(INDEX), serde_json::to_string_pretty(&index).expect("JSON")).expect("write");
    }

    /// Writes the shards, and the index if there was one. Empty shards are deleted.
    pub fn write_back(&mut self, dir: &Path) {
        self.shards.retain(|shard| {
            let keep = !shard.tensors.is_empty();
            if !keep {
                fs::remove_file(dir.join(&shard.file)).expect("remove");
            }
            keep
        });
        self.write(dir);
        if dir.join(INDEX).exists() {
            self.write_index(dir);
        }
    }

    /// The shard that contains this tensor.
    pub fn holder(&mut self, name: &str) -> &mut Shard {
        let found = self.shards.iter_mut().find(|s| s.tensors.iter().any(|t| t.name == name));
        found.unwrap_or_else(|| panic!("no tensor {name}"))
    }

    /// Panics when no tensor name has this prefix: the case would change nothing.
    pub fn assert_prefix(&self, prefix: &str) {
        let found = self.shards.iter().flat_map(|s| &s.tensors).any(|t| t.name.starts_with(prefix));
        assert!(found, "no tensor starts with {prefix}");
    }
}
