//! `diff`: what differs, in text and JSON, and the exit codes.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;
use tempfile::TempDir;

use crate::support::{made, project};

/// Makes a checkpoint of a base with these changes, as `ROOM/NAME`.
fn make(room: &Path, name: &str, base: &'static str, changes: &str) -> PathBuf {
    let work = TempDir::new_in(room).unwrap();
    let to = room.join(name);
    fs::rename(made(base, changes, work.path()), &to).unwrap();
    to
}

fn diff(room: &Path, args: &[&str]) -> Output {
    crate::support::program().arg("diff").args(args).current_dir(room).output().unwrap()
}

fn text(room: &Path, args: &[&str], code: i32) -> String {
    let output = diff(room, args);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{error}");
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn each_kind_of_difference_is_listed() {
    let room = TempDir::new().unwrap();
    make(room.path(), "before", "llama", "[]");
    let changes = r#"[
        { rename_tensors: { from: "model.layers.0.", to: "model.language_model.layers.0." } },
        { poke: { tensor: "model.layers.1.mlp.up_proj.weight", at: 5, bytes: "x" } },
        { poke: { tensor: "model.language_model.layers.0.mlp.up_proj.weight", at: 5, bytes: "x" } },
        { reshape: { name: "model.norm.weight", shape: [8, 2] } },
        { drop_tensors: "lm_head." },
        { add_tensor: { name: "model.extra.0.weight", shape: [4] } },
        { add_tensor: { name: "model.extra.1.weight", shape: [4] } },
        { add_tensor: { name: "model.extra.scale", shape: [2, 2], dtype: "F32" } },
        { set: { file: "config.json", at: "/vocab_size", to: 17 } },
        { set: { file: "config.json", at: "/rope_scaling", to: { rope_type: "yarn", factor: 4 } } },
        { drop: { file: "config.json", at: "/rms_norm_eps" } },
        { set: { file: "tokenizer.json", at: "/added_tokens/0/content", to: "<unknown>" } },
        { write: { file: "README.md", bytes: "text" } },
        { remove: "generation_config.json" },
    ]"#;
    make(room.path(), "after", "llama", changes);
    snapshot!("diff", text(room.path(), &["before", "after"], 1));
    let found: Value =
        serde_json::from_str(&text(room.path(), &["before", "after", "--output-format", "json"], 1)).unwrap();
    let count = |kind: &str| found["tensors"][kind].as_array().unwrap().len();
    assert_eq!(["renamed", "added", "removed", "reshaped", "recast", "changed"].map(count), [1, 3, 1, 1, 0, 2]);
    // The other way round, what was added was removed.
    let found: Value =
        serde_json::from_str(&text(room.path(), &["after", "before", "--output-format", "json"], 1)).unwrap();
    let count = |kind: &str| found["tensors"][kind].as_array().unwrap().len();
    assert_eq!(["renamed", "added", "removed", "reshaped", "recast", "changed"].map(count), [1, 1, 3, 1, 0, 2]);
}

#[test]
fn a_checkpoint_has_no_difference_from_its_copy() {
    let room = TempDir::new().unwrap();
    make(room.path(), "before", "llama", "[]");
    // Two shards and an index in place of one file.
    make(room.path(), "after", "llama-sharded", "[]");
    let found = text(room.path(), &["before", "after"], 0);
    assert!(found.starts_with("before and after: no difference found in what was compared\n"), "{found}");
    let found = text(room.path(), &["before", "after", "--bytes"], 0);
    assert!(found.starts_with("before and after: no difference found\n"), "{found}");
    let found = text(room.path(), &["before", "before"], 0);
    assert!(found.contains("equal in type, shape, and their first, middle and last bytes"), "{found}");
}

