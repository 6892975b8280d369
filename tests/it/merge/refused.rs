//! Merges that `build-merged` refuses, and content that it does not copy.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use super::{content, copy, doctor, donor, merge, names, state, text, tiny};
use crate::support::make_base;

#[test]
fn an_occupied_target_is_refused() {
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
    // An empty directory is a valid target.
    let empty = work.path().join("empty");
    fs::create_dir(&empty).unwrap();
    assert_eq!(merge(&vision, &donor("llava3d-tiny"), &empty, &[]).status.code(), Some(0));
}

#[test]
fn without_descriptors_the_limit_is_named() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let script = "ulimit -n 8; exec \"$0\" \"$@\"";
    let mut command = Command::new("/bin/sh");
    command.env("XDG_STATE_HOME", crate::support::state());
    command.args(["-c", script, env!("CARGO_BIN_EXE_ckpt-doctor"), "build-merged"]);
    command.arg("--donor").arg(format!("vision={}", donor("spatialvla-tiny").display()));
    command.arg("--donor").arg(format!("language={}", donor("llava3d-tiny").display()));
    let run = command.arg("--out").arg(&out).output().unwrap();
    assert_eq!(run.status.code(), Some(2), "{}", text(&run));
    let said = text(&run);
    assert!(
        said.contains("opening: Too many open files (os error 24); raise the limit on open files (`ulimit -n`)"),
        "{said}"
    );
    assert!(!out.exists());
}

/// A change of a donor.
type Damage = fn(&Path);

#[test]
fn a_damaged_donor_stops_the_merge_with_a_reason() {
    let work = TempDir::new().unwrap();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n";
    let cases: [(&str, Damage, &[&str]); 5] = [
        (
            "missing",
            |d| fs::remove_file(d.join("model-00002-of-00005.safetensors")).unwrap(),
            &["model-00002-of-00005.safetensors", "is missing"],
        ),
        ("pointer", |_| {}, &["model-00003-of-00005.safetensors", "Git LFS pointer", "git lfs pull"]),
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
            &["model-00004-of-00005.safetensors", "truncated", "100"],
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
        assert_eq!(run.status.code(), Some(2), "{name}: {}", text(&run));
        for word in words {
            assert!(text(&run).contains(word), "{name}: {word} is not in\n{}", text(&run));
        }
        assert!(!out.exists() && !work.path().join(".out.partial").exists(), "{name}");
    }
}

#[test]
fn a_donor_document_with_a_duplicate_key_is_refused() {
    let work = TempDir::new().unwrap();
    let language = work.path().join("language");
    copy(&donor("llava3d-tiny"), &language);
    let path = language.join("config.json");
    let config = fs::read_to_string(&path).unwrap();
    fs::write(&path, config.replacen('{', "{ \"rms_norm_eps\": 0.1,", 1)).unwrap();
    let out = work.path().join("out");
    let run = merge(&donor("spatialvla-tiny"), &language, &out, &[]);
    assert_eq!(run.status.code(), Some(2), "{}", text(&run));
    for word in ["language", "config.json", "rms_norm_eps", "duplicate key"] {
        assert!(text(&run).contains(word), "{word}: {}", text(&run));
    }
    assert_eq!(names(work.path()), ["language"]);
}

#[test]
fn keys_that_run_code_are_never_copied() {
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
fn bad_requests_exit_with_2_and_a_message() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let (vision, language) = (donor("spatialvla-tiny"), donor("llava3d-tiny"));
    let cases: [(&[&str], &str); 6] = [
        (&["--set", "colour=red"], "has no option colour"),
        (&["--set", "projector=fold"], "projector=fold is not one of pad, fit, reinit, reinit-always, keep"),
        (&["--set", "shard-size=big"], "is not a size"),
        (&["--set", "alias=forward:os;rm"], "is not one of"),
        (&["--recipe", "nonesuch"], "nonesuch: unknown recipe"),
        (&["--recipe", "paligemma-llama"], "must be paligemma"),
    ];
    for (more, reason) in cases {
        let run = merge(&vision, &language, &out, more);
        assert_eq!(run.status.code(), Some(2), "{more:?}: {}", text(&run));
        assert!(text(&run).contains(reason), "{more:?}: {}", text(&run));
        assert!(!out.exists());
    }
    assert_eq!(merge(&vision, &language, &out, &["--recipe", "paligemma-llama"]).status.code(), Some(2));
}

