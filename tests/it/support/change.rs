//! Changes of a base by a case.

use std::fs;
use std::path::{Path, PathBuf};

use ckpt_doctor::knowledge::{Expression, Scope};
use serde::Deserialize;
use serde_json::Value;

use super::base;
use super::pickle::StateDict;
use super::weights::{Shard, Tensor, Weights, join, split};

/// FIFOs and links.
#[cfg(unix)]
mod special {
    pub use std::os::unix::fs::symlink;

    pub fn fifo(path: &std::path::Path) -> std::io::Result<()> {
        use rustix::fs::{CWD, FileType, Mode, mknodat};
        Ok(mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)?)
    }

    /// The journal of a repair without files that the user of the tests began in the checkpoint `dir`.
    pub fn journal(dir: &std::path::Path) -> std::io::Result<()> {
        use ckpt_doctor::checkpoint::journal::{InodeIdentity, Journal, VERSION};
        let folder = dir.join(".ckpt-doctor");
        std::fs::create_dir(&folder)?;
        let key = ckpt_doctor::surgery::journal::key(&crate::support::user(), dir).map_err(std::io::Error::other)?;
        let at = Some(InodeIdentity::of(&folder)?);
        let journal = Journal { version: VERSION, number: 1, folder: at, files: Vec::new(), authenticator: None };
        std::fs::write(folder.join("journal.json"), serde_json::to_vec(&journal.signed(&key))?)
    }
}

/// Windows has no FIFOs.
#[cfg(windows)]
mod special {
    pub use std::os::windows::fs::symlink_file as symlink;

    pub fn fifo(_: &std::path::Path) -> std::io::Result<()> {
        Err(std::io::ErrorKind::Unsupported.into())
    }

    pub fn journal(_: &std::path::Path) -> std::io::Result<()> {
        Err(std::io::ErrorKind::Unsupported.into())
    }
}

pub use special::journal as own_journal;

/// One change. Changes of tensors keep shards and index consistent; changes of headers and bytes do not.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Change {
    /// Removes a file.
    Remove(String),
    /// Renames a file.
    Move { from: String, to: String },
    /// Copies a file.
    Copy { from: String, to: String },
    /// Writes a file; replaces an existing one.
    Write { file: String, bytes: Bytes },
    /// Adds to the end of a file.
    Append { file: String, bytes: Bytes },
    /// Prepends bytes to a file.
    Prepend { file: String, bytes: Bytes },
    /// Removes bytes from the end.
    Cut { file: String, bytes: usize },
    /// Creates a sparse file of this size.
    Sparse { file: String, bytes: u64 },
    /// Replaces text that occurs exactly once.
    Replace { file: String, find: String, with: String },
    /// Replaces every occurrence of a text.
    ReplaceAll { file: String, find: String, with: String },
    /// Sets a JSON value.
    Set { file: String, at: String, to: Value },
    /// Removes a member of a JSON object or list.
    Drop { file: String, at: String },
    /// Stores a text file in another encoding: `utf-16le`, `utf-8-bom`.
    Encode { file: String, to: String },
    /// Creates a FIFO.
    Fifo(String),
    /// Creates a symbolic link.
    Link { file: String, to: String },
    /// Begins a repair as the user of the tests, and leaves its journal.
    OwnJournal,
    /// Creates a folder.
    Folder(String),
    /// Renames the checkpoint's directory.
    Directory(String),

    /// Adds a tensor to the last shard, or to the given one.
    AddTensor {
        name: String,
        shape: Vec<u64>,
        #[serde(default)]
        dtype: Option<String>,
        #[serde(default)]
        file: Option<String>,
    },
    /// Removes the tensors whose names have this prefix.
    DropTensors(String),
    /// Replaces a prefix of tensor names.
    RenameTensors { from: String, to: String },
    /// Gives a tensor another shape.
    Reshape { name: String, shape: Vec<u64> },
    /// Changes the dtype of every tensor, in name and width.
    Retype { name: String, dtype: String },
    /// Overwrites bytes of a tensor, from byte `at` on.
    Poke { tensor: String, at: usize, bytes: Bytes },
    /// Replaces each tensor whose name has this ending with others: ending, dtype and dimensions. Dimensions are
    /// expressions over `rows` and `cols` of the replaced tensor.
    Pack { ending: String, into: Vec<(String, String, Vec<String>)> },
    /// Writes a shard with these tensors that is not in the index.
    Shard { file: String, tensors: Vec<(String, Vec<u64>)> },

    /// Replaces a shard by a pickle of its tensors, as `torch.save` writes it.
    Pickle {
        /// The shard; `model.safetensors` when missing.
        #[serde(default)]
        from: Option<String>,
        file: String,
        /// In the format before torch 1.6.
        #[serde(default)]
        legacy: bool,
        /// The key under which the tensors are.
        #[serde(default)]
        under: Option<String>,
        /// Module and name of a function that the pickle calls.
        #[serde(default)]
        calls: Option<(String, String)>,
        /// Numbers of storages that are missing.
        #[serde(default)]
        lost: Vec<usize>,
        /// Numbers of storages that lack their last eight bytes.
        #[serde(default)]
        shortened: Vec<usize>,
    },

    /// Sets a value in a shard's header.
    Header { file: String, at: String, to: Value },
    /// Removes a value from a shard's header.
    HeaderDrop { file: String, at: String },
    /// Replaces text in a shard's header; it must occur once.
    HeaderReplace { file: String, find: String, with: String },
    /// Replaces the whole header.
    HeaderBytes { file: String, bytes: Bytes },
    /// Prepends bytes to a shard's header.
    HeaderPrepend { file: String, bytes: Bytes },
    /// Replaces the data of a shard.
    Data { file: String, bytes: Bytes },
    /// Appends bytes to a shard's header.
    HeaderAppend { file: String, bytes: Bytes },
    /// Replaces the first eight bytes.
    HeaderLength { file: String, bytes: Bytes },
}

