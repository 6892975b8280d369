//! Directories with too much of something.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::Path;

use crate::support::Draw;

/// What a directory has too much of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Excess {
    /// Tensors without elements, in many shards without an index.
    Tensors,
    /// The same, with an index that lists those of the first shard.
    IndexedTensors,
    /// The same, with names of hundreds of bytes.
    LongNames,
    /// Few tensors with names of a megabyte.
    HugeNames,
    /// Tensors of a thousand dimensions.
    Ranks,
    /// Entries that are no tensors.
    Faults,
    /// Strings in `__metadata__`.
    Metadata,
    /// JSON documents of many values.
    Values,
    /// JSON documents of long text.
    Texts,
    /// Indexes.
    Indexes,
    /// Python modules.
    Modules,
    /// Configs of one byte that is no JSON.
    Entries,
    /// Tokens in every vocabulary file.
    Tokens,
    /// Configs inside configs.
    Nesting,
    /// A little of everything.
    All,
}

impl Excess {
    pub const ALL: [Self; 15] = [
        Self::Tensors,
        Self::IndexedTensors,
        Self::LongNames,
        Self::HugeNames,
        Self::Ranks,
        Self::Faults,
        Self::Metadata,
        Self::Values,
        Self::Texts,
        Self::Indexes,
        Self::Modules,
        Self::Entries,
        Self::Tokens,
        Self::Nesting,
        Self::All,
    ];

    /// Writes a directory; a `size` of 1000 exceeds the budget of a checkpoint, or comes near it.
    pub fn write(self, dir: &Path, size: usize, draw: &mut Draw) -> Made {
        // At most 190 000 entries in a header, which are read whole.
        let shards = 4 + draw.below(3);
        fs::write(dir.join("config.json"), CONFIG).unwrap();
        match self {
            Self::Tensors => return empty_tensors(dir, shards, size * 600 / shards, 0, false),
            Self::IndexedTensors => return empty_tensors(dir, shards, size * 600 / shards, 0, true),
            Self::LongNames => {
                return empty_tensors(dir, shards, size * 200 / shards, 100 + draw.below(400), false);
            }
            // Names above 16 KiB are those of no tensor.
            Self::HugeNames => drop(empty_tensors(dir, shards, size / 4 / shards + 1, 250_000, false)),
            Self::Ranks => return ranks(dir, shards, size * 40 / shards),
            Self::Faults => entries(dir, shards, size * 600 / shards),
            Self::Metadata => metadata(dir, shards, size * 600 / shards),
            Self::Values => documents(dir, size / 10, &format!("[{}0]", "0,".repeat(90_000))),
            Self::Texts => documents(dir, size / 100 + 1, &format!("\"{}\"", "x".repeat(6_000_000))),
            Self::Indexes => return indexes(dir, size / 50 + 1),
            Self::Modules => modules(dir, size / 10),
            Self::Entries => unreadable(dir, size * 110),
            Self::Tokens => tokens(dir, size * 1_400),
            Self::Nesting => nesting(dir, draw.below(3)),
            Self::All => {
                documents(dir, size / 40, &format!("[{}0]", "0,".repeat(90_000)));
                modules(dir, size / 40);
                tokens(dir, size * 300);
                return empty_tensors(dir, shards, size * 200 / shards, 40, false);
            }
        }
        Made::default()
    }
}

/// What a directory has.
#[derive(Default)]
pub struct Made {
    /// Tensors in the shards.
    pub tensors: u64,
    /// Names that a loader finds: those of the index, or else of the shards. None is of the class.
    pub names: u64,
}

const CONFIG: &str = r#"{"architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 8, "intermediate_size": 16,
"num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 2, "vocab_size": 32,
"max_position_embeddings": 64, "torch_dtype": "float32", "tie_word_embeddings": false}"#;

/// Writes shard `number` of `count`, with this text as its header.
fn shard(dir: &Path, number: usize, count: usize, mut header: String) {
    header.push_str(&" ".repeat(header.len().wrapping_neg() % 8));
    let mut file = File::create(dir.join(name(number, count))).unwrap();
    file.write_all(&(header.len() as u64).to_le_bytes()).unwrap();
    file.write_all(header.as_bytes()).unwrap();
}

fn name(number: usize, count: usize) -> String {
    format!("model-{:05}-of-{count:05}.safetensors", number + 1)
}

