//! The record of a merge: the digests in its manifest.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

use super::{content, copy, donor, merge, text, tiny};

pub fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"))
}

fn manifest(dir: &Path) -> Value {
    serde_json::from_slice(&fs::read(dir.join("merge-manifest.json")).unwrap()).unwrap()
}

/// Changes the last byte of a tensor, wherever it is stored.
pub fn flip(dir: &Path, tensor: &str) {
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

/// Digests of tensors by the algorithm of the manifest, of headers and other files by SHA-256.
#[test]
fn the_manifest_has_the_digest_of_every_tensor_and_file() {
    let work = TempDir::new().unwrap();
    let mut shards = None;
    for algorithm in ["blake3", "sha256", "none"] {
        let out = work.path().join(algorithm);
        let given = ["--set", "shard-size=300KB", "--set", "projector=reinit", "--hash", algorithm];
        // BLAKE3 is the default.
        let run = tiny(&out, if algorithm == "blake3" { &given[..4] } else { &given });
        assert_eq!(run.status.code(), Some(0), "{}", text(&run));
        let (manifest, files) = (manifest(&out), content(&out));
        assert_eq!((&manifest["schema"], &manifest["hash"]), (&json!(5), &json!(algorithm)));
        let by_algorithm = |bytes: &[u8]| match algorithm {
            "blake3" => Some(blake3::hash(bytes).to_string()),
            "sha256" => Some(digest(bytes)),
            _ => None,
        };
        let (weights, others): (BTreeMap<_, _>, BTreeMap<_, _>) = files
            .iter()
            .map(|(name, bytes)| (name.clone(), bytes))
            .partition(|(name, _)| name.ends_with(".safetensors"));
        let tensors: BTreeMap<String, Option<String>> = weights
            .values()
            .flat_map(|bytes| {
                let parsed = safetensors::SafeTensors::deserialize(bytes).unwrap();
                parsed.tensors().into_iter().map(|(name, t)| (name, by_algorithm(t.data()))).collect::<Vec<_>>()
            })
            .collect();
        let recorded = manifest["tensors"].as_array().unwrap().iter();
        let recorded: BTreeMap<String, Option<String>> = recorded
            .map(|t| (t["name"].as_str().unwrap().to_owned(), t["digest"].as_str().map(str::to_owned)))
            .collect();
        assert_eq!(recorded, tensors);
        let header = |bytes: &[u8]| 8 + usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
        let expected = |key: &str, name: &str, bytes: &[u8], hashed: &[u8]| {
            (name.to_owned(), json!({ "bytes": bytes.len(), key: digest(hashed) }))
        };
        let headers = weights.iter().map(|(name, b)| expected("header_sha256", name, b, &b[..header(b)]));
        assert_eq!(manifest["shards"], Value::Object(headers.collect()));
        let own = |name: &str| name == "merge-manifest.json";
        let documents = others.iter().filter(|(name, _)| !own(name)).map(|(name, b)| expected("sha256", name, b, b));
        assert_eq!(manifest["files"], Value::Object(documents.collect()));
        // The algorithm changes nothing but the manifest.
        let now: BTreeMap<_, _> =
            files.iter().filter(|(name, _)| !own(name)).map(|(n, b)| (n.clone(), b.clone())).collect();
        assert!(shards.replace(now.clone()).is_none_or(|before| before == now));
    }
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
    assert!(differ("tensors") && !differ("shards"));
}

/// Donors in a cache of the Hub, with model cards.
#[test]
fn the_card_names_donors_and_licences() {
    let work = TempDir::new().unwrap();
    let commit = "0123456789abcdef0123456789abcdef01234567";
    let place = |name: &str, repository: &str, card: &str| {
        let folder = work.path().join(repository).join("snapshots");
        fs::create_dir_all(&folder).unwrap();
        let dir = folder.join(commit);
        copy(&donor(name), &dir);
        fs::write(dir.join("README.md"), card).unwrap();
        dir
    };
    let vision = place("spatialvla-tiny", "models--lab--Spatial-4b", "---\nlicense: mit\ntags: [a]\n---\n# hello");
    let language = place("llava3d-tiny", "models--org--llava", "---\nlicense: other\nlicense_name: \"own \\t\"\n---\n");
    let out = work.path().join("out");
    let run = merge(&vision, &language, &out, &[]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let recorded = manifest(&out);
    assert_eq!(recorded["donors"]["vision"]["hub"]["id"], "lab/Spatial-4b");
    assert_eq!(recorded["donors"]["language"]["hub"]["revision"], commit);
    assert!(recorded["donors"]["vision"]["files"]["README.md"]["sha256"].is_string());
    let card = fs::read_to_string(out.join("README.md")).unwrap();
    let version = env!("CARGO_PKG_VERSION");
    snapshot!("merge-card", card.replace(version, "VERSION"));
    // No path of this machine is in a file of the result.
    let here = work.path().to_str().unwrap().as_bytes();
    for (name, bytes) in content(&out) {
        assert!(!bytes.windows(here.len()).any(|part| part == here), "{name}");
    }
}

#[test]
fn equal_licences_are_the_licence_of_the_result() {
    let work = TempDir::new().unwrap();
    let (vision, language) = (work.path().join("vision"), work.path().join("language"));
    copy(&donor("spatialvla-tiny"), &vision);
    copy(&donor("llava3d-tiny"), &language);
    let front = |first: &str, second: &str| {
        fs::write(vision.join("README.md"), first).unwrap();
        fs::write(language.join("README.md"), second).unwrap();
        let out = work.path().join("out");
        assert_eq!(merge(&vision, &language, &out, &[]).status.code(), Some(0));
        let card = fs::read_to_string(out.join("README.md")).unwrap();
        fs::remove_dir_all(&out).unwrap();
        card.split("---")
            .nth(1)
            .unwrap()
            .lines()
            .filter(|line| line.starts_with("license"))
            .collect::<Vec<_>>()
            .join(" ")
    };
    let (mit, llama) = ("---\nlicense: mit\n---\n", "---\nlicense: llama2\n---\n");
    assert_eq!(front(mit, mit), "license: \"mit\"");
    assert_eq!(front(mit, llama), "license: other");
    assert_eq!(front(mit, "no front matter"), "license: other");
    assert_eq!(front("", ""), "");
}

/// The pattern of the manifest matches the names to train and no others.
#[test]
fn the_pattern_matches_exactly_the_tensors_to_train() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    for (options, projector) in [(["--set", "projector=pad"], "pad"), (["--set", "projector=reinit"], "reinit")] {
        assert_eq!(tiny(&out, &options).status.code(), Some(0));
        let manifest = manifest(&out);
        let training = &manifest["training"];
        let list = |key: &str| -> Vec<String> {
            training[key].as_array().unwrap().iter().map(|n| n.as_str().unwrap().to_owned()).collect()
        };
        let pattern = regex::Regex::new(training["pattern"].as_str().unwrap()).unwrap();
        assert!(list("train").iter().all(|name| pattern.is_match(name)));
        assert!(!list("freeze").iter().any(|name| pattern.is_match(name)));
        assert_eq!(list("train").len() + list("freeze").len(), manifest["tensors"].as_array().unwrap().len());
        for tensor in manifest["tensors"].as_array().unwrap() {
            let is_trained = list("train").iter().any(|name| tensor["name"] == name.as_str());
            assert_eq!(is_trained, tensor["transform"] != "copy", "{}", tensor["name"]);
            let is_projector = tensor["name"].as_str().unwrap().starts_with("multi_modal_projector");
            assert!(!is_projector || tensor["transform"] == projector);
        }
        fs::remove_dir_all(&out).unwrap();
    }
}