/// Donors in each other's role, a missing donor, and donors that no recipe takes.
#[test]
fn donors_that_no_recipe_takes_are_explained() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let (vision, language) = (donor("spatialvla-tiny"), donor("llava3d-tiny"));
    let (vision, language, out) = (vision.to_str().unwrap(), language.to_str().unwrap(), out.to_str().unwrap());
    let run = |args: &[&str]| {
        let run = doctor(&[&["merge"], args, &["--out", out]].concat());
        assert_eq!(run.status.code(), Some(2), "{}", text(&run));
        text(&run)
    };
    let swapped = "the vision donor is llava_llama and the language donor spatialvla: exchange them";
    let texts = run(&["--vision", language, "--language", vision]);
    assert!(texts.contains(swapped), "{texts}");
    let texts = run(&["--vision", language, "--language", vision, "--recipe", "spatialvla-llava3d"]);
    assert!(texts.contains(swapped), "{texts}");
    let texts = run(&["--vision", vision]);
    let missing = "for the nearest, spatialvla-llava3d, the language donor is missing: --donor language=DIR";
    assert!(texts.contains(missing), "{texts}");
    let texts = run(&["--vision", language, "--language", language]);
    let unfit = "for the nearest, spatialvla-llava3d, the vision donor must be spatialvla or spatialvla_wrapped, but this is \
                 llava_llama; `ckpt-doctor recipes` lists all";
    assert!(texts.contains(unfit), "{texts}");
    let texts = run(&["--donor", &format!("nobody={language}")]);
    assert!(texts.contains("it has no nobody donor"), "{texts}");
}

#[test]
fn a_seam_names_both_tensors_both_shapes_and_the_options() {
    let work = TempDir::new().unwrap();
    let run = tiny(&work.path().join("out"), &["--set", "projector=keep"]);
    let output = text(&run);
    assert_eq!(run.status.code(), Some(2));
    for word in [
        "multi_modal_projector.linear.weight",
        "[48, 32]",
        "[64, 32]",
        "model.embed_tokens.weight",
        "[340, 64]",
        "--set projector=pad",
        "--set projector=reinit",
    ] {
        assert!(output.contains(word), "{word} is not in\n{output}");
    }
}

/// Wrong inputs, with `V` for the SpatialVLA donor, `L` for the LLaVA-3D one, `R` for a folder and `F` for a file in it.
const WRONG: [&str; 34] = [
    "build-merged --recipe spatialvla-lava3d --vision V --language L --out R/o",
    "build-merged --recipe zzz --vision V --language L --out R/o",
    "build-merged --recipe R/none.json5 --vision V --language L --out R/o",
    "build-merged --recipe F --vision V --language L --out R/o",
    "build-merged --donor visoin=V --language L --out R/o",
    "build-merged --donor V --language L --out R/o",
    "build-merged --vision V --out R/o",
    "build-merged --vision R/none --language L --out R/o",
    "build-merged --vision F --language L --out R/o",
    "build-merged --vision L --language V --out R/o",
    "build-merged --vision R/empty --language L --out R/o",
    "build-merged --vision V --language L",
    "build-merged --vision V --language L --out R/no/o",
    "build-merged --vision V --language L --out R",
    "build-merged --vision V --language L --out V",
    "build-merged --vision V --language L --out R/o --set spatail=off",
    "build-merged --vision V --language L --out R/o --set spatial=of",
    "build-merged --vision V --language L --out R/o --set spatial",
    "build-merged --vision V --language L --out R/o --set shard-size=5XB",
    "build-merged --vision V --language L --out R/o --set dtype=int4",
    "build-merged --vision V --language L --out R/o --for 4.99",
    "build-merged R/none.json5",
    "build-merged F",
    "extract V --part visoin --out R/o",
    "extract V --part tower --out R/o",
    "extract V --out R/o",
    "extract R/none --part vision --out R/o",
    "extract V --part vision --out R/o --set nope=1",
    "insert V --part language --from L --out R/o",
    "insert V --part langauge --from L --out R/o",
    "insert V --part language --from R/none --out R/o",
    "merge-adapter V L --out R/o",
    "verify R",
    "verify R/none",
];

