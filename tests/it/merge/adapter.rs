//! `merge-adapter`: a LoRA in its base model, against a loop over all values, and what is refused.
//!
//! `tests/peer/merge_adapter.py` compares with PEFT.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use half::bf16;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::{Value, json};
use tempfile::TempDir;

use super::law::bytes::{Tensors, read};
use super::{content, doctor, operation, text};
use crate::support::base::{documents, tensors};
use crate::support::{knowledge, make_base};

/// A base model and its adapter.
struct Pair {
    work: TempDir,
}

impl Pair {
    /// The Llama of the fixtures in bfloat16, and the LoRA of its query and value projections.
    fn new() -> Self {
        let work = TempDir::new().unwrap();
        make_base("llama", &work.path().join("base"));
        make_base("lora", &work.path().join("adapter"));
        Self { work }
    }

    fn dir(&self, name: &str) -> PathBuf {
        self.work.path().join(name)
    }

    fn config(&self, dir: &str, changes: Value) {
        let file = self.dir(dir).join(if dir == "base" { "config.json" } else { "adapter_config.json" });
        let mut config: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
        let Value::Object(changes) = changes else { panic!("an object") };
        config.as_object_mut().unwrap().extend(changes);
        fs::write(file, config.to_string()).unwrap();
    }

    /// Changes the tensors of the adapter.
    fn tensors(&self, change: impl Fn(&mut BTreeMap<String, (Vec<usize>, Vec<f32>)>)) {
        let dir = self.dir("adapter");
        let single = |bytes: &[u8]| bytes.chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect();
        let mut all = read(&dir).into_iter().map(|(name, (_, shape, bytes))| (name, (shape, single(&bytes)))).collect();
        change(&mut all);
        write(&dir.join("adapter_model.safetensors"), &all);
    }

    fn merge(&self, more: &[&str]) -> Output {
        let [base, adapter, out] = ["base", "adapter", "out"].map(|name| self.dir(name).to_str().unwrap().to_owned());
        doctor(&[&["merge-adapter", &base, &adapter, "--out", &out], more].concat())
    }

    /// The output without the place of the directories.
    fn shown(&self, output: &Output) -> String {
        text(output).replace(self.work.path().to_str().unwrap(), "WORK")
    }

    /// The result and its manifest; it must be equal to what the donors give.
    fn merged(&self) -> (Tensors, Value) {
        let run = self.merge(&["--fail-on", "error"]);
        assert_eq!(run.status.code(), Some(0), "{}", self.shown(&run));
        let verified = self.verify(&["base", "adapter"]);
        assert_eq!(verified.status.code(), Some(0), "{}", self.shown(&verified));
        let manifest = fs::read(self.dir("out").join("merge-manifest.json")).unwrap();
        (read(&self.dir("out")), serde_json::from_slice(&manifest).unwrap())
    }

    fn verify(&self, roles: &[&str]) -> Output {
        let given =
            roles.iter().flat_map(|role| ["--donor".to_owned(), format!("{role}={}", self.dir(role).display())]);
        let given: Vec<String> = given.collect();
        let given: Vec<&str> = given.iter().map(String::as_str).collect();
        doctor(&[&["verify", self.dir("out").to_str().unwrap()], given.as_slice()].concat())
    }
}

/// Writes float32 tensors.
fn write(file: &Path, tensors: &BTreeMap<String, (Vec<usize>, Vec<f32>)>) {
    let bytes: Vec<Vec<u8>> =
        tensors.values().map(|(_, values)| values.iter().flat_map(|v| v.to_le_bytes()).collect()).collect();
    let views = tensors
        .iter()
        .zip(&bytes)
        .map(|((name, (shape, _)), bytes)| (name.clone(), TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap()));
    fs::write(file, safetensors::serialize(views, None).unwrap()).unwrap();
}

fn numbers(count: usize) -> Vec<f32> {
    (0..count).map(|i| f32::from(u8::try_from(i * 37 % 29).unwrap()) / 8.0 - 1.5).collect()
}

/// A matrix with bfloat16 values, to which `left [rows, inner]` times `right [inner, columns]` times a factor is added.
fn added(base: &[u8], left: &[f32], right: &[f32], inner: usize, factor: f64, rounded: bool) -> Vec<u8> {
    let columns = right.len() / inner;
    let value = |(place, base): (usize, &[u8])| {
        let (row, column) = (place / columns, place % columns);
        let term = |k: usize| f64::from(left[row * inner + k]) * f64::from(right[k * columns + column]);
        let delta = (0..inner).map(term).sum::<f64>() as f32 * factor as f32;
        let delta = if rounded { bf16::from_f32(delta).to_f32() } else { delta };
        bf16::from_f32(bf16::from_le_bytes(base.try_into().unwrap()).to_f32() + delta).to_le_bytes()
    };
    base.chunks(2).enumerate().flat_map(value).collect()
}