/// Bytes: text, hexadecimal, or repeated parts.
#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
pub enum Bytes {
    Text(String),
    Parts(Vec<Part>),
}

/// Bytes, optionally repeated.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    #[serde(default)]
    text: String,
    #[serde(default)]
    hex: String,
    #[serde(default)]
    times: Option<usize>,
}

impl Bytes {
    fn get(&self) -> Vec<u8> {
        let parts = match self {
            Self::Text(text) => return text.clone().into_bytes(),
            Self::Parts(parts) => parts,
        };
        let mut out = Vec::new();
        for part in parts {
            let digits: Vec<char> = part.hex.chars().filter(|c| !c.is_whitespace()).collect();
            let byte = |pair: &[char]| u8::from_str_radix(&pair.iter().collect::<String>(), 16).expect("hexadecimal");
            let mut bytes: Vec<u8> = digits.chunks(2).map(byte).collect();
            bytes.extend_from_slice(part.text.as_bytes());
            out.extend(bytes.repeat(part.times.unwrap_or(1)));
        }
        out
    }
}

/// Builds a case's checkpoint below `room` and returns its directory.
pub fn make(case: &str, base: &Path, changes: &[Change], room: &Path) -> PathBuf {
    let named = changes.iter().find_map(|c| if let Change::Directory(name) = c { Some(name.as_str()) } else { None });
    let dir = room.join(named.unwrap_or("checkpoint"));
    base::copy(base, &dir);
    apply_all(case, changes, &dir);
    dir
}

/// Applies the changes in order.
pub fn apply_all(case: &str, changes: &[Change], dir: &Path) {
    for change in changes {
        apply(change, dir).unwrap_or_else(|e| panic!("{case}: {change:?}: {e}"));
    }
}

