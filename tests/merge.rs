//! `build-merged` from the outside: what it writes, what it refuses, and that donors stay as they are.
#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::disallowed_methods,
    missing_docs,
    reason = "a test that panics has failed, as it should"
)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::SystemTime;

use serde_json::Value;
use tempfile::TempDir;

fn donor(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors").join(name)
}

fn doctor(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ckpt-doctor")).args(args).output().unwrap()
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

/// What is in a directory, hidden names too: nothing may be left behind by a run that failed.
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
fn the_default_merge_is_written_whole_and_checks_clean() {
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
    assert_eq!(report["merge"]["transforms"], serde_json::json!({ "copy": 349, "grow-rows": 2, "pad": 3 }));
    let written = report["checkpoints"].as_array().unwrap().last().unwrap().clone();
    assert_eq!(written["counts"]["error"], 0);
    assert_eq!(written["counts"]["warning"], 0);
    for list in ["missing", "unexpected", "mismatched", "silent"] {
        assert_eq!(written["loads"][0][list], serde_json::json!([]), "{list}");
    }
    assert_eq!(names(work.path()), ["merged"]);
    assert_eq!(
        before,
        (state(&donor("spatialvla-tiny")), state(&donor("llava3d-tiny"))),
        "donors are never written to"
    );
    let check = doctor(&["check", out.to_str().unwrap(), "--fail-on", "warning"]);
    assert_eq!(check.status.code(), Some(0), "{}", text(&check));
    // Strict JSON throughout, though the donor has Infinity.
    for (name, bytes) in content(&out).iter().filter(|(n, _)| n.ends_with(".json")) {
        serde_json::from_slice::<Value>(bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
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
        let from = if entry["source"]["donor"] == "vision" { &vision } else { &language };
        let source = &from[entry["source"]["name"].as_str().unwrap()];
        let result = &merged[entry["name"].as_str().unwrap()];
        match entry["transform"].as_str().unwrap() {
            "copy" => {
                assert_eq!(source, result, "{}", entry["name"]);
                copied += 1;
            }
            "grow-rows" => assert!(result.2.starts_with(&source.2), "{}", entry["name"]),
            "pad" => assert_eq!(result.2[..16], source.2[..16], "{}", entry["name"]),
            other => panic!("{other}"),
        }
    }
    assert_eq!((copied, merged.len()), (349, 354));
}

#[test]
fn the_same_merge_gives_the_same_bytes() {
    let work = TempDir::new().unwrap();
    let (a, b) = (work.path().join("a"), work.path().join("b"));
    for out in [&a, &b] {
        assert_eq!(tiny(out, &["--set", "projector=reinit", "--set", "tokenizer=baked"]).status.code(), Some(0));
    }
    let (mut a, mut b) = (content(&a), content(&b));
    // The report names the directory it describes.
    a.remove("merge-report.md");
    b.remove("merge-report.md");
    assert!(a == b);
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
                                assert_eq!(run.status.code(), Some(1), "{options:?}\n{}", text(&run));
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
fn a_seam_names_both_tensors_both_shapes_and_the_options() {
    let work = TempDir::new().unwrap();
    let run = tiny(&work.path().join("out"), &["--set", "projector=keep"]);
    let said = text(&run);
    assert_eq!(run.status.code(), Some(1));
    for word in [
        "multi_modal_projector.linear.weight",
        "[48, 32]",
        "[64, 32]",
        "model.embed_tokens.weight",
        "[340, 64]",
        "--set projector=pad",
        "--set projector=reinit",
    ] {
        assert!(said.contains(word), "{word} is not in\n{said}");
    }
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
    assert_eq!(refused.status.code(), Some(1), "{}", text(&refused));
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
fn a_target_in_the_way_is_refused() {
    let work = TempDir::new().unwrap();
    let vision = work.path().join("vision");
    copy(&donor("spatialvla-tiny"), &vision);
    let full = work.path().join("full");
    fs::create_dir(&full).unwrap();
    fs::write(full.join("mine"), "keep me").unwrap();
    fs::write(work.path().join("file"), "keep me").unwrap();
    std::os::unix::fs::symlink(&vision, work.path().join("link")).unwrap();
    let before = state(&vision);
    let cases = [
        (vision.clone(), "is the donor"),
        (work.path().join("vision/../vision"), "is the donor"),
        (work.path().join("link"), "is the donor"),
        (vision.join("inside"), "lies inside the donor"),
        (work.path().to_owned(), "contains the donor"),
        (full.clone(), "with files in it"),
        (work.path().join("file"), "is a file"),
        (work.path().join("no/such/parent"), "does not exist"),
    ];
    for (out, reason) in cases {
        let run = merge(&vision, &donor("llava3d-tiny"), &out, &[]);
        assert_eq!(run.status.code(), Some(2), "{}: {}", out.display(), text(&run));
        assert!(text(&run).contains(reason), "{}: {}", out.display(), text(&run));
    }
    assert_eq!(before, state(&vision));
    assert_eq!(names(work.path()), ["file", "full", "link", "vision"]);
    // An empty directory is as good as none.
    let empty = work.path().join("empty");
    fs::create_dir(&empty).unwrap();
    assert_eq!(merge(&vision, &donor("llava3d-tiny"), &empty, &[]).status.code(), Some(0));
}

/// What is done to a donor.
type Damage = fn(&Path);

#[test]
fn a_damaged_donor_stops_the_merge_and_says_why() {
    let work = TempDir::new().unwrap();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n";
    let cases: [(&str, Damage, &[&str]); 5] = [
        (
            "missing",
            |d| fs::remove_file(d.join("model-00002-of-00005.safetensors")).unwrap(),
            &["model-00002-of-00005.safetensors", "not there"],
        ),
        ("pointer", |_| {}, &["model-00003-of-00005.safetensors", "git-lfs pointer", "git lfs pull"]),
        (
            "fifo",
            |d| {
                fs::remove_file(d.join("config.json")).unwrap();
                assert!(Command::new("mkfifo").arg(d.join("config.json")).status().unwrap().success());
            },
            &["config.json", "FIFO"],
        ),
        (
            "truncated",
            |d| {
                let path = d.join("model-00004-of-00005.safetensors");
                let bytes = fs::read(&path).unwrap();
                fs::write(&path, &bytes[..bytes.len() - 100]).unwrap();
            },
            &["model-00004-of-00005.safetensors", "cut short", "100"],
        ),
        ("broken-json", |d| fs::write(d.join("config.json"), "{\"model_type\": ").unwrap(), &["config.json"]),
    ];
    for (name, damage, words) in cases {
        let vision = work.path().join(name);
        copy(&donor("spatialvla-tiny"), &vision);
        damage(&vision);
        if name == "pointer" {
            fs::write(vision.join("model-00003-of-00005.safetensors"), pointer).unwrap();
        }
        let out = work.path().join("out");
        let run = merge(&vision, &donor("llava3d-tiny"), &out, &["--recipe", "spatialvla-llava3d"]);
        assert!(matches!(run.status.code(), Some(1 | 2)), "{name}: {}", text(&run));
        for word in words {
            assert!(text(&run).contains(word), "{name}: {word} is not in\n{}", text(&run));
        }
        assert!(!out.exists() && !work.path().join(".out.partial").exists(), "{name}");
    }
}

#[test]
fn a_donor_document_that_says_two_things_is_refused() {
    let work = TempDir::new().unwrap();
    let language = work.path().join("language");
    copy(&donor("llava3d-tiny"), &language);
    let path = language.join("config.json");
    let config = fs::read_to_string(&path).unwrap();
    fs::write(&path, config.replacen('{', "{ \"rms_norm_eps\": 0.1,", 1)).unwrap();
    let out = work.path().join("out");
    let run = merge(&donor("spatialvla-tiny"), &language, &out, &[]);
    assert_eq!(run.status.code(), Some(2), "{}", text(&run));
    for word in ["language", "config.json", "rms_norm_eps", "twice"] {
        assert!(text(&run).contains(word), "{word}: {}", text(&run));
    }
    assert_eq!(names(work.path()), ["language"]);
}

#[test]
fn a_dry_run_writes_nothing_and_tells_the_plan() {
    let work = TempDir::new().unwrap();
    let run = tiny(&work.path().join("out"), &["--dry-run", "--output-format", "json"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let report = json(&run);
    assert_eq!(report["merge"]["stage"], "dry-run");
    assert_eq!(report["merge"]["tensors"], 354);
    assert_eq!(names(work.path()), Vec::<String>::new());
}

#[test]
fn staging_of_a_crashed_run_is_cleared_and_anybody_elses_is_not() {
    let work = TempDir::new().unwrap();
    let stale = work.path().join(".out.partial");
    fs::create_dir_all(stale.join("content")).unwrap();
    fs::write(stale.join("content/model.safetensors"), "half").unwrap();
    fs::write(stale.join("ckpt-doctor-owner"), "process 1").unwrap();
    let out = work.path().join("out");
    assert_eq!(tiny(&out, &[]).status.code(), Some(0));
    assert_eq!(names(work.path()), ["out"]);
    fs::remove_dir_all(&out).unwrap();

    fs::create_dir_all(&stale).unwrap();
    fs::write(stale.join("thesis.txt"), "years of work").unwrap();
    let run = tiny(&out, &[]);
    assert_eq!(run.status.code(), Some(2), "{}", text(&run));
    assert_eq!(fs::read_to_string(stale.join("thesis.txt")).unwrap(), "years of work");
    assert_eq!(names(&stale), ["thesis.txt"]);
}

#[test]
fn a_run_under_way_is_respected() {
    let work = TempDir::new().unwrap();
    let staging = work.path().join(".out.partial");
    fs::create_dir(&staging).unwrap();
    fs::write(staging.join("ckpt-doctor-owner"), "process 4711").unwrap();
    let lock = fs::File::open(staging.join("ckpt-doctor-owner")).unwrap();
    lock.lock().unwrap();
    let run = tiny(&work.path().join("out"), &[]);
    assert_eq!(run.status.code(), Some(2));
    assert!(text(&run).contains("process 4711"), "{}", text(&run));
    assert_eq!(names(&staging), ["ckpt-doctor-owner"]);
}

#[test]
fn keys_that_switch_on_code_never_travel() {
    let work = TempDir::new().unwrap();
    let language = work.path().join("language");
    copy(&donor("llava3d-tiny"), &language);
    let path = language.join("config.json");
    let mut config: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    config["use_kernels"] = true.into();
    config["auto_map"] = serde_json::json!({ "AutoConfig": "someone/repo--evil.Config" });
    config["mm_video_tower"] = "SpatialAwareModule".into();
    fs::write(&path, config.to_string()).unwrap();
    let out = work.path().join("out");
    let run = merge(&donor("spatialvla-tiny"), &language, &out, &[]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let merged = fs::read_to_string(out.join("config.json")).unwrap();
    for key in ["use_kernels", "evil", "mm_", "trust_remote_code"] {
        assert!(!merged.contains(key), "{key} in {merged}");
    }
}

#[test]
fn bad_requests_end_with_two_and_a_sentence() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let (vision, language) = (donor("spatialvla-tiny"), donor("llava3d-tiny"));
    let cases: [(&[&str], &str); 6] = [
        (&["--set", "colour=red"], "has no option colour"),
        (&["--set", "projector=fold"], "projector=fold is not one of pad, reinit, keep"),
        (&["--set", "shard-size=big"], "is not a size"),
        (&["--set", "alias=forward:os;rm"], "is not one of"),
        (&["--recipe", "nonesuch"], "no recipe nonesuch"),
        (&["--recipe", "paligemma-llama"], "has to be paligemma"),
    ];
    for (more, reason) in cases {
        let run = merge(&vision, &language, &out, more);
        assert_eq!(run.status.code(), Some(2), "{more:?}: {}", text(&run));
        assert!(text(&run).contains(reason), "{more:?}: {}", text(&run));
        assert!(!out.exists());
    }
    // The roles the other way round: no recipe fits.
    let run = merge(&language, &vision, &out, &[]);
    assert_eq!(run.status.code(), Some(2));
    assert!(text(&run).contains("no recipe fits"), "{}", text(&run));
}
