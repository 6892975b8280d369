//! `projector=fit` and `spatial=fit`. tests/peer/fit.py compares the values with numpy.

use std::fs;
use std::path::Path;

use serde_json::{Map, Value, json};
use tempfile::TempDir;

use super::law::bytes::read;
use super::{doctor, donor, json as report, merge, text};
use crate::support::base::copy;

/// Copies of the tiny donors whose vocabularies share words of which the language donor has `count`.
fn donors(work: &Path, count: usize) {
    for (role, name, size) in [("vision", "spatialvla-tiny", 420_usize), ("language", "llava3d-tiny", 340)] {
        let dir = work.join(role);
        copy(&donor(name), &dir);
        let words = if role == "vision" { 200 } else { count };
        let special: &[&str] =
            if role == "vision" { &["<pad>", "<eos>", "<bos>", "<unk>"] } else { &["<unk>", "<s>", "</s>"] };
        let letter = |i: usize| char::from(b'a' + u8::try_from(i % 26).unwrap());
        let words = (0..words).map(|i| format!("\u{2581}{}{}", letter(i / 26), letter(i)));
        // No whole words.
        let others = (0..size).map(|i| format!("\u{2581}{i}"));
        let tokens = special.iter().map(|token| (*token).to_owned()).chain(words).chain(others).take(size);
        let vocab: Map<String, Value> = tokens.enumerate().map(|(i, token)| (token, json!(i))).collect();
        let tokenizer =
            json!({ "version": "1.0", "added_tokens": [], "model": { "type": "BPE", "vocab": vocab, "merges": [] } });
        fs::write(dir.join("tokenizer.json"), tokenizer.to_string()).unwrap();
        fs::remove_file(dir.join("tokenizer.model")).unwrap();
        // Where it is set, the class opens tokenizer.model.
        let config = dir.join("tokenizer_config.json");
        let mut settings: Map<String, Value> = serde_json::from_slice(&fs::read(&config).unwrap()).unwrap();
        settings.remove("add_prefix_space");
        fs::write(config, Value::Object(settings).to_string()).unwrap();
    }
}

const FIT: [&str; 4] = ["--set", "projector=fit", "--set", "spatial=fit"];

#[test]
fn a_fitted_projector_is_recorded_and_made_again() {
    let work = TempDir::new().unwrap();
    donors(work.path(), 160);
    let (vision, language, out) = (work.path().join("vision"), work.path().join("language"), work.path().join("out"));
    let args = [&FIT[..], &["--set", "scale=text", "--output-format", "json"]].concat();
    let merged = merge(&vision, &language, &out, &args);
    assert_eq!(merged.status.code(), Some(0), "{}", text(&merged));
    let merged = report(&merged);
    assert_eq!(merged["merge"]["transforms"], json!({ "copy": 349, "sample-rows": 2, "map": 3 }));
    // The spatial embedding has rows of the embedding itself, which no factor changes.
    let changed = merged["merge"]["changed"].as_array().unwrap().iter();
    let scales = changed.filter(|changed| changed["transform"] == "map").map(|changed| changed["scale"].is_number());
    assert_eq!(scales.collect::<Vec<_>>(), [true, true, false]);
    let notes = merged["merge"]["notes"].as_array().unwrap();
    let told: Vec<&str> = notes.iter().filter_map(Value::as_str).filter(|note| note.contains("cosine")).collect();
    snapshot!("merge-fitted-notes", told.join("\n"));
    let tensors = read(&out);
    for (name, shape) in [
        ("multi_modal_projector.linear.weight", vec![64, 32]),
        ("multi_modal_projector.linear.bias", vec![64]),
        ("spatial_embed_tokens.weight", vec![22, 64]),
    ] {
        assert_eq!(tensors[name].1, shape, "{name}");
    }
    let role = |role: &str, dir: &Path| format!("{role}={}", dir.display());
    let donors = [role("vision", &vision), role("language", &language)];
    let verified = doctor(&["verify", out.to_str().unwrap(), "--donor", &donors[0], "--donor", &donors[1]]);
    assert_eq!(verified.status.code(), Some(0), "{}", text(&verified));
    // Another value of the projector is found.
    let path = fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().path());
    let shards = path.filter(|path| path.extension().is_some_and(|end| end == "safetensors"));
    let projector = &tensors["multi_modal_projector.linear.bias"].2;
    for shard in shards {
        let mut bytes = fs::read(&shard).unwrap();
        let found = bytes.windows(projector.len()).position(|window| window == projector.as_slice());
        if let Some(at) = found {
            bytes[at] ^= 1;
            fs::write(&shard, bytes).unwrap();
        }
    }
    let verified = doctor(&["verify", out.to_str().unwrap(), "--donor", &donors[0], "--donor", &donors[1]]);
    assert_eq!(verified.status.code(), Some(1), "{}", text(&verified));
}

#[test]
fn vocabularies_with_few_words_in_common_fit_nothing() {
    let work = TempDir::new().unwrap();
    donors(work.path(), 99);
    let (vision, language) = (work.path().join("vision"), work.path().join("language"));
    let refused = merge(&vision, &language, &work.path().join("out"), &FIT);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    let shown = String::from_utf8_lossy(&refused.stdout).into_owned();
    let seams: Vec<&str> =
        shown.lines().filter(|line| line.contains("whole words") || line.contains("--set")).collect();
    snapshot!("merge-fitted-refused", seams.join("\n"));
}
