//! Config values and classes inferred from tensors, on the maps of real and tiny checkpoints, and `inspect` from the
//! outside.

use std::fs;
use std::path::{Path, PathBuf};

use ckpt_doctor::check::inspect::{CacheInput, Inspection, inspect};
use ckpt_doctor::check::load::LoadReport;
use ckpt_doctor::check::load::{Stored, predict};
use ckpt_doctor::check::votes::{Votes, explain, vote};
use ckpt_doctor::checkpoint::{Checkpoint, Dtype, Parts, Shard, Tensor};
use ckpt_doctor::knowledge::{Library, Loader};
use ckpt_doctor::report::Style;
use ckpt_doctor::report::inspect::full;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::data::{Map, config, map};

const CACHE: CacheInput = CacheInput { context: None, batch: 1 };

fn votes(config: &Value, map: &Map) -> Votes {
    let library = Library::embedded();
    let stored = Stored::from_shapes(map.clone());
    let architecture = library.find(config, stored.names(), Loader::V4_47_0).expect("known");
    vote(architecture, config, &stored).expect("built")
}

/// A checkpoint with these tensors and no documents.
fn bare(map: Map) -> Checkpoint {
    let tensor = |(name, shape)| Tensor { name, dtype: Dtype::BF16, shape, begin: 0, end: 0 };
    let shard = Shard {
        name: "model.safetensors".to_owned(),
        tensors: map.into_iter().map(tensor).collect(),
        ..Shard::default()
    };
    Checkpoint::planned("bare", Parts { shards: vec![shard], ..Parts::default() })
}

#[test]
fn the_right_value_is_inferred_for_a_wrong_one() {
    for (name, pointers) in [
        (
            "spatialvla-tiny",
            &[
                "/text_config/hidden_size",
                "/text_config/vocab_size",
                "/text_config/num_hidden_layers",
                "/text_config/intermediate_size",
                "/text_config/num_key_value_heads",
                "/vision_config/patch_size",
                "/vision_config/image_size",
                "/vision_config/num_hidden_layers",
                "/projection_dim",
                "/spatial_token_num",
                "/use_vision_zoe",
                "/use_spatial_token",
            ][..],
        ),
        (
            "llava3d-tiny",
            &[
                "/hidden_size",
                "/vocab_size",
                "/num_hidden_layers",
                "/intermediate_size",
                "/num_key_value_heads",
                "/mm_hidden_size",
            ][..],
        ),
    ] {
        let (right, stored) = (config(name), map(name));
        for pointer in pointers {
            let mut wrong = right.clone();
            let value = wrong.pointer_mut(pointer).unwrap_or_else(|| panic!("{name} has no {pointer}"));
            *value = match value.as_u64() {
                Some(n) if pointer.ends_with("layers") => json!(n + 1),
                Some(n) => json!(n * 2),
                None => json!(!value.as_bool().expect("a flag")),
            };
            let votes = votes(&wrong, &stored);
            let inferred: Vec<_> = votes.outvoted().map(|v| (v.pointer.as_str(), &v.voted_value)).collect();
            assert_eq!(inferred, [(*pointer, right.pointer(pointer).expect("there"))], "{name}");
        }
    }
}

/// Inferred values equal those of the real config, for all keys that it sets.
fn assert_agrees(proven: &Value, config: &Value, place: &str) {
    match (proven, config) {
        (_, Value::Null) => {}
        (Value::Object(proven), Value::Object(config)) => {
            for (key, value) in proven {
                assert_agrees(value, config.get(key).unwrap_or(&Value::Null), &format!("{place}/{key}"));
            }
        }
        (Value::Array(proven), Value::Array(config)) => {
            assert_eq!(proven.len(), config.len(), "{place}");
            for (i, (proven, config)) in proven.iter().zip(config).enumerate() {
                assert_agrees(proven, config, &format!("{place}/{i}"));
            }
        }
        _ => assert_eq!(proven, config, "{place}"),
    }
}

#[test]
fn without_a_config_class_and_values_are_found() {
    for (name, class, values) in [
        ("llava3d-tiny", "LlavaLlamaForCausalLM", 5),
        ("spatialvla-tiny", "SpatialVLAForConditionalGeneration", 30),
        ("llava3d-7b", "LlavaLlamaForCausalLM", 5),
    ] {
        let found: Inspection = inspect(&bare(map(name)), &Library::embedded(), CACHE);
        assert_eq!(found.classes[0].class, class, "{name}");
        let votes = found.votes.as_ref().expect("votes");
        assert!(votes.after.is_exact(), "{name}: {:?}", votes.after);
        assert!(votes.votes.len() >= values, "{name}: {} values", votes.votes.len());
        assert_agrees(&found.proven, &config(name), name);
    }
}