#[test]
fn wrong_inputs_get_one_clear_line() {
    let work = TempDir::new().unwrap();
    fs::create_dir(work.path().join("empty")).unwrap();
    fs::write(work.path().join("file.json5"), "{ not: json5").unwrap();
    let place = work.path().display().to_string();
    let mut all = String::new();
    for typed in WRONG {
        let path = |word: &str| match word {
            "V" => donor("spatialvla-tiny").display().to_string(),
            "L" => donor("llava3d-tiny").display().to_string(),
            "F" => format!("{place}/file.json5"),
            "R" => place.clone(),
            _ => word
                .replace("R/", &format!("{place}/"))
                .replace("=V", &format!("={}", donor("spatialvla-tiny").display())),
        };
        let args: Vec<String> = typed.split(' ').map(path).collect();
        let run = doctor(&args.iter().map(String::as_str).collect::<Vec<_>>());
        assert_ne!(run.status.code(), Some(0), "{typed}");
        assert!(!work.path().join("o").exists(), "{typed}");
        let errors = String::from_utf8(run.stderr).unwrap();
        let lines: Vec<&str> = errors.lines().filter(|line| line.starts_with("error")).collect();
        assert_eq!(lines.len(), 1, "{typed}: {}{errors}", String::from_utf8_lossy(&run.stdout));
        let shown = lines[0].replace(&place, "R").replace(&format!("{}/", crate::support::project().display()), "");
        all.push_str(&format!("$ ckpt-doctor {typed}\n{shown}\n\n"));
    }
    snapshot!("merge-wrong-inputs", all);
}

/// A model one of whose tensors of the vision tower, or of the language model, has another name than its class gives it.
fn with_a_renamed_tensor(work: &Path, name: &str, old: &str) -> PathBuf {
    let dir = work.join(name);
    make_base("paligemma", &dir);
    let new = format!("{}x", &old[..old.len() - 1]);
    for (file, bytes) in content(&dir) {
        let found = bytes.windows(old.len()).position(|window| window == old.as_bytes());
        if let Some(at) = found.filter(|_| file.contains("safetensors")) {
            let mut bytes = bytes;
            bytes[at..at + old.len()].copy_from_slice(new.as_bytes());
            fs::write(dir.join(file), bytes).unwrap();
        }
    }
    dir
}

#[test]
fn faults_of_parts_that_are_not_used_do_not_stop_a_merge() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let run = |dir: &Path, more: &[&str]| {
        let mut args = vec!["extract", dir.to_str().unwrap(), "--out", out.to_str().unwrap(), "--part"];
        args.extend(more);
        let done = doctor(&args);
        let written = out.exists();
        drop(fs::remove_dir_all(&out));
        (done.status.code(), written, text(&done))
    };
    let tower = "vision_tower.vision_model.post_layernorm.weight";
    let damaged = with_a_renamed_tensor(work.path(), "tower", tower);
    let (code, written, said) = run(&damaged, &["language"]);
    assert_eq!((code, written), (Some(0), true), "{said}");
    assert!(said.contains("model has 1 error in parts that are not used"), "{said}");
    let (code, written, said) = run(&damaged, &["vision"]);
    assert_eq!((code, written), (Some(2), false), "{said}");
    // Who knows better goes on; what the result lacks is an error of the result.
    for rule in ["ARC003", "tensors-missing"] {
        let (code, written, said) = run(&damaged, &["vision", "--tolerate", rule]);
        assert_eq!((code, written), (Some(1), true), "{said}");
        assert!(said.contains("model has 1 error that --tolerate allows"), "{said}");
    }
    let (code, _, said) = run(&damaged, &["vision", "--tolerate", "tensors-mising"]);
    assert!(code == Some(2) && said.contains("did you mean"), "{said}");
    let (code, _, said) =
        run(&with_a_renamed_tensor(work.path(), "text", "language_model.model.norm.weight"), &["language"]);
    assert_eq!(code, Some(2), "{said}");
}