fn turned(values: &[f32], columns: usize) -> Vec<f32> {
    (0..columns).flat_map(|column| values.iter().skip(column).step_by(columns).copied()).collect()
}

#[test]
fn a_lora_is_added_to_the_weights_that_it_names() {
    let pair = Pair::new();
    let run = pair.merge(&["--dry-run"]);
    assert_eq!(run.status.code(), Some(0), "{}", pair.shown(&run));
    assert!(!pair.dir("out").exists());
    let (result, manifest) = pair.merged();
    let (base, adapter) = (read(&pair.dir("base")), read(&pair.dir("adapter")));
    assert_eq!(result.len(), base.len());
    let single = |name: &str| -> Vec<f32> {
        adapter[name].2.chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
    };
    let mut changed = Vec::new();
    for (name, (dtype, shape, bytes)) in &base {
        let module = name.strip_suffix(".weight").map(|module| format!("base_model.model.{module}"));
        let matrices = module.filter(|module| adapter.contains_key(&format!("{module}.lora_A.weight")));
        let want = matrices.map_or_else(
            || bytes.clone(),
            |module| {
                changed.push(name.clone());
                let [a, b] = ["A", "B"].map(|end| single(&format!("{module}.lora_{end}.weight")));
                // lora_alpha / r
                added(bytes, &b, &a, 4, 2.0, false)
            },
        );
        assert!(result[name] == (dtype.clone(), shape.clone(), want), "{name}");
    }
    assert_eq!(changed.len(), 4);
    let of = |transform: &str| {
        let tensors = manifest["tensors"].as_array().unwrap().iter().filter(|t| t["transform"] == transform);
        tensors.map(|t| t["name"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let mut products = of("add-product");
    products.sort();
    assert_eq!((products, of("copy").len()), (changed, base.len() - 4));
    let names: Vec<String> = content(&pair.dir("out")).into_keys().collect();
    assert!(!names.iter().any(|name| name.starts_with("adapter")), "{names:?}");
    fs::remove_dir_all(pair.dir("out")).unwrap();
    snapshot!("merge-adapter", pair.shown(&pair.merge(&[])));
}

/// The matrices of an adapter are taken, although no tensor of the result stands for them.
#[test]
fn the_map_of_an_adapter_shows_what_was_taken() {
    let pair = Pair::new();
    let page = pair.dir("page.html");
    let run = pair.merge(&["--report", &format!("html={}", page.display())]);
    assert_eq!(run.status.code(), Some(0), "{}", pair.shown(&run));
    let html = fs::read_to_string(page).unwrap();
    let (_, map) = html.split_once("<h2>adapter: what was taken</h2>").unwrap();
    let (map, _) = map.split_once("<details").unwrap();
    assert!(map.contains("adapter: add-product") && !map.contains("left out"), "{map}");
}

/// Without the adapter, its products cannot be made again; with other matrices, they differ.
#[test]
fn a_product_is_verified_with_both_donors() {
    let pair = Pair::new();
    pair.merged();
    let alone = pair.verify(&["base"]);
    assert_eq!(alone.status.code(), Some(2), "{}", pair.shown(&alone));
    snapshot!("merge-adapter-verified-alone", pair.shown(&alone));
    // The matrices of another module, under the digests of the result.
    let file = pair.dir("out/merge-manifest.json");
    let original = fs::read_to_string(&file).unwrap();
    let forged = original.replace("layers.0.self_attn.q_proj.lora_", "layers.1.self_attn.q_proj.lora_");
    assert_ne!(forged, original);
    fs::write(&file, forged).unwrap();
    let run = pair.verify(&[]);
    assert_eq!(run.status.code(), Some(1), "{}", pair.shown(&run));
    assert!(text(&run).contains("is recorded as add-product, and nothing that the recipe names"), "{}", text(&run));
    fs::write(&file, original).unwrap();
    pair.tensors(|all| {
        for (_, values) in all.values_mut() {
            values[0] += 1.0;
        }
    });
    let run = pair.verify(&["base", "adapter"]);
    assert_eq!(run.status.code(), Some(1), "{}", pair.shown(&run));
    assert!(text(&run).contains("; the donor's tensor is not the recorded one"), "{}", text(&run));
}

/// The first pattern of the config that matches a module gives its rank and its `lora_alpha`.
#[test]
fn patterns_give_the_factor() {
    let pair = Pair::new();
    pair.config(
        "adapter",
        json!({
            "r": 2, "lora_alpha": 3, "use_rslora": true, "rank_pattern": { "q_proj": 4, "layers.0.self_attn.v_proj": 4, ".*v_proj": 4 },
            "alpha_pattern": { r"layers\.1\..*_proj": 5, "q_proj": 7 },
        }),
    );
    let (_, manifest) = pair.merged();
    for tensor in manifest["tensors"].as_array().unwrap().iter().filter(|t| t["transform"] == "add-product") {
        let name = tensor["name"].as_str().unwrap();
        let alpha = match name {
            _ if name.contains("layers.1.") => 5.0,
            _ if name.contains("q_proj") => 7.0,
            _ => 3.0,
        };
        assert_eq!(operation(&tensor["source"]).1["product"]["scale"], json!(alpha / 2.0), "{name}");
    }
}

/// `modules_to_save` takes the place of the base model's tensors, in their type; an embedding rounds what it adds.
#[test]
fn saved_modules_are_copied_and_embeddings_are_merged() {
    let pair = Pair::new();
    let base = read(&pair.dir("base"));
    pair.tensors(|all| {
        all.insert("base_model.model.lm_head.weight".to_owned(), (vec![16, 16], numbers(256)));
        let embedding = "base_model.model.model.embed_tokens.lora_embedding";
        all.insert(format!("{embedding}_A"), (vec![4, 16], numbers(64)));
        all.insert(format!("{embedding}_B"), (vec![16, 4], numbers(64)));
    });
    pair.config(
        "adapter",
        json!({ "modules_to_save": ["lm_head"], "target_modules": ["q_proj", "v_proj", "embed_tokens"] }),
    );
    let (result, manifest) = pair.merged();
    let saved: Vec<u8> = numbers(256).iter().flat_map(|v| bf16::from_f32(*v).to_le_bytes()).collect();
    assert!(result["lm_head.weight"].2 == saved);
    assert_eq!(manifest["changes"]["casts"], json!([{ "donor": "adapter", "to": "BF16" }]));
    let name = "model.embed_tokens.weight";
    let (left, right) = (turned(&numbers(64), 16), turned(&numbers(64), 4));
    assert!(result[name].2 == added(&base[name].2, &left, &right, 4, 2.0, true));
}

/// The square weights of GPT-2 are stored [in, out], and its names on the Hub lack their first part.
#[test]
fn conv1d_is_turned() {
    let pair = Pair::new();
    let base = pair.dir("base");
    fs::remove_dir_all(&base).unwrap();
    let source = pair.dir("gpt2");
    fs::create_dir(&source).unwrap();
    let config = json!({
        "architectures": ["GPT2LMHeadModel"], "model_type": "gpt2", "n_embd": 16, "n_layer": 1, "n_head": 4, "vocab_size": 40,
        "n_positions": 32, "n_ctx": 32, "bos_token_id": 1, "eos_token_id": 2, "torch_dtype": "bfloat16",
        "transformers_version": "4.47.0",
    });
    fs::write(source.join("config.json"), config.to_string()).unwrap();
    documents(&source, &base, 1, &knowledge());
    tensors(&base, 1, &knowledge());
    let stored: Tensors = read(&base)
        .into_iter()
        .map(|(name, tensor)| (name.strip_prefix("transformer.").unwrap_or(&name).to_owned(), tensor))
        .collect();
    let views = stored.iter().map(|(name, (dtype, shape, bytes))| {
        let dtype = if dtype == "BF16" { Dtype::BF16 } else { panic!("{dtype}") };
        (name.clone(), TensorView::new(dtype, shape.clone(), bytes).unwrap())
    });
    let metadata = std::collections::HashMap::from([("format".to_owned(), "pt".to_owned())]);
    fs::write(base.join("model.safetensors"), safetensors::serialize(views, Some(metadata)).unwrap()).unwrap();
    let module = "base_model.model.transformer.h.0.attn.c_proj";
    pair.tensors(|all| {
        all.clear();
        all.insert(format!("{module}.lora_A.weight"), (vec![4, 16], numbers(64)));
        all.insert(format!("{module}.lora_B.weight"), (vec![16, 4], numbers(64)));
    });
    pair.config("adapter", json!({ "target_modules": ["c_proj"], "fan_in_fan_out": true }));
    let (result, _) = pair.merged();
    let name = "h.0.attn.c_proj.weight";
    let (left, right) = (turned(&numbers(64), 16), turned(&numbers(64), 4));
    assert!(result[name].2 == added(&stored[name].2, &left, &right, 4, 2.0, false));
}

/// What PEFT does in another way, or with other tensors, is refused by name, and nothing is written.
#[test]
fn what_is_not_merged_is_named() {
    let mut table = String::new();
    let mut refused = |what: &str, change: &dyn Fn(&Pair)| {
        let pair = Pair::new();
        change(&pair);
        let run = pair.merge(&[]);
        assert_eq!(run.status.code(), Some(2), "{what}: {}", pair.shown(&run));
        assert!(!pair.dir("out").exists(), "{what}");
        let shown = pair.shown(&run);
        let error = shown.lines().filter(|line| line.starts_with("error") || line.contains("caused by"));
        let error: Vec<&str> = error.collect();
        let error = if error.is_empty() { shown.as_str() } else { &error.join("\n") };
        let _ok = writeln!(table, "{what}: {error}");
    };
    let q = "base_model.model.model.layers.0.self_attn.q_proj";
    for (key, value) in [
        ("use_dora", json!(true)),
        ("bias", json!("all")),
        ("lora_bias", json!(true)),
        ("init_lora_weights", json!("pissa_niter_4")),
        ("layer_replication", json!([[0, 1]])),
        ("target_parameters", json!(["experts.down_proj"])),
        ("trainable_token_indices", json!([1])),
        ("key_of_tomorrow", json!(1)),
        ("peft_type", json!("LOHA")),
        ("r", json!(2)),
        ("target_modules", json!(["v_proj"])),
    ] {
        refused(key, &|pair| pair.config("adapter", json!({ key: value })));
    }
    refused("no config", &|pair| fs::remove_file(pair.dir("adapter/adapter_config.json")).unwrap());
    refused("a pickle", &|pair| {
        let dir = pair.dir("adapter");
        fs::rename(dir.join("adapter_model.safetensors"), dir.join("adapter_model.bin")).unwrap();
    });
    refused("one matrix", &|pair| pair.tensors(|all| drop(all.remove(&format!("{q}.lora_B.weight")))));
    refused("magnitudes", &|pair| {
        pair.tensors(|all| drop(all.insert(format!("{q}.lora_magnitude_vector"), (vec![16], numbers(16)))));
    });
    refused("a bias", &|pair| {
        pair.tensors(|all| drop(all.insert(format!("{q}.lora_B.bias"), (vec![16], numbers(16)))));
    });
    refused("another base", &|pair| {
        pair.tensors(|all| {
            for (_, (shape, values)) in all.iter_mut().filter(|(name, _)| name.contains("lora_A")) {
                (*shape, *values) = (vec![4, 12], numbers(48));
            }
        });
    });
    refused("no place", &|pair| {
        pair.tensors(|all| drop(all.insert("base_model.model.score.weight".to_owned(), (vec![2, 16], numbers(32)))));
    });
    refused("resized", &|pair| {
        pair.tensors(|all| {
            drop(all.insert("base_model.model.lm_head.weight".to_owned(), (vec![17, 16], numbers(272))));
        });
    });
    refused("tied", &|pair| {
        pair.config("base", json!({ "tie_word_embeddings": true }));
        pair.tensors(|all| {
            drop(all.insert("base_model.model.lm_head.weight".to_owned(), (vec![16, 16], numbers(256))));
        });
    });
    refused("quantised", &|pair| fs::write(pair.dir("base/quant_config.json"), "{}").unwrap());
    refused("dora", &|pair| {
        pair.config("adapter", json!({ "use_dora": true }));
        pair.tensors(|all| {
            for (name, (shape, _)) in all.clone().into_iter().filter(|(name, _)| name.contains("lora_B")) {
                let vector = name.replace("lora_B.weight", "lora_magnitude_vector");
                all.insert(vector, (vec![shape[0]], numbers(shape[0])));
            }
        });
    });
    refused("an adapter as base", &|pair| {
        pair.config("adapter", json!({ "base_model_name_or_path": "." }));
        for file in ["adapter_config.json", "adapter_model.safetensors"] {
            fs::copy(pair.dir("adapter").join(file), pair.dir("base").join(file)).unwrap();
        }
    });
    snapshot!("merge-adapter-refused", table);
}