fn apply(change: &Change, dir: &Path) -> std::io::Result<()> {
    let at = |file: &str| dir.join(file);
    match change {
        Change::Remove(file) => fs::remove_file(at(file)),
        Change::Move { from, to } => fs::rename(at(from), at(to)),
        Change::Copy { from, to } => fs::copy(at(from), at(to)).map(|_| ()),
        Change::Write { file, bytes } => fs::write(at(file), bytes.get()),
        Change::Append { file, bytes } => rewrite(&at(file), |old| [old, bytes.get()].concat()),
        Change::Prepend { file, bytes } => rewrite(&at(file), |old| [bytes.get(), old].concat()),
        Change::Cut { file, bytes } => rewrite(&at(file), |mut old| {
            old.truncate(old.len() - bytes);
            old
        }),
        Change::Sparse { file, bytes } => fs::File::create(at(file))?.set_len(*bytes),
        Change::Replace { file, find, with } => {
            rewrite(&at(file), |old| once(&String::from_utf8(old).expect("text"), find, with).into_bytes())
        }
        Change::ReplaceAll { file, find, with } => rewrite(&at(file), |old| {
            let text = String::from_utf8(old).expect("text");
            assert!(text.contains(find.as_str()), "{find} must stand there");
            text.replace(find.as_str(), with).into_bytes()
        }),
        Change::Set { file, at: pointer, to } => json(&at(file), |value| set(value, pointer, to)),
        Change::Drop { file, at: pointer } => json(&at(file), |value| drop_at(value, pointer)),
        Change::Encode { file, to } => rewrite(&at(file), |old| encode(&String::from_utf8(old).expect("text"), to)),
        Change::Fifo(file) => {
            let _ = fs::remove_file(at(file));
            special::fifo(&at(file))
        }
        Change::Link { file, to } => {
            let _ = fs::remove_file(at(file));
            special::symlink(to, at(file))
        }
        Change::OwnJournal => special::journal(dir),
        Change::Folder(name) => fs::create_dir(at(name)),
        Change::Directory(_) => Ok(()),
        Change::Header { .. }
        | Change::HeaderDrop { .. }
        | Change::HeaderReplace { .. }
        | Change::HeaderBytes { .. }
        | Change::HeaderAppend { .. }
        | Change::HeaderPrepend { .. }
        | Change::Data { .. }
        | Change::HeaderLength { .. } => header(change, dir),
        Change::Pickle { from, file, legacy, under, calls, lost, shortened } => {
            let mut state = StateDict {
                under: under.clone(),
                calls: calls.clone(),
                lost: lost.clone(),
                shortened: shortened.clone(),
                ..StateDict::default()
            };
            let from = from.as_deref().unwrap_or("model.safetensors");
            for tensor in Weights::read(dir).shards.into_iter().filter(|s| s.file == from).flat_map(|s| s.tensors) {
                state.add(&tensor.name, &tensor.dtype, &tensor.shape, tensor.bytes);
            }
            fs::remove_file(at(from))?;
            fs::write(at(file), if *legacy { state.legacy() } else { state.zip() })
        }
        Change::AddTensor { .. }
        | Change::DropTensors(_)
        | Change::RenameTensors { .. }
        | Change::Reshape { .. }
        | Change::Retype { .. }
        | Change::Poke { .. }
        | Change::Pack { .. }
        | Change::Shard { .. } => {
            tensors(change, dir);
            Ok(())
        }
    }
}

fn dimensions(shape: &[String], plain: &[u64]) -> Vec<u64> {
    let mut scope = Scope::new();
    scope.bind_int("rows", plain[0]);
    scope.bind_int("cols", plain[1]);
    let dimension = |source: &String| Expression::parse(source).expect("CEL").eval_u64(&scope).expect("a dimension");
    shape.iter().map(dimension).collect()
}

fn tensors(change: &Change, dir: &Path) {
    if let Change::Shard { file, tensors } = change {
        let mut shard = Shard::new(file);
        for (name, shape) in tensors {
            shard.add(name, "BF16", shape);
        }
        return Weights { shards: vec![shard] }.write(dir);
    }
    let mut weights = Weights::read(dir);
    match change {
        Change::Pack { ending, into } => {
            let mut packed = 0;
            for shard in &mut weights.shards {
                let (gone, kept) = std::mem::take(&mut shard.tensors)
                    .into_iter()
                    .partition(|t: &Tensor| t.shape.len() > 1 && t.name.ends_with(ending.as_str()));
                shard.tensors = kept;
                packed += gone.len();
                for tensor in gone {
                    let module = tensor.name.strip_suffix(".weight").unwrap_or(&tensor.name);
                    for (ending, dtype, shape) in into {
                        shard.add(&format!("{module}{ending}"), dtype, &dimensions(shape, &tensor.shape));
                    }
                }
            }
            assert!(packed > 0, "no tensor ends in {ending}");
        }
        Change::AddTensor { name, shape, dtype, file } => {
            let wanted = |s: &Shard| file.as_ref().is_none_or(|f| *f == s.file);
            let shard = weights.shards.iter_mut().rfind(|s| wanted(s)).expect("a shard of that name");
            shard.add(name, dtype.as_deref().unwrap_or("BF16"), shape);
        }
        Change::DropTensors(prefix) => {
            weights.assert_prefix(prefix);
            weights.shards.iter_mut().for_each(|s| s.tensors.retain(|t| !t.name.starts_with(prefix)));
        }
        Change::RenameTensors { from, to } => {
            weights.assert_prefix(from);
            for tensor in weights.shards.iter_mut().flat_map(|s| &mut s.tensors) {
                if let Some(rest) = tensor.name.strip_prefix(from.as_str()) {
                    tensor.name = format!("{to}{rest}");
                }
            }
        }
        Change::Reshape { name, shape } => {
            let shard = weights.holder(name);
            let place = shard.tensors.iter().position(|t| t.name == *name).expect("held");
            let old = shard.tensors.remove(place);
            shard.add(name, &old.dtype, shape);
        }
        Change::Retype { name, dtype } => {
            let shard = weights.holder(name);
            let place = shard.tensors.iter().position(|t| t.name == *name).expect("held");
            let old = shard.tensors.remove(place);
            shard.add(name, dtype, &old.shape);
        }
        Change::Poke { tensor: name, at, bytes } => {
            let shard = weights.holder(name);
            let tensor = shard.tensors.iter_mut().find(|t| t.name == *name).expect("held");
            let bytes = bytes.get();
            tensor.bytes[*at..*at + bytes.len()].copy_from_slice(&bytes);
        }
        other => panic!("{other:?} is no change of tensors"),
    }
    weights.write_back(dir);
}

