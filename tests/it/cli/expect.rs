//! `expect` from the outside: the tensors of a class, and errors for an invalid config.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

/// Runs `expect` in `dir`; returns its output and exit code.
fn expect(dir: &Path, args: &[&str]) -> (String, Option<i32>) {
    let output = crate::support::program().arg("expect").args(args).current_dir(dir).output();
    let output = output.unwrap();
    let printed = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap()).concat();
    (printed, output.status.code())
}

fn llama() -> Value {
    json!({ "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 4, "intermediate_size": 8,
        "num_attention_heads": 2, "num_hidden_layers": 1, "vocab_size": 10, "tie_word_embeddings": true,
        "transformers_version": "4.51.3" })
}

#[test]
fn a_config_is_printed_as_the_tensors_of_its_class() {
    let work = TempDir::new().unwrap();
    let dir = work.path();
    fs::create_dir(dir.join("tiny")).unwrap();
    fs::write(dir.join("tiny/config.json"), llama().to_string()).unwrap();
    let (text, code) = expect(dir, &["tiny"]);
    assert_eq!(code, Some(0));
    snapshot!("expect-text", text);
    let (json, code) = expect(dir, &["tiny/config.json", "--for", "transformers==5.9.0", "--output-format", "json"]);
    assert_eq!(code, Some(0));
    snapshot!("expect-json", json);
    let (wrong, code) = expect(dir, &["tiny", "--for", "torch==2.0"]);
    assert_eq!(code, Some(2));
    assert!(wrong.contains("expected VERSION or transformers==VERSION"), "{wrong}");
    let (wrong, code) = expect(dir, &["nothing"]);
    assert_eq!((code, wrong.as_str()), (Some(2), "error: nothing does not exist\n"));
}

#[test]
fn a_line_that_fails_does_not_stop_the_others() {
    let work = TempDir::new().unwrap();
    let mut broken = llama();
    broken["num_attention_heads"] = json!(0);
    let lines = [
        json!({ "config": llama(), "class": "LlamaModel", "more": [1, 2] }).to_string(),
        json!({ "config": broken }).to_string(),
        json!({ "config": { "architectures": ["\u{202e}Nobody"], "model_type": "nobody" } }).to_string(),
        "{ \"config\": ".to_owned(),
        String::new(),
        "[]".to_owned(),
        llama().to_string().replace("\"vocab_size\":10", "\"vocab_size\":10,\"limit\":Infinity"),
        format!(r#"{{"config":{}}}"#, llama().to_string().replace(":10", r#":10,"limit":Infinity"#)),
    ];
    fs::write(work.path().join("records.jsonl"), lines.join("\n")).unwrap();
    let (text, code) = expect(work.path(), &["@records.jsonl"]);
    assert_eq!(code, Some(1));
    snapshot!("expect-records", text);
    let (jsonl, code) = expect(work.path(), &["@records.jsonl", "--output-format", "jsonl"]);
    assert_eq!(code, Some(1));
    let answers: Vec<Value> = jsonl.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let failed: Vec<bool> = answers.iter().map(|a| a.get("error").is_some()).collect();
    assert_eq!(failed, [false, true, true, true, true, true, false]);
    assert_eq!(answers[0]["source"], "records.jsonl:1");
    assert_eq!(answers[6]["tied"], json!([["model.embed_tokens.weight", "lm_head.weight"]]));
}

#[test]
fn architectures_of_a_rules_folder_are_used() {
    let work = TempDir::new().unwrap();
    let dir = work.path();
    let folder = dir.join("mine/architectures");
    fs::create_dir_all(&folder).unwrap();
    fs::write(dir.join("config.json"), json!({ "architectures": ["Mine"], "n": 2 }).to_string()).unwrap();
    let (wrong, code) = expect(dir, &["config.json", "--rules", "mine"]);
    assert_eq!(
        (code, wrong.as_str()),
        (Some(2), "error: mine contains no .json5 file in architectures/, checks/, processors/, recipes/\n")
    );
    let file = |tensors: &str| {
        let text = format!(
            r#"{{ architecture: "mine", summary: "", sources: [], loaders: ["5.23.0"], classes: [{{ class: "Mine", {tensors} }}] }}"#
        );
        fs::write(folder.join("mine.json5"), text).unwrap();
    };
    file(r#"tensors: { "w": { shape: ["c.n"] } }"#);
    let (text, code) = expect(dir, &["config.json", "--rules", "mine"]);
    assert_eq!(code, Some(0));
    assert_eq!(text, "config.json: Mine (mine), transformers 5.23.0: 1 tensors, 0 non-persistent buffers\n  w [2]\n");
    let mut check = crate::support::program();
    let report =
        String::from_utf8(check.args(["check", "--rules", "mine"]).current_dir(dir).output().unwrap().stdout).unwrap();
    assert!(report.contains("mine, 0 tensors"), "{report}");
    file(r#"tensors: { "w": { shape: ["c.n +"] } }"#);
    let (wrong, code) = expect(dir, &["config.json", "--rules", "mine"]);
    assert_eq!(code, Some(2));
    assert!(wrong.starts_with("error: mine/architectures/mine.json5:1:"), "{wrong}");
    assert!(wrong.contains("`c.n +` is not an expression"), "{wrong}");
}
