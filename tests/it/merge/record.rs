//! The record of a merge: the digests in its manifest.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde_json::Value;
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

use super::{content, copy, donor, merge, text, tiny};

fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"))
}

fn manifest(dir: &Path) -> Value {
    serde_json::from_slice(&fs::read(dir.join("merge-manifest.json")).unwrap()).unwrap()
}

/// Changes the last byte of a tensor, wherever it is stored.
fn flip(dir: &Path, tensor: &str) {
    for (name, mut bytes) in content(dir).into_iter().filter(|(name, _)| name.ends_with(".safetensors")) {
        let data = 8 + usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
        let header: Value = serde_json::from_slice(&bytes[8..data]).unwrap();
        if let Some(end) = header.pointer(&format!("/{tensor}/data_offsets/1")) {
            bytes[data + usize::try_from(end.as_u64().unwrap()).unwrap() - 1] ^= 1;
            return fs::write(dir.join(name), bytes).unwrap();
        }
    }
    panic!("{tensor} is missing");
}

#[test]
fn the_manifest_has_the_digest_of_every_tensor_and_file() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let run = tiny(&out, &["--set", "shard-size=300KB", "--set", "projector=reinit"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let (manifest, files) = (manifest(&out), content(&out));
    let tensors: BTreeMap<String, String> = files
        .iter()
        .filter(|(name, _)| name.ends_with(".safetensors"))
        .flat_map(|(_, bytes)| {
            let parsed = safetensors::SafeTensors::deserialize(bytes).unwrap();
            parsed.tensors().into_iter().map(|(name, t)| (name, digest(t.data()))).collect::<Vec<_>>()
        })
        .collect();
    let recorded = manifest["tensors"].as_array().unwrap().iter();
    let recorded: BTreeMap<String, String> =
        recorded.map(|t| (t["name"].as_str().unwrap().to_owned(), t["sha256"].as_str().unwrap().to_owned())).collect();
    assert_eq!(recorded, tensors);
    let own = |name: &str| name == "merge-manifest.json";
    let expected: BTreeMap<String, (u64, String)> = files
        .iter()
        .filter(|(name, _)| !own(name))
        .map(|(name, bytes)| (name.clone(), (bytes.len() as u64, digest(bytes))))
        .collect();
    let recorded = manifest["files"].as_object().unwrap().iter();
    let recorded: BTreeMap<String, (u64, String)> = recorded
        .map(|(name, f)| (name.clone(), (f["bytes"].as_u64().unwrap(), f["sha256"].as_str().unwrap().to_owned())))
        .collect();
    assert_eq!(recorded, expected);
}

/// Donors that differ in one byte of a weight, with equal headers and documents.
#[test]
fn donors_with_other_weights_give_another_manifest() {
    let work = TempDir::new().unwrap();
    let other = work.path().join("other");
    copy(&donor("llava3d-tiny"), &other);
    flip(&other, "model.layers.0.self_attn.q_proj.weight");
    let (a, b) = (work.path().join("a"), work.path().join("b"));
    assert_eq!(tiny(&a, &[]).status.code(), Some(0));
    assert_eq!(merge(&donor("spatialvla-tiny"), &other, &b, &[]).status.code(), Some(0));
    let differ = |key: &str| manifest(&a)[key] != manifest(&b)[key];
    assert!(differ("tensors") && differ("files"));
}
