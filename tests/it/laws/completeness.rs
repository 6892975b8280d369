//! Clean implies that every tensor of the class is stored in a shard of the checkpoint, and readable.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::{Severity, check};
use ckpt_doctor::checkpoint::Checkpoint;
use serde_json::{Map, Value, json};
use tempfile::TempDir;

use super::{base, cases};
use crate::support::Draw;

const INDEX: &str = "model.safetensors.index.json";

/// The header and the data of a shard.
fn read(path: &Path) -> (Map<String, Value>, Vec<u8>) {
    let bytes = fs::read(path).unwrap();
    let length = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
    (serde_json::from_slice(&bytes[8..8 + length]).unwrap(), bytes[8 + length..].to_vec())
}

/// Writes the entries with their bytes one after another.
fn write(path: &Path, metadata: Option<Value>, tensors: &[(String, Value, Vec<u8>)]) {
    let mut header = Map::new();
    header.extend(metadata.map(|metadata| ("__metadata__".to_owned(), metadata)));
    let mut data = Vec::new();
    for (name, entry, bytes) in tensors {
        let mut entry = entry.clone();
        entry["data_offsets"] = json!([data.len(), data.len() + bytes.len()]);
        header.insert(name.clone(), entry);
        data.extend(bytes);
    }
    let text = Value::Object(header).to_string();
    let length = u64::try_from(text.len()).unwrap().to_le_bytes();
    fs::write(path, [&length[..], text.as_bytes(), &data].concat()).unwrap();
}

/// Distributes the tensors of a checkpoint over files at random, loses or empties some, and lets the index lead anywhere.
/// Returns the tensors that a loader still finds under their names, and whether there is one whose name is not kept.
fn scatter(draw: &mut Draw, dir: &Path) -> (BTreeSet<String>, bool) {
    let (mut header, data) = read(&dir.join("model.safetensors"));
    fs::remove_file(dir.join("model.safetensors")).unwrap();
    let metadata = header.remove("__metadata__");
    let lost = draw.one(&[0, 0, 1, 3, header.len()]);
    let count = 1 + draw.below(3);
    let mut shards = vec![Vec::new(); count];
    let mut map = Map::new();
    let name = |number: usize| format!("model-{:05}-of-{count:05}.safetensors", number + 1);
    for (at, (tensor, entry)) in header.into_iter().enumerate() {
        let offsets: Vec<usize> = serde_json::from_value(entry["data_offsets"].clone()).unwrap();
        let number = draw.below(count);
        let mapped = match draw.below(40) {
            0 => Some(json!("config.json")),
            1 => Some(json!(INDEX)),
            2 => Some(json!("../outside.safetensors")),
            3 => Some(json!("gone.safetensors")),
            4 => Some(json!("tokenizer.model")),
            5 => Some(json!(null)),
            6 => None,
            _ => Some(json!(name(number))),
        };
        map.extend(mapped.map(|file| (tensor.clone(), file)));
        if at == 0 && draw.once_in(6) {
            // A name that is too long to be kept.
            let long = json!({ "dtype": "U8", "shape": [1], "data_offsets": [0, 1] });
            shards[number].push(("x".repeat(20_000), long, vec![1]));
        }
        if at >= lost {
            shards[number].push((tensor, entry, data[offsets[0]..offsets[1]].to_vec()));
        }
    }
    let names: BTreeSet<String> = shards.iter().flatten().map(|(tensor, ..)| tensor.clone()).collect();
    let (found, long): (BTreeSet<_>, BTreeSet<_>) = names.into_iter().partition(|n| n.len() < 20_000);
    let whole = count == 1 && draw.once_in(2);
    for (number, shard) in shards.iter().enumerate() {
        let file = if whole { "model.safetensors".to_owned() } else { name(number) };
        write(&dir.join(file), metadata.clone(), shard);
    }
    match draw.below(8) {
        0 => map.clear(),
        1 => drop(map.shift_remove("lm_head.weight")),
        _ => {}
    }
    if !whole {
        let index = json!({ "metadata": { "total_size": 1 }, "weight_map": map });
        fs::write(dir.join(INDEX), index.to_string()).unwrap();
    }
    (found, !long.is_empty())
}

#[test]
fn clean_implies_that_every_tensor_is_stored() {
    let knowledge = crate::support::knowledge();
    let (mut clean, mut short) = (0, 0);
    // The last one has a single tensor, whose name is too long to be kept.
    for seed in (0..cases(100)).chain([468]) {
        let mut draw = Draw::new(seed);
        let room = TempDir::new().unwrap();
        let dir = room.path().join("model");
        base(&dir);
        let all: BTreeSet<String> = read(&dir.join("model.safetensors"))
            .0
            .into_iter()
            .map(|(name, _)| name)
            .filter(|n| n != "__metadata__")
            .collect();
        if draw.once_in(3) {
            // A class that nobody knows: nothing tells which tensors are missing, but an empty checkpoint is empty.
            let text = fs::read_to_string(dir.join("config.json")).unwrap().replace("llama", "unheard");
            fs::write(dir.join("config.json"), text.replace("LlamaForCausalLM", "Unheard")).unwrap();
        }
        let is_known = fs::read_to_string(dir.join("config.json")).unwrap().contains("llama");
        let (found, has_long) = scatter(&mut draw, &dir);
        let checkpoint = Arc::new(Checkpoint::open(&dir).unwrap());
        let outcome = check(&checkpoint, &knowledge);
        let worst = outcome.findings.iter().map(|finding| finding.severity).max();
        let opened = checkpoint.index.as_ref().is_none_or(|index| {
            let map = serde_json::from_str::<Value>(&fs::read_to_string(dir.join(INDEX)).unwrap()).unwrap();
            let keys = map["weight_map"].as_object().unwrap().len();
            keys == index.weight_map.len()
                && index.weight_map.values().all(|file| checkpoint.shards.contains_key(&**file))
        });
        // A tensor whose name is not kept may be one of a class that nobody knows.
        let is_short = found.is_empty() && !has_long || is_known && found != all || !opened;
        let codes: Vec<_> = outcome.findings.iter().map(|finding| finding.code.as_str()).collect();
        if is_short {
            short += 1;
            assert_eq!(
                worst,
                Some(Severity::Error),
                "seed {seed}: {} of {} tensors, {codes:?}",
                found.len(),
                all.len()
            );
        } else if worst.is_none_or(|worst| worst < Severity::Error) {
            clean += 1;
        }
    }
    assert!(short > 0 && clean > 0, "{short} short, {clean} without errors");
}