#[test]
fn names_unlike_any_class_are_reported() {
    let found = inspect(&bare(Map::from([("a.b".to_owned(), vec![2])])), &Library::embedded(), CACHE);
    assert_eq!((found.classes.len(), found.proven.is_null()), (0, true));
    assert_eq!(found.notes, ["no known class has tensor names like these"]);
}

#[test]
fn unexplained_tensors_remain_in_the_report() {
    let library = Library::embedded();
    let mut config = config("llava3d-tiny");
    config["vocab_size"] = json!(341);
    let mut shapes = map("llava3d-tiny");
    shapes.insert("model.norm.weight".to_owned(), vec![3]);
    let stored = Stored::from_shapes(shapes);
    let architecture = library.find(&config, stored.names(), Loader::V4_47_0).expect("known");
    let expected = architecture.expect_given(&config, &stored.evidence()).expect("built");
    let report = predict(&expected, &stored);
    assert_eq!(report.mismatched.len(), 3);
    let explained = explain(architecture, &config, &expected, &stored, &report).expect("explained");
    assert_eq!(explained.votes.iter().map(|v| v.pointer.as_str()).collect::<Vec<_>>(), ["/vocab_size"]);
    assert_eq!(explained.rest.mismatched.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(), ["model.norm.weight"]);
    let sound = LoadReport::default();
    assert!(explain(architecture, &config, &expected, &stored, &sound).is_none(), "what is clean needs no explanation");
}

fn donor(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors").join(name)
}

fn doctor(dir: &Path, args: &[&str]) -> String {
    let run = crate::support::program().current_dir(dir).arg("inspect").args(args).output().unwrap();
    assert_eq!(run.status.code(), Some(0), "{}", String::from_utf8_lossy(&run.stderr));
    String::from_utf8(run.stdout).unwrap()
}

/// A copy of a donor below `work`, with another config.
fn copy(work: &TempDir, name: &str, change: impl FnOnce(&mut Value)) {
    let to = work.path().join(name);
    fs::create_dir_all(&to).unwrap();
    for entry in fs::read_dir(donor(name)).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
    }
    let path = to.join("config.json");
    let mut config: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut config);
    if config.is_null() {
        fs::remove_file(path).unwrap();
    } else {
        fs::write(path, serde_json::to_vec_pretty(&config).unwrap()).unwrap();
    }
}

/// Removes the classes after the best one: every new architecture file changes them.
fn without_others(shown: &str, format: &str) -> String {
    if format == "full" {
        let lines = shown.lines().filter(|line| !line.starts_with("    next: "));
        return lines.collect::<Vec<_>>().join("\n");
    }
    let mut value: Value = serde_json::from_str(shown).unwrap();
    value["classes"].as_array_mut().unwrap().truncate(1);
    serde_json::to_string_pretty(&value).unwrap()
}

#[test]
fn inspect_summarises_a_checkpoint() {
    let work = TempDir::new().unwrap();
    let shots = |what: &str| {
        for format in ["full", "json"] {
            let shown = doctor(work.path(), &["llava3d-tiny", "--output-format", format]);
            snapshot!(format!("inspect-{what}-{format}"), without_others(&shown, format));
        }
    };
    copy(&work, "llava3d-tiny", |c| c["vocab_size"] = json!(1000));
    shots("outvoted");
    copy(&work, "llava3d-tiny", |c| *c = Value::Null);
    shots("no-config");
}

/// For a terminal of 80 columns no name of a value or of a class is broken.
#[test]
fn inspect_fits_a_narrow_terminal() {
    let work = TempDir::new().unwrap();
    copy(&work, "spatialvla-tiny", |c| c["vision_config"]["patch_size"] = json!(16));
    let checkpoint = Checkpoint::open(work.path().join("spatialvla-tiny")).unwrap();
    let inspection = inspect(&checkpoint, &Library::embedded(), CACHE);
    let style = Style { width: Some(80), cap: 8, ..Style::default() };
    let shown = full("spatialvla-tiny", &inspection, &[], Some(1), style);
    let below = shown.find("  class by config").unwrap();
    snapshot!("inspect-narrow", without_others(&shown[below..], "full"));
}

#[test]
fn modules_are_a_tree_with_repeats_folded() {
    for depth in ["0", "1"] {
        let shown = doctor(&donor("spatialvla-tiny"), &["--depth", depth]);
        let tree = shown.split("\n\n").find(|section| section.starts_with("  modules")).unwrap();
        snapshot!(format!("inspect-depth-{depth}"), tree);
    }
}