/// Tensors without elements.
fn empty_tensors(dir: &Path, shards: usize, each: usize, name_length: usize, indexed: bool) -> Made {
    let mut map = String::new();
    for number in 0..shards {
        let mut header = r#"{"__metadata__":{"format":"pt"}"#.to_owned();
        for k in 0..each {
            let tensor = format!("{number}.t{k}{}", "x".repeat(name_length));
            let _ = write!(header, r#","{tensor}":{{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}"#);
            if indexed && number == 0 {
                let _ = write!(map, r#"{}"{tensor}":"{}""#, if k == 0 { "" } else { "," }, name(0, shards));
            }
        }
        shard(dir, number, shards, header + "}");
    }
    if indexed {
        let index = format!(r#"{{"metadata":{{}},"weight_map":{{{map}}}}}"#);
        fs::write(dir.join("model.safetensors.index.json"), index).unwrap();
    }
    let tensors = (shards * each) as u64;
    Made { tensors, names: if indexed { each as u64 } else { tensors } }
}

fn ranks(dir: &Path, shards: usize, each: usize) -> Made {
    let shape = format!("{}0", "0,".repeat(1000));
    for number in 0..shards {
        let tensors: Vec<String> = (0..each)
            .map(|k| format!(r#""{number}.{k}":{{"dtype":"F32","shape":[{shape}],"data_offsets":[0,0]}}"#))
            .collect();
        shard(dir, number, shards, format!("{{{}}}", tensors.join(",")));
    }
    let tensors = (shards * each) as u64;
    Made { tensors, names: tensors }
}

fn entries(dir: &Path, shards: usize, each: usize) {
    for number in 0..shards {
        let tensors: Vec<String> = (0..each).map(|k| format!(r#""{number}.{k}":1"#)).collect();
        shard(dir, number, shards, format!("{{{}}}", tensors.join(",")));
    }
}

fn metadata(dir: &Path, shards: usize, each: usize) {
    for number in 0..shards {
        let strings: Vec<String> = (0..each).map(|k| format!(r#""{k}":"value {k}""#)).collect();
        shard(dir, number, shards, format!(r#"{{"__metadata__":{{{}}}}}"#, strings.join(",")));
    }
}

fn documents(dir: &Path, count: usize, value: &str) {
    for i in 0..count {
        fs::write(dir.join(format!("part{i}.config.json")), format!(r#"{{"a": {value}}}"#)).unwrap();
    }
}

fn indexes(dir: &Path, count: usize) -> Made {
    let map: Vec<String> = (0..50_000).map(|k| format!(r#""tensor.{k}":"a.safetensors""#)).collect();
    let index = format!(r#"{{"metadata":{{}},"weight_map":{{{}}}}}"#, map.join(","));
    for i in 0..count {
        fs::write(dir.join(format!("m{i}.safetensors.index.json")), &index).unwrap();
    }
    Made { tensors: 0, names: 50_000 }
}

fn unreadable(dir: &Path, count: usize) {
    for i in 0..count {
        fs::write(dir.join(format!("{i}.config.json")), "{").unwrap();
    }
}

fn modules(dir: &Path, count: usize) {
    for i in 0..count {
        fs::write(dir.join(format!("module_{i}.py")), "import a\n".repeat(20_000)).unwrap();
    }
}

fn tokens(dir: &Path, count: usize) {
    let tokens: Vec<String> = (0..count).map(|k| format!(r#""token {k}":{k}"#)).collect();
    let tokens = tokens.join(",");
    fs::write(dir.join("vocab.json"), format!("{{{tokens}}}")).unwrap();
    let whole = format!(r#"{{"version":"1.0","model":{{"type":"BPE","vocab":{{{tokens}}},"merges":[]}}}}"#);
    fs::write(dir.join("tokenizer.json"), whole).unwrap();
    fs::write(dir.join("vocab.txt"), tokens.replace(',', "\n")).unwrap();
}

/// Configs inside configs, as deep as a document is read.
fn nesting(dir: &Path, kind: usize) {
    let key = ["text_config", "vision_config", "quantization_config"][kind];
    let open = CONFIG.trim_end_matches('}');
    let nested = format!("{open}, \"{key}\": ").repeat(110) + CONFIG + &"}".repeat(110);
    fs::write(dir.join("config.json"), nested).unwrap();
    shard(dir, 0, 1, "{}".to_owned());
}

/// A shard with a stored tensor, and one of `bytes` bytes of which none is stored.
pub fn sparse(dir: &Path, bytes: u64) {
    fs::write(dir.join("config.json"), CONFIG).unwrap();
    let (count, end) = (bytes / 4, bytes + 32);
    let header = format!(
        r#"{{"__metadata__":{{"format":"pt"}},
        "model.norm.weight":{{"dtype":"F32","shape":[8],"data_offsets":[0,32]}},
        "model.embed_tokens.weight":{{"dtype":"F32","shape":[{count},1],"data_offsets":[32,{end}]}}}}"#
    );
    shard(dir, 0, 1, header);
    let mut file = File::options().append(true).open(dir.join(name(0, 1))).unwrap();
    file.write_all(&[1; 32]).unwrap();
    let stored = file.metadata().unwrap().len();
    file.set_len(stored + bytes).unwrap();
}