#[test]
fn a_byte_between_the_samples_is_found_with_all_bytes_alone() {
    let room = TempDir::new().unwrap();
    let wide = |changes: &str| {
        format!(r#"[{{ add_tensor: {{ name: "model.wide.weight", shape: [100000], dtype: "F32" }} }}, {changes}]"#)
    };
    make(room.path(), "before", "llama", &wide(""));
    make(room.path(), "after", "llama", &wide(r#"{ poke: { tensor: "model.wide.weight", at: 100000, bytes: "x" } }"#));
    assert!(text(room.path(), &["before", "after"], 0).contains("--bytes"));
    let found = text(room.path(), &["before", "after", "--bytes"], 1);
    assert!(found.contains("tensors with other bytes\n    model.wide.weight\n"), "{found}");
}

#[test]
fn another_type_is_told_for_all_tensors_at_once() {
    let room = TempDir::new().unwrap();
    make(room.path(), "before", "llama", "[]");
    let after = make(room.path(), "after", "llama", r#"[{ retype: { name: "model.norm.weight", dtype: "F32" } }]"#);
    let found = text(room.path(), &["before", "after"], 1);
    assert!(found.contains("tensors of another type\n    model.norm.weight BF16 -> F32\n"), "{found}");
    // Single files are compared as well; the one without a config is compared by names.
    let [one, other] = ["before", "after"].map(|name| format!("{name}.safetensors"));
    fs::copy(room.path().join("before/model.safetensors"), room.path().join(&one)).unwrap();
    fs::copy(after.join("model.safetensors"), room.path().join(&other)).unwrap();
    let found = text(room.path(), &[&one, &other], 1);
    assert!(found.contains("model.norm.weight BF16 -> F32"), "{found}");
}

#[test]
fn how_far_values_are_apart_is_measured() {
    let room = TempDir::new().unwrap();
    // 3 and 4, and 3 and 5: a norm of 5, and a difference of 1. BF16 has the upper half of F32.
    let [three, four, five] = ["00004040", "00008040", "0000a040"];
    let with = |second: &str| {
        let poke = |at: usize, hex: &str| {
            format!(r#"{{ poke: {{ tensor: "model.pair.weight", at: {at}, bytes: [{{ hex: "{hex}" }}] }} }}"#)
        };
        let pair = r#"{ add_tensor: { name: "model.pair.weight", shape: [2], dtype: "F32" } }"#;
        format!("[{pair}, {}, {}]", poke(0, three), poke(4, second))
    };
    make(room.path(), "before", "llama", &with(four));
    make(room.path(), "after", "llama", &with(five));
    let found = text(room.path(), &["before", "after", "--stats"], 1);
    assert!(found.contains("    model.pair.weight: relative 0.200, largest 1.000, cosine 0.994692\n"), "{found}");
    let found: Value =
        serde_json::from_str(&text(room.path(), &["before", "after", "--stats", "--output-format", "json"], 1))
            .unwrap();
    let by = &found["tensors"]["changed"][0]["by"];
    assert_eq!([&by["norm_before"], &by["norm_of_difference"], &by["largest_difference"]], [5.0, 1.0, 1.0]);
    assert_eq!(found["tensors"]["bytes"], "measured");
    assert_eq!(found["tensors"]["changed"][0].get("rank"), None);
    // A vector has no rank; the matrix has one row that differs.
    let matrix = r#"{ add_tensor: { name: "model.square.weight", shape: [4, 4], dtype: "F32" } }"#;
    let poke = r#"{ poke: { tensor: "model.square.weight", at: 16, bytes: [{ hex: "00004040" }] } }"#;
    make(room.path(), "one", "llama", &format!("[{matrix}]"));
    make(room.path(), "other", "llama", &format!("[{matrix}, {poke}]"));
    let found = text(room.path(), &["one", "other", "--stats=rank"], 1);
    let line = found.lines().find(|line| line.contains("model.square.weight: ")).unwrap_or_default();
    assert!(line.ends_with(", rank 1"), "{found}");
}

#[test]
fn what_stands_beside_tensors_and_configs_is_compared_or_named() {
    let room = TempDir::new().unwrap();
    let with = |flag: bool| {
        format!(
            r#"[{{ set: {{ file: "tokenizer.json", at: "/added_tokens/0/lstrip", to: {flag} }} }},
                {{ write: {{ file: ".gitattributes", bytes: "{flag}" }} }}, {{ folder: "onnx" }}]"#
        )
    };
    make(room.path(), "before", "llama", &with(false));
    make(room.path(), "after", "llama", &with(true));
    let found = text(room.path(), &["before", "after", "--bytes"], 1);
    assert!(found.contains("tokenizer.json\n    /added_tokens/0/lstrip: false -> true\n"), "{found}");
    assert!(found.contains("not compared\n    the folder onnx was not compared\n"), "{found}");
    assert!(!found.contains(".gitattributes"), "{found}");
    assert!(text(room.path(), &["before", "before", "--bytes"], 2).contains("in what was compared"));
}

/// The loader opens the file that the index names; the other copy is no difference.
#[test]
fn a_tensor_in_two_files_is_that_of_the_index() {
    let room = TempDir::new().unwrap();
    let copy = r#"{ add_tensor: { name: "model.twice.weight", shape: [2], dtype: "F32", file: "model-00002-of-00002.safetensors" } }"#;
    let poke = r#"{ poke: { tensor: "model.twice.weight", at: 0, bytes: "x" } }"#;
    make(room.path(), "before", "llama-sharded", &format!("[{copy}]"));
    let after = make(room.path(), "after", "llama-sharded", &format!("[{copy}, {poke}]"));
    // The first file of both has the same bytes under the name; the index names the second.
    for dir in ["before", "after"] {
        let first = room.path().join(dir).join("model-00001-of-00002.safetensors");
        let bytes = fs::read(&first).unwrap();
        let (header, data) = crate::support::weights::split(&bytes);
        let length = data.len();
        let entry = format!(
            r#","model.twice.weight":{{"dtype":"F32","shape":[2],"data_offsets":[{length},{}]}}}}"#,
            length + 8
        );
        let header = header.trim_end().strip_suffix('}').unwrap().to_owned() + &entry;
        fs::write(&first, crate::support::weights::join(header.as_bytes(), &[data, &[0; 8]].concat())).unwrap();
    }
    assert!(after.exists());
    let found = text(room.path(), &["before", "after"], 1);
    assert!(found.contains("tensors with other bytes\n    model.twice.weight\n"), "{found}");
}

#[test]
fn what_could_not_be_read_is_said_and_exits_with_2() {
    let room = TempDir::new().unwrap();
    make(room.path(), "before", "llama", "[]");
    make(room.path(), "after", "llama", r#"[{ cut: { file: "model.safetensors", bytes: 4 } }]"#);
    let found = text(room.path(), &["before", "after"], 2);
    assert!(found.contains("no difference found in what was compared"), "{found}");
    assert!(found.contains("\n  not compared\n"), "{found}");
    let output = diff(project(), &["fixtures/donors", "fixtures/donors/llava3d-tiny"]);
    assert_eq!(output.status.code(), Some(2));
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(error.contains("fixtures/donors: contains 2 checkpoints"), "{error}");
}
