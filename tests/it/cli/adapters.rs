//! Adapters with their base models: where one is found, and what is said then.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{make_base, program};

/// A folder with the adapter `lora` and the model `llama`, which the adapter names as `base`.
fn room(base: &str) -> TempDir {
    let room = TempDir::new().unwrap();
    for name in ["lora", "llama"] {
        fs::create_dir(room.path().join(name)).unwrap();
        make_base(name, &room.path().join(name));
    }
    edit(&room.path().join("lora"), "base_model_name_or_path", &json!(base));
    room
}

/// Sets a key of `adapter_config.json`.
fn edit(adapter: &Path, key: &str, value: &Value) {
    let path = adapter.join("adapter_config.json");
    let mut config: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    config[key] = value.clone();
    fs::write(path, config.to_string()).unwrap();
}

/// What is said of the adapter under transformers 5.23.0, in a run in `dir` with these arguments: the verdict, and why.
fn said(dir: &Path, hub: &Path, args: &[&str]) -> String {
    let mut program = program();
    program
        .current_dir(dir)
        .env("HF_HUB_CACHE", hub)
        .args(["check", "--isolated", "--output-format", "json"])
        .args(args);
    let output = program.output().unwrap();
    let report: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)));
    let adapter =
        report["checkpoints"].as_array().unwrap().iter().find(|c| c["path"].as_str().unwrap().ends_with("lora"));
    let load = &adapter.unwrap()["loads"][0];
    assert_eq!(load["loader"], "5.23.0");
    let object = &load["objects"][0];
    assert_eq!(object["object"], "adapter");
    let why = object.get("why").and_then(Value::as_str).unwrap_or_default();
    format!("{}{}{why}", object["verdict"].as_str().unwrap(), if why.is_empty() { "" } else { ": " })
}

#[test]
fn a_base_model_is_named_given_near_or_downloaded() {
    let nowhere = Path::new("/nowhere");
    let of = |base: &str, args: &[&str]| said(room(base).path(), nowhere, args);
    let unknown =
        |base: &str| format!("not-predicted: its base model {base} was not found; check --base DIR compares them");
    assert_eq!(of("someone/llama", &["lora"]), unknown("someone/llama"));
    assert_eq!(of("someone/llama", &["lora", "--base", "llama"]), "loads");
    assert_eq!(of("", &["lora"]), "not-predicted: it names no base model; check --base DIR compares them");
    assert_eq!(of("", &["lora", "--base", "llama"]), "loads");
    assert_eq!(of("../llama", &["lora"]), "loads");
    // As transformers resolves it, and as a directory of the run.
    assert_eq!(of("llama", &["lora"]), "loads");
    assert_eq!(of("./llama", &["llama", "lora"]), "loads");
    assert_eq!(of("someone/llama", &["llama", "lora"]), unknown("someone/llama"));
    let room = room("someone/llama");
    fs::create_dir(room.path().join("someone")).unwrap();
    fs::rename(room.path().join("llama"), room.path().join("someone/llama")).unwrap();
    let elsewhere = TempDir::new().unwrap();
    let (lora, zoo) = (room.path().join("lora"), room.path().join("someone"));
    let (lora, zoo) = (lora.to_str().unwrap(), zoo.to_str().unwrap());
    assert_eq!(said(elsewhere.path(), nowhere, &[lora, zoo]), "loads");
    assert_eq!(said(elsewhere.path(), nowhere, &[lora]), unknown("someone/llama"));
}

/// A path from the root is printed, and opened only if the user names it too.
#[test]
fn a_path_that_only_the_adapter_names_is_not_opened() {
    let room = room("");
    let model = room.path().join("llama").canonicalize().unwrap();
    edit(&room.path().join("lora"), "base_model_name_or_path", &json!(model));
    let nowhere = Path::new("/nowhere");
    assert!(said(room.path(), nowhere, &["lora"]).contains("was not found"));
    assert_eq!(said(room.path(), nowhere, &["lora", "llama"]), "loads");
}

#[test]
fn a_download_is_found_by_its_branch_or_commit() {
    let room = room("someone/llama");
    let hub = TempDir::new().unwrap();
    let repository = hub.path().join("models--someone--llama");
    fs::create_dir_all(repository.join("refs")).unwrap();
    fs::create_dir_all(repository.join("snapshots")).unwrap();
    fs::rename(room.path().join("llama"), repository.join("snapshots/abc123")).unwrap();
    let of = || said(room.path(), hub.path(), &["lora"]);
    assert!(of().contains("was not found"), "no branch");
    fs::write(repository.join("refs/main"), "abc123").unwrap();
    assert_eq!(of(), "loads");
    for (revision, is_found) in [("abc123", true), ("other", false), ("../../refs", false)] {
        edit(&room.path().join("lora"), "revision", &json!(revision));
        assert_eq!(of() == "loads", is_found, "{revision}");
    }
    fs::write(repository.join("refs/main"), "../../models--someone--llama/snapshots/abc123").unwrap();
    edit(&room.path().join("lora"), "revision", &Value::Null);
    assert!(of().contains("was not found"), "a branch is no path");
}