fn header(change: &Change, dir: &Path) -> std::io::Result<()> {
    let with = |file: &String, edit: &dyn Fn(&str) -> Vec<u8>| {
        rewrite(&dir.join(file), |old| {
            let (header, data) = split(&old);
            join(&edit(header), data)
        })
    };
    let value = |header: &str, edit: &dyn Fn(&mut Value)| {
        let mut value = serde_json::from_str(header).expect("JSON");
        edit(&mut value);
        value.to_string().into_bytes()
    };
    match change {
        Change::Header { file, at, to } => with(file, &|old| value(old, &|v| set(v, at, to))),
        Change::HeaderDrop { file, at } => with(file, &|old| value(old, &|v| drop_at(v, at))),
        Change::HeaderReplace { file, find, with: text } => with(file, &|old| once(old, find, text).into_bytes()),
        Change::HeaderBytes { file, bytes } => with(file, &|_| bytes.get()),
        Change::HeaderAppend { file, bytes } => with(file, &|old| [old.as_bytes(), &bytes.get()].concat()),
        Change::HeaderPrepend { file, bytes } => with(file, &|old| [&bytes.get(), old.as_bytes()].concat()),
        Change::Data { file, bytes } => rewrite(&dir.join(file), |old| join(split(&old).0.as_bytes(), &bytes.get())),
        Change::HeaderLength { file, bytes } => rewrite(&dir.join(file), |old| [&bytes.get(), &old[8..]].concat()),
        other => panic!("{other:?} is no change of a header"),
    }
}

fn rewrite(path: &Path, edit: impl FnOnce(Vec<u8>) -> Vec<u8>) -> std::io::Result<()> {
    fs::write(path, edit(fs::read(path)?))
}

fn json(path: &Path, edit: impl FnOnce(&mut Value)) -> std::io::Result<()> {
    let mut value = serde_json::from_slice(&fs::read(path)?)?;
    edit(&mut value);
    fs::write(path, serde_json::to_string_pretty(&value)?)
}

fn once(text: &str, find: &str, with: &str) -> String {
    assert_eq!(text.matches(find).count(), 1, "{find} must stand there once");
    text.replace(find, with)
}

fn parent<'v>(value: &'v mut Value, pointer: &str) -> (&'v mut Value, String) {
    let (above, key) = pointer.rsplit_once('/').expect("a pointer");
    let above = value.pointer_mut(above).unwrap_or_else(|| panic!("{pointer} has no parent"));
    (above, key.replace("~1", "/").replace("~0", "~"))
}

fn set(value: &mut Value, pointer: &str, to: &Value) {
    match parent(value, pointer) {
        (Value::Object(map), key) => {
            map.insert(key, to.clone());
        }
        (Value::Array(items), key) => items[key.parse::<usize>().expect("a number")] = to.clone(),
        _ => panic!("{pointer} lies in no container"),
    }
}

fn drop_at(value: &mut Value, pointer: &str) {
    match parent(value, pointer) {
        (Value::Object(map), key) => {
            map.shift_remove(&key).unwrap_or_else(|| panic!("no {pointer}"));
        }
        (Value::Array(items), key) => {
            items.remove(key.parse().expect("a number"));
        }
        _ => panic!("{pointer} lies in no container"),
    }
}

fn encode(text: &str, to: &str) -> Vec<u8> {
    match to {
        "utf-8-bom" => [b"\xef\xbb\xbf", text.as_bytes()].concat(),
        "utf-16le" => [0xff, 0xfe].into_iter().chain(text.encode_utf16().flat_map(u16::to_le_bytes)).collect(),
        "utf-32be" => text.chars().flat_map(|c| u32::from(c).to_be_bytes()).collect(),
        other => panic!("no encoding {other}"),
    }
}
