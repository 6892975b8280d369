//! Sound checkpoints, on which cases are based.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use ckpt_doctor::HashAlgorithm;
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::knowledge::Loader;
use ckpt_doctor::merge::{self, MergeRequest};
use ckpt_doctor::report::model::MergeStage;
use serde_json::Value;

use super::change::apply_all;
use super::weights::{Shard, Weights};
use super::{cases, project};

/// Names of all bases.
///
/// `llama`, `paligemma`, `qwen2-vl` to `idefics3` are documents in `fixtures/bases` with generated weights; `spatialvla` is the donor without
/// the data set whose statistics contain three `Infinity`; the merged ones are built from the donors; `llama-gptq` is
/// the sound case of that name; `lora` is an adapter of `llama`.
pub const BASES: &[&str] = &[
    "llama",
    "llama-sharded",
    "llama-gptq",
    "lora",
    "paligemma",
    "qwen2-vl",
    "qwen2.5-vl",
    "llava",
    "llava-onevision",
    "gemma3",
    "internvl",
    "idefics3",
    "spatialvla",
    "llava3d",
    "merged",
    "merged-baked",
    "merged-wrapped",
];

/// Builds these bases below `root`.
pub fn make_all(root: &Path, names: &[&'static str], knowledge: &Knowledge) -> BTreeMap<&'static str, PathBuf> {
    names
        .iter()
        .map(|name| {
            let dir = root.join(name);
            make(name, &dir, knowledge);
            (*name, dir)
        })
        .collect()
}

/// Builds one base, an `empty` directory, or the documents of another folder in `fixtures/bases` with their weights.
pub fn make(name: &str, dir: &Path, knowledge: &Knowledge) {
    match name {
        "llama" => documents(&folder("llama"), dir, 1, knowledge),
        "llama-sharded" => documents(&folder("llama"), dir, 2, knowledge),
        "llama-gptq" => {
            documents(&folder("llama"), dir, 1, knowledge);
            let case = cases().into_iter().find(|c| c.name == "sound/quantized-gptq").expect("the case");
            apply_all(&case.name, &case.changes, dir);
        }
        "lora" => lora(dir),
        "paligemma" | "qwen2-vl" => documents(&folder(name), dir, 1, knowledge),
        "spatialvla" => {
            copy(&project().join("fixtures/donors/spatialvla-tiny"), dir);
            let file = dir.join("processor_config.json");
            let text = fs::read_to_string(&file).expect("text").replace("Infinity", "1.0");
            let mut value: Value = serde_json::from_str(&text).expect("JSON");
            value["statistics"].as_object_mut().expect("an object").shift_remove("rh20t_rlds/1.0.0");
            fs::write(file, serde_json::to_string_pretty(&value).expect("JSON")).expect("write");
        }
        "llava3d" => copy(&project().join("fixtures/donors/llava3d-tiny"), dir),
        "merged" => merge(dir, &[("shard-size", "300KB")], knowledge),
        "merged-baked" => merge(dir, &[("tokenizer", "baked")], knowledge),
        "merged-wrapped" => {
            merge(dir, &[("layout", "wrapped"), ("spatial", "off"), ("zoe", "off")], knowledge);
        }
        "empty" => fs::create_dir_all(dir).expect("a directory"),
        other => documents(&folder(other), dir, 1, knowledge),
    }
}

/// Copies the files of a directory; links are copied as links.
pub fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a directory");
    for entry in fs::read_dir(from).unwrap_or_else(|e| panic!("{}: {e}", from.display())) {
        let entry = entry.expect("an entry");
        fs::copy(entry.path(), to.join(entry.file_name())).expect("copy");
    }
}

fn folder(name: &str) -> PathBuf {
    project().join("fixtures/bases").join(name)
}

/// Writes the documents in `from`, and the tensors of their class.
pub fn documents(from: &Path, dir: &Path, shards: usize, knowledge: &Knowledge) {
    copy(from, dir);
    tensors(dir, shards, knowledge);
}

/// Writes the tensors of the class that the `config.json` in `dir` names.
pub fn tensors(dir: &Path, shards: usize, knowledge: &Knowledge) {
    let config: Value =
        serde_json::from_str(&fs::read_to_string(dir.join("config.json")).expect("text")).expect("JSON");
    let architecture = knowledge.library.find(&config, [], Loader::of_config(&config)).expect("a known class");
    let expected = architecture.expect(&config).unwrap_or_else(|e| panic!("{}: {e:?}", dir.display()));
    let tensors: Vec<_> = expected.tensors.iter().filter(|(_, t)| t.tied_to.is_none()).collect();
    let mut weights = Weights::default();
    let each = tensors.len().div_ceil(shards);
    for (i, part) in tensors.chunks(each).enumerate() {
        let file = match shards {
            1 => "model.safetensors".to_owned(),
            n => format!("model-{:05}-of-{n:05}.safetensors", i + 1),
        };
        let mut shard = Shard::new(&file);
        for (name, tensor) in part {
            shard.add(name, "BF16", &tensor.shape);
        }
        weights.shards.push(shard);
    }
    weights.write(dir);
    if shards > 1 {
        weights.write_index(dir);
    }
}

/// Writes two matrices of rank four for two modules of each layer.
fn lora(dir: &Path) {
    copy(&project().join("fixtures/bases/lora"), dir);
    let mut shard = Shard::new("adapter_model.safetensors");
    for layer in 0..2 {
        for (module, out) in [("q_proj", 16), ("v_proj", 8)] {
            let name = format!("base_model.model.model.layers.{layer}.self_attn.{module}");
            shard.add(&format!("{name}.lora_A.weight"), "F32", &[4, 16]);
            shard.add(&format!("{name}.lora_B.weight"), "F32", &[out, 4]);
        }
    }
    Weights { shards: vec![shard] }.write(dir);
}

fn merge(out: &Path, options: &[(&str, &str)], knowledge: &Knowledge) {
    let donors = project().join("fixtures/donors");
    let request = MergeRequest {
        recipe: None,
        donors: [("vision", "spatialvla-tiny"), ("language", "llava3d-tiny")]
            .map(|(role, dir)| (role.to_owned(), donors.join(dir)))
            .into(),
        options: options.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect(),
        versions: Vec::new(),
        tolerate: Vec::new(),
        out: out.to_owned(),
        dry_run: false,
        hash: HashAlgorithm::default(),
        hash_donors: false,
    };
    let run = merge::run(&request, knowledge, &|_, _| {}).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(
        run.record.stage,
        Some(MergeStage::Written),
        "{}: {:?}",
        out.display(),
        run.checked.last().map(|l| &l.outcome.findings)
    );
}
