//! What lies behind a limit makes no verdict better.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::check::verdict::LoadVerdict;
use ckpt_doctor::knowledge::rule::Object;
use serde_json::{Value, json};

use super::{Files, base, config, read};
use crate::support::knowledge;

/// The worst that any loader does with a model.
fn verdict(files: Files) -> String {
    let outcome = check_for(&Arc::new(read(files)), &knowledge(), &RunOptions::default());
    outcome.verdicts.iter().map(|load| load.verdict).max().unwrap().name().to_owned()
}

/// A Llama whose `auto_map` names a module with a syntax error, behind so many others that nothing imports.
fn behind_modules(n: usize) -> Files {
    let mut files = base();
    let named = config(&files, "\"auto_map\": {\"AutoModelForCausalLM\": \"modeling_z.X\"}");
    files.insert("config.json".to_owned(), named);
    files.insert("modeling_z.py".to_owned(), b"class X:\n  pass\nx = = 1\n".to_vec());
    files.extend((0..n).map(|i| (format!("a{i:02}.py"), b"x = = 1\n".repeat(64))));
    files
}

/// A Llama with two more shards that both hold so many other tensors with equal bytes, and then one of the class with others.
fn behind_equal_tensors(n: usize) -> Files {
    let mut files = base();
    let whole = files.remove("model.safetensors").unwrap();
    let header_len = u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    let header: Value = serde_json::from_slice(&whole[8..8 + header_len]).unwrap();
    let norm = &header["model.norm.weight"]["data_offsets"];
    let [begin, end] = [0, 1].map(|i| 8 + header_len + norm[i].as_u64().unwrap() as usize);
    let mut map = serde_json::Map::new();
    let names = header.as_object().unwrap().keys().filter(|name| *name != "__metadata__");
    map.extend(names.map(|name| (name.clone(), json!("model-00001-of-00002.safetensors"))));
    let equal: Vec<(String, Vec<u8>)> = (0..n).map(|i| (format!("aaa{i:04}"), vec![7])).collect();
    map.extend(equal.iter().map(|(name, _)| (name.clone(), json!("model-00001-of-00002.safetensors"))));
    // The first shard is the whole with these tensors behind it; the second repeats them, and has another norm.
    let mut first = header.clone();
    let mut data = whole[8 + header_len..].to_vec();
    for (name, bytes) in &equal {
        first[name] = json!({ "dtype": "U8", "shape": [1], "data_offsets": [data.len(), data.len() + 1] });
        data.extend(bytes);
    }
    let first = first.to_string();
    let first = [&(first.len() as u64).to_le_bytes()[..], first.as_bytes(), &data].concat();
    // The loader opens the shards that the index names.
    map.insert("zzz".to_owned(), json!("model-00002-of-00002.safetensors"));
    let mut second = header["model.norm.weight"].clone();
    second["data_offsets"] = json!([n, n + end - begin]);
    let mut repeated = json!({ "__metadata__": { "format": "pt" } });
    for (i, (name, _)) in equal.iter().enumerate() {
        repeated[name] = json!({ "dtype": "U8", "shape": [1], "data_offsets": [i, i + 1] });
    }
    repeated["model.norm.weight"] = second;
    let last = n + end - begin;
    repeated["zzz"] = json!({ "dtype": "U8", "shape": [1], "data_offsets": [last, last + 1] });
    let repeated = repeated.to_string();
    let other = vec![0x55; end - begin + 1];
    let second = [&(repeated.len() as u64).to_le_bytes()[..], repeated.as_bytes(), &vec![7; n], &other].concat();
    files.insert("model-00001-of-00002.safetensors".to_owned(), first);
    files.insert("model-00002-of-00002.safetensors".to_owned(), second);
    let index = json!({ "metadata": { "total_size": 1 }, "weight_map": map });
    files.insert("model.safetensors.index.json".to_owned(), index.to_string().into_bytes());
    files
}

#[test]
fn a_module_behind_a_thousand_faults_raises() {
    assert_eq!(verdict(behind_modules(1)), "raises");
    for n in [15, 16, 17] {
        assert_eq!(verdict(behind_modules(n)), "raises", "{n}");
    }
}

#[test]
fn a_tensor_behind_a_thousand_equal_ones_does_not_load() {
    for (n, expected) in [(1, "loads wrong"), (999, "loads wrong"), (1000, "not predicted"), (1001, "not predicted")] {
        assert_eq!(verdict(behind_equal_tensors(n)), expected, "{n}");
    }
}

/// The tiny SpatialVLA, whose processor adds as many tokens as its document says.
fn spatialvla() -> Files {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors/spatialvla-tiny");
    let entries = fs::read_dir(dir).unwrap().map(Result::unwrap).filter(|entry| entry.path().is_file());
    entries.map(|e| (e.file_name().into_string().unwrap(), fs::read(e.path()).unwrap())).collect()
}

fn model_of_4_47(files: Files) -> (LoadVerdict, Option<String>) {
    let outcome = check_for(&Arc::new(read(files)), &knowledge(), &RunOptions::default());
    let load = outcome.verdicts.into_iter().find(|load| load.loader == "4.47.0").unwrap();
    let model = load.objects.into_iter().find(|object| object.object == Object::Model).unwrap();
    (model.verdict, model.why)
}

#[test]
fn a_processor_with_too_many_tokens_is_not_counted() {
    let mut files = spatialvla();
    // A statistic is infinite, which JSON cannot say.
    let text = String::from_utf8(files["processor_config.json"].clone()).unwrap().replace("Infinity", "1.0");
    let mut config: Value = serde_json::from_str(&text).unwrap();
    config["action_config"]["num_bins"]["gripper"] = json!(5_000_000);
    files.insert("processor_config.json".to_owned(), config.to_string().into_bytes());
    let (verdict, why) = model_of_4_47(files);
    assert_eq!(verdict, LoadVerdict::NotPredicted);
    assert!(why.as_ref().is_some_and(|why| why.contains("more than any tokenizer has")), "{why:?}");
}

/// What is missing is told by rules, and is none of the model's.
#[test]
fn a_model_without_its_processor_loads() {
    let mut files = spatialvla();
    files.remove("processor_config.json").unwrap();
    assert_eq!(model_of_4_47(files), (LoadVerdict::Loads, None));
}