/// Whoever trains new tokens resizes the base model before, so it is not known whether the adapter opens.
#[test]
fn other_rows_than_those_of_the_base_model_are_not_predicted() {
    let of = |rows: u64| {
        let room = room("../llama");
        edit(&room.path().join("lora"), "modules_to_save", &json!(["lm_head"]));
        let shard = room.path().join("lora/adapter_model.safetensors");
        let bytes = fs::read(&shard).unwrap();
        let length = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
        let mut header: Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
        let (start, size) = (bytes.len() - 8 - length, usize::try_from(rows * 16 * 4).unwrap());
        header["base_model.model.lm_head.weight"] =
            json!({ "dtype": "F32", "shape": [rows, 16], "data_offsets": [start, start + size] });
        let header = header.to_string();
        let values = [&bytes[8 + length..], &vec![1; size]].concat();
        fs::write(&shard, [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &values].concat()).unwrap();
        said(room.path(), Path::new("/nowhere"), &["lora"])
    };
    assert_eq!(of(16), "loads");
    assert!(of(19).starts_with("not-predicted: it has other rows"), "{}", of(19));
}

/// What was not tried with PEFT is not said to load.
#[test]
fn bases_and_versions_that_were_not_tried_are_not_predicted() {
    let of = |key: &str, value: Value, args: &[&str]| {
        let room = room("../llama");
        let path = room.path().join("llama/config.json");
        let mut config: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        config[key] = value;
        fs::write(path, config.to_string()).unwrap();
        said(room.path(), Path::new("/nowhere"), &[&["lora"], args].concat())
    };
    for (key, value, args, why) in [
        (
            "quantization_config",
            json!({ "quant_method": "gptq" }),
            &[] as &[&str],
            "its base model is quantised (gptq)",
        ),
        ("auto_map", json!({ "AutoConfig": "own.Config" }), &[], "the class of its base model is code of its own"),
        ("architectures", Value::Null, &[], "config.json of its base model names no class"),
        ("hidden_size", json!(32), &[], "its base model does not fit its own config.json"),
        (
            "unused",
            json!(1),
            &["--for", "5.23.0,peft==0.13.2"],
            "what PEFT 0.13.2 does with the base model is not known",
        ),
    ] {
        let said = of(key, value, args);
        assert!(said.starts_with("not-predicted: ") && said.contains(why), "{key}: {said}");
    }
    assert_eq!(of("unused", json!(1), &["--for", "5.23.0,peft==0.21.2"]), "loads");
}

#[test]
fn a_base_model_that_is_missing_ends_the_run() {
    let room = room("llama");
    let output = program().current_dir(room.path()).args(["check", "lora", "--base", "lama"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.starts_with("error: --base: "), "{text}");
}

#[test]
fn what_does_not_fit_is_told_and_renamed() {
    let room = room("llama");
    let run = |args: &[&str]| {
        let output = program()
            .current_dir(room.path())
            .args(["check", "lora", "--isolated", "--color", "never"])
            .args(args)
            .output();
        String::from_utf8(output.unwrap().stdout).unwrap()
    };
    let shard = room.path().join("lora/adapter_model.safetensors");
    let renamed: Vec<u8> = {
        let bytes = fs::read(&shard).unwrap();
        let length = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
        let header = String::from_utf8(bytes[8..8 + length].to_vec()).unwrap();
        let header = header.replace("base_model.model.model.", "base_model.model.model.language_model.");
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &bytes[8 + length..]].concat()
    };
    fs::write(&shard, renamed).unwrap();
    let before = run(&["--ignore", "SAF"]);
    let fixed = run(&["--fix", "--unsafe-fixes"]);
    edit(&room.path().join("lora"), "target_modules", &json!(["c_attn"]));
    let absent = run(&[]);
    edit(&room.path().join("lora"), "target_modules", &json!(["q_proj", "v_proj", "o_proj"]));
    snapshot!(
        "adapter-on-its-base",
        format!("{before}\n# renamed\n{fixed}\n# no module\n{absent}\n# bare\n{}", run(&[]))
    );
}
