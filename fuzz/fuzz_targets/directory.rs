//! Small whole checkpoints: checked, rendered, repaired in memory and checked again.
//!
//! The first byte selects the format of the report and, for values below 4, all architectures; otherwise there is one, with a
//! default of one layer, because building 32 layers takes most of the time. Each byte 0xff starts a file, and the byte after it selects its name. A
//! shard is given as the text of its header, with as many bytes of data as its entries need.

#![no_main]

#[path = "../../tests/it/support/repairs.rs"]
mod repairs;

use std::collections::BTreeMap;
use std::sync::LazyLock;

use ckpt_doctor::check::check;
use ckpt_doctor::checkpoint::Shard;
use ckpt_doctor::knowledge::rule::RuleSet;
use ckpt_doctor::knowledge::{Knowledge, Library, source};
use ckpt_doctor::report::Format;
use libfuzzer_sys::fuzz_target;
use repairs::{File, planned, renders, repairs};

const FILES: [&str; 20] = [
    "config.json",
    "model.safetensors",
    "model.safetensors.index.json",
    "model-00001-of-00002.safetensors",
    "model-00002-of-00002.safetensors",
    "generation_config.json",
    "tokenizer_config.json",
    "special_tokens_map.json",
    "added_tokens.json",
    "tokenizer.json",
    "tokenizer.model",
    "vocab.txt",
    "vocab.json",
    "chat_template.json",
    "processor_config.json",
    "preprocessor_config.json",
    "adapter_config.json",
    "adapter_model.safetensors",
    "modeling_x.py",
    "configuration_x.py",
];

/// Most bytes of data that a shard is given.
const MOST: u64 = 1 << 40;

static KNOWLEDGE: LazyLock<Knowledge> = LazyLock::new(|| Knowledge::embedded().expect("built-in files"));

static SMALL: LazyLock<Knowledge> = LazyLock::new(|| {
    let llama = source::text("architectures/llama.json5").expect("a built-in file");
    let mut library = Library::default();
    library
        .add("llama.json5", &llama.replace(r#""num_hidden_layers":32"#, r#""num_hidden_layers":1"#))
        .expect("an architecture");
    Knowledge::with(RuleSet::embedded().expect("built-in files"), library)
});

/// The length of a shard with this header, and the header after its length field.
fn shard(name: &str, text: &[u8]) -> (u64, Vec<u8>) {
    let bytes = [&(text.len() as u64).to_le_bytes(), text].concat();
    let header = bytes.len() as u64;
    let region = Shard::parse(name, header, &bytes).tensors.iter().map(|t| t.end).max().unwrap_or(0);
    (header + region.min(MOST), bytes)
}

fuzz_target!(|data: &[u8]| {
    let Some((format, rest)) = data.split_first() else { return };
    let mut contents = BTreeMap::new();
    for part in rest.split(|b| *b == 0xff).skip(1).take(8) {
        let Some((which, bytes)) = part.split_first() else { continue };
        let name = FILES[usize::from(*which) % FILES.len()];
        let file = match name.ends_with(".safetensors") {
            true => shard(name, bytes),
            false => (bytes.len() as u64, bytes.to_vec()),
        };
        contents.insert(name, file);
    }
    let files: Vec<File> = contents.iter().map(|(name, (len, bytes))| (*name, *len, bytes.as_slice())).collect();
    let checkpoint = planned(&files);
    let knowledge = if *format < 4 { &KNOWLEDGE } else { &SMALL };
    let outcome = check(&checkpoint, knowledge);
    renders(&checkpoint, &outcome, Format::ALL[usize::from(*format) % Format::ALL.len()]);
    repairs(&files, &checkpoint, &outcome, knowledge);
});
