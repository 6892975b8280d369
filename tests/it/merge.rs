//! `build-merged` from the outside: what it writes, what it refuses, and unchanged donors.

mod adapter;
mod foreign;
mod law;
mod parts;
mod recipes;
mod record;
mod refused;
mod scale;
mod users;
mod values;
mod verify;
mod word_fit;
mod writing;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::time::SystemTime;

use serde_json::Value;
use tempfile::TempDir;

fn donor(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors").join(name)
}

fn doctor(args: &[&str]) -> Output {
    crate::support::program().args(args).output().unwrap()
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

fn merge(vision: &Path, language: &Path, out: &Path, more: &[&str]) -> Output {
    let path = |p: &Path| p.to_str().unwrap().to_owned();
    let (vision, language, out) = (path(vision), path(language), path(out));
    let mut args = vec!["build-merged", "--vision", &vision, "--language", &language, "--out", &out];
    args.extend(more);
    doctor(&args)
}

fn tiny(out: &Path, more: &[&str]) -> Output {
    merge(&donor("spatialvla-tiny"), &donor("llava3d-tiny"), out, more)
}

/// Names and bytes of a directory.
fn content(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(dir).unwrap().map(|e| e.unwrap());
    entries.map(|e| (e.file_name().into_string().unwrap(), fs::read(e.path()).unwrap())).collect()
}

/// Bytes and times of a directory.
fn state(dir: &Path) -> BTreeMap<String, (Vec<u8>, SystemTime)> {
    content(dir)
        .into_iter()
        .map(|(n, b)| (n.clone(), (b, fs::metadata(dir.join(n)).unwrap().modified().unwrap())))
        .collect()
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir(to).unwrap();
    for (name, bytes) in content(from) {
        fs::write(to.join(name), bytes).unwrap();
    }
}

/// Names in a directory, including hidden ones: a failed run must leave nothing.
fn names(dir: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_default_merge_is_complete_and_checks_clean() {
    let work = TempDir::new().unwrap();
    let before = (state(&donor("spatialvla-tiny")), state(&donor("llava3d-tiny")));
    let out = work.path().join("merged");
    let run = tiny(&out, &["--output-format", "json"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let report = json(&run);
    let stages: Vec<&str> = report
        .pointer("/merge/stages")
        .unwrap()
        .as_array()
        .unwrap()
        .iter()
        .map(|s| s["name"].as_str().unwrap())
        .collect();
    assert_eq!(stages, ["donors", "recipe", "plan", "check planned", "write", "check written"]);
    assert_eq!(report["merge"]["transforms"], serde_json::json!({ "copy": 349, "sample-rows": 2, "pad": 3 }));
    let written = report["checkpoints"].as_array().unwrap().last().unwrap().clone();
    assert_eq!(written["counts"]["error"], 0);
    assert_eq!(written["counts"]["warning"], 0);
    for list in ["missing", "unexpected", "mismatched", "silent"] {
        assert_eq!(written["loads"][0]["tensors"][list], serde_json::json!([]), "{list}");
    }
    assert_eq!(names(work.path()), ["merged"]);
    assert_eq!(
        before,
        (state(&donor("spatialvla-tiny")), state(&donor("llava3d-tiny"))),
        "donors are never written to"
    );
    let check = doctor(&["check", out.to_str().unwrap(), "--fail-on", "warning"]);
    assert_eq!(check.status.code(), Some(0), "{}", text(&check));
    // All documents are strict JSON, although the donor contains Infinity.
    for (name, bytes) in content(&out).iter().filter(|(n, _)| n.ends_with(".json")) {
        serde_json::from_slice::<Value>(bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
    }
}

/// The operation of an expression of a manifest, and its content.
fn operation(expression: &Value) -> (&str, &Value) {
    let (word, content) = expression.as_object().unwrap().iter().next().unwrap();
    (word, content)
}

/// The donor's tensor that an expression stands for.
fn stands_for(expression: &Value) -> &Value {
    match operation(expression) {
        ("stored", of) => of,
        ("initialise", content) => &content["instead-of"],
        ("cast" | "scale", content) => stands_for(&content["of"]),
        ("add-product", content) => stands_for(&content["to"]),
        (_, content) => &content["of"],
    }
}

/// A manifest as version 4 had it: each tensor with one source, one transform and its figures.
fn as_version_4(manifest: &mut Value) {
    manifest["schema"] = serde_json::json!(4);
    for tensor in manifest["tensors"].as_array_mut().unwrap() {
        let source = tensor["source"].take();
        if let ("scale", content) = operation(&source) {
            tensor["scale"] = content["by"].clone();
        }
        if let ("initialise", content) = operation(&source) {
            tensor["values"] = content["values"].clone();
        }
        tensor["source"] = stands_for(&source).clone();
    }
}

#[test]
fn copied_tensors_are_the_donors_bytes() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("merged");
    assert_eq!(tiny(&out, &["--set", "shard-size=300KB"]).status.code(), Some(0));
    let load = |dir: &Path| -> BTreeMap<String, (String, Vec<usize>, Vec<u8>)> {
        let shards = content(dir).into_iter().filter(|(n, _)| n.ends_with(".safetensors"));
        shards
            .flat_map(|(_, bytes)| {
                let parsed = safetensors::SafeTensors::deserialize(&bytes).unwrap();
                let own = |(n, t): (String, safetensors::tensor::TensorView<'_>)| {
                    (n, (t.dtype().to_string(), t.shape().to_vec(), t.data().to_vec()))
                };
                parsed.tensors().into_iter().map(own).collect::<Vec<_>>()
            })
            .collect()
    };
    let (merged, vision, language) = (load(&out), load(&donor("spatialvla-tiny")), load(&donor("llava3d-tiny")));
    let manifest: Value = serde_json::from_slice(&fs::read(out.join("merge-manifest.json")).unwrap()).unwrap();
    let mut copied = 0;
    for entry in manifest["tensors"].as_array().unwrap() {
        let source = stands_for(&entry["source"]);
        let from = if source["donor"] == "vision" { &vision } else { &language };
        let source = &from[source["name"].as_str().unwrap()];
        let result = &merged[entry["name"].as_str().unwrap()];
        match entry["transform"].as_str().unwrap() {
            "copy" => {
                assert_eq!(source, result, "{}", entry["name"]);
                copied += 1;
            }
            "sample-rows" => assert!(result.2.starts_with(&source.2), "{}", entry["name"]),
            "pad" => {
                // A factor of 8 changes only the exponent; that of Gemma 2 is rounded to bfloat16 like its products.
                let scale = entry["source"]["scale"]["by"].as_f64().unwrap();
                let [was, is] = [&source.2, &result.2].map(|b| bf16(b));
                for (was, is) in was.iter().zip(is).take(8) {
                    let tolerance = if scale.fract() == 0.0 { 0.0 } else { 2_f64.powi(-8) };
                    assert!((is - was * scale).abs() <= is.abs() * tolerance, "{}", entry["name"]);
                }
            }
            other => panic!("{other}"),
        }
    }
    assert_eq!((copied, merged.len()), (349, 354));
}

/// The values of bytes in bfloat16.
fn bf16(bytes: &[u8]) -> Vec<f64> {
    bytes.chunks(2).map(|c| f64::from(f32::from_le_bytes([0, 0, c[0], c[1]]))).collect()
}

#[test]
fn the_same_merge_gives_the_same_bytes() {
    let work = TempDir::new().unwrap();
    let options = ["--set", "projector=reinit", "--set", "tokenizer=baked"];
    let (a, b) = (work.path().join("a"), work.path().join("b"));
    assert_eq!(tiny(&a, &options).status.code(), Some(0));
    // Donors of other names in another place are the same donors.
    let (vision, language) = (work.path().join("first"), work.path().join("second"));
    copy(&donor("spatialvla-tiny"), &vision);
    copy(&donor("llava3d-tiny"), &language);
    assert_eq!(merge(&vision, &language, &b, &options).status.code(), Some(0));
    let (a, b) = (content(&a), content(&b));
    for (name, bytes) in &a {
        assert!(b[name] == *bytes, "{name}");
    }
    assert_eq!(a.len(), b.len());
}

#[test]
fn every_combination_of_options_merges_clean_or_stops_at_a_seam() {
    let work = TempDir::new().unwrap();
    let mut merged = 0;
    for projector in ["pad", "reinit", "keep"] {
        for spatial in ["off", "pad"] {
            for zoe in ["on", "off"] {
                for rows in ["grow", "keep"] {
                    for tokenizer in ["plain", "baked"] {
                        for layout in ["upstream", "wrapped"] {
                            let options = [
                                format!("projector={projector}"),
                                format!("spatial={spatial}"),
                                format!("zoe={zoe}"),
                                format!("rows={rows}"),
                                format!("tokenizer={tokenizer}"),
                                format!("layout={layout}"),
                            ];
                            let mut args: Vec<&str> = options.iter().flat_map(|o| ["--set", o.as_str()]).collect();
                            args.extend(["--output-format", "json"]);
                            let out = work.path().join("out");
                            let run = tiny(&out, &args);
                            let fits = projector != "keep"
                                && rows == "grow"
                                && (layout == "upstream" || (spatial == "off" && zoe == "off"));
                            let report = json(&run);
                            if fits {
                                assert_eq!(run.status.code(), Some(0), "{options:?}\n{}", text(&run));
                                let written = report["checkpoints"].as_array().unwrap().last().unwrap();
                                assert!(
                                    ["clean", "info"].contains(&written["verdict"].as_str().unwrap()),
                                    "{options:?}"
                                );
                                merged += 1;
                                fs::remove_dir_all(&out).unwrap();
                            } else {
                                assert_eq!(run.status.code(), Some(2), "{options:?}\n{}", text(&run));
                                assert_eq!(report["merge"]["stage"], "seam", "{options:?}");
                                assert!(
                                    !report["merge"]["seams"][0]["options"].as_array().unwrap().is_empty(),
                                    "{options:?}"
                                );
                            }
                            assert_eq!(names(work.path()), Vec::<String>::new(), "{options:?}");
                        }
                    }
                }
            }
        }
    }
    assert_eq!(merged, 20);
}

#[test]
fn forwarding_aliases_need_no_modules_of_the_donor() {
    let work = TempDir::new().unwrap();
    let vision = work.path().join("vision");
    copy(&donor("spatialvla-tiny"), &vision);
    for (name, _) in content(&vision).iter().filter(|(n, _)| n.ends_with(".py")) {
        fs::remove_file(vision.join(name)).unwrap();
    }
    let out = work.path().join("out");
    let refused = merge(&vision, &donor("llava3d-tiny"), &out, &[]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    assert!(text(&refused).contains("configuration_spatialvla.py") && !out.exists(), "{}", text(&refused));
    let code = donor("spatialvla-tiny");
    let lent = format!("code={}", code.display());
    let run = merge(&vision, &donor("llava3d-tiny"), &out, &["--donor", &lent]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    fs::remove_dir_all(&out).unwrap();
    let run = merge(&vision, &donor("llava3d-tiny"), &out, &["--set", "alias=forward:spatialvla.model"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let alias = fs::read_to_string(out.join("modeling_spatialvla_llava3d.py")).unwrap();
    assert!(alias.contains("spatialvla.model") && !alias.contains("{{"), "{alias}");
}

#[test]
fn a_dry_run_writes_nothing_and_reports_the_plan() {
    let work = TempDir::new().unwrap();
    let run = tiny(&work.path().join("out"), &["--dry-run", "--output-format", "json"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let report = json(&run);
    assert_eq!(report["merge"]["stage"], "dry-run");
    assert_eq!(report["merge"]["tensors"], 354);
    assert_eq!(names(work.path()), Vec::<String>::new());
    let planned = &report["merge"]["dry_run"];
    assert_eq!(
        planned["shards"],
        serde_json::json!([{ "name": "model.safetensors", "tensors": 354, "bytes": 1_619_678 }])
    );
    assert!(planned["free"].as_u64() > planned["needed"].as_u64(), "{planned}");
}

/// Removes the digests of donors' tensors from an expression.
fn without_digests(expression: &mut Value) {
    if let Value::Object(content) = expression {
        content.remove("digest");
        content.values_mut().for_each(without_digests);
    }
}

#[test]
fn a_dry_run_shows_the_config_and_writes_the_plan() {
    let work = TempDir::new().unwrap();
    let plan = work.path().join("plan.json");
    let run =
        tiny(&work.path().join("out"), &["--dry-run", "--plan", plan.to_str().unwrap(), "--set", "shard-size=300KB"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    assert_eq!(names(work.path()), ["plan.json"]);
    for line in ["\n  space: ", " to write, ", "model-00006-of-00006.safetensors", "-  \"image_token_index\": 1572,"] {
        assert!(text(&run).contains(line), "{line}: {}", text(&run));
    }
    assert!(text(&run).contains("--- config.json of donor vision\n+++ config.json\n@@"), "{}", text(&run));
    // The plan is what a merge does.
    assert_eq!(tiny(&work.path().join("out"), &["--set", "shard-size=300KB"]).status.code(), Some(0));
    let read = |path: &Path| -> Value { serde_json::from_slice(&fs::read(path).unwrap()).unwrap() };
    let (plan, mut manifest) = (read(&plan), read(&work.path().join("out/merge-manifest.json")));
    for tensor in manifest["tensors"].as_array_mut().unwrap() {
        tensor.as_object_mut().unwrap().remove("digest");
        without_digests(&mut tensor["source"]);
    }
    assert_eq!(plan["tensors"], manifest["tensors"]);
    let refused = tiny(&work.path().join("b"), &["--plan", "x.json"]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
}