#[test]
fn tensors_are_listed_with_their_places() {
    let dir = donor("llava3d-tiny");
    snapshot!("inspect-tensors-full", doctor(&dir, &["--tensors=model.layers.*.?_proj*"]));
    assert_eq!(doctor(&dir, &["--tensors"]).lines().count(), 77);
    let shown = doctor(&dir, &["--tensors=*norm.weight", "--output-format", "json"]);
    let shown: Value = serde_json::from_str(&shown).unwrap();
    snapshot!("inspect-tensors-json", serde_json::to_string_pretty(&shown["tensor_list"]).unwrap());
    let plain = doctor(&dir, &["--output-format", "json"]);
    assert!(!plain.contains("tensor_list"), "{plain}");
}

/// The bytes at the offset of a tensor are those of the tensor.
#[test]
fn offsets_count_from_the_start_of_the_file() {
    let work = TempDir::new().unwrap();
    let header = json!({ "l.10.w": { "dtype": "U8", "shape": [4], "data_offsets": [0, 4] },
        "l.9.w": { "dtype": "U8", "shape": [4], "data_offsets": [4, 8] } });
    let header = header.to_string();
    let mut bytes = u64::try_from(header.len()).unwrap().to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(b"last1st.");
    fs::write(work.path().join("x.safetensors"), &bytes).unwrap();
    let shown = doctor(work.path(), &["x.safetensors", "--tensors", "--output-format", "json"]);
    let shown: Value = serde_json::from_str(&shown).unwrap();
    let first = &shown["tensor_list"][0];
    let offset = usize::try_from(first["offset"].as_u64().unwrap()).unwrap();
    assert_eq!((&first["name"], bytes.get(offset..)), (&json!("l.9.w"), Some(&b"1st."[..])));
}

#[test]
fn a_list_that_lacks_tensors_says_so() {
    let work = TempDir::new().unwrap();
    fs::write(work.path().join("x.safetensors"), b"\x20\0\0\0\0\0\0\0{\"a\": {").unwrap();
    let args = ["inspect", "--tensors", "x.safetensors"];
    let run = crate::support::program().current_dir(work.path()).args(args).output().unwrap();
    assert_eq!(run.status.code(), Some(0));
    let said = String::from_utf8(run.stderr).unwrap();
    assert_eq!(said, "note: x.safetensors: not all tensors could be read\n");
}

#[test]
fn a_pattern_without_a_match_is_an_error() {
    let args = ["inspect", "--tensors=nothing.*"];
    let run = crate::support::program().current_dir(donor("llava3d-tiny")).args(args).output().unwrap();
    assert_eq!((run.status.code(), run.stdout.len()), (Some(2), 0));
    let said = String::from_utf8(run.stderr).unwrap();
    assert!(said.contains("none of 76 tensors matches `nothing.*`"), "{said}");
}

#[test]
fn a_shard_alone_and_a_shard_of_a_checkpoint() {
    let work = TempDir::new().unwrap();
    let shard = "model-00001-of-00002.safetensors";
    fs::copy(donor("llava3d-tiny").join(shard), work.path().join("loose.safetensors")).unwrap();
    let read = |dir: &Path, file: &str| -> Value {
        serde_json::from_str(&doctor(dir, &[file, "--output-format", "json"])).unwrap()
    };
    assert_eq!(read(work.path(), "loose.safetensors")["tensors"]["tensors"], 73);
    assert_eq!(read(&donor("llava3d-tiny"), shard)["tensors"]["tensors"], 76);
}

#[test]
fn hostile_names_are_escaped() {
    let work = TempDir::new().unwrap();
    let header = json!({ "a\u{1b}[2J\u{202e}.b": { "dtype": "F32", "shape": [1], "data_offsets": [0, 4] },
        "model.norm.weight": { "dtype": "F32", "shape": [9_007_199_254_740_993_u64, 0], "data_offsets": [4, 4] } });
    let header = header.to_string();
    let mut bytes = u64::try_from(header.len()).unwrap().to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend([0; 4]);
    fs::write(work.path().join("x.safetensors"), bytes).unwrap();
    for format in ["full", "json"] {
        for more in [&[][..], &["--depth=0"], &["--tensors"]] {
            let shown = doctor(work.path(), &[&["x.safetensors", "--output-format", format], more].concat());
            assert!(!shown.contains(['\u{1b}', '\u{202e}']), "{shown}");
        }
    }
}
