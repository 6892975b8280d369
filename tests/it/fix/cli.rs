//! `check --fix` and `undo` from the outside.

use std::fs;
use std::path::Path;

use serde_json::Value;
use tempfile::TempDir;

use super::seen;
use crate::support;

/// A checkpoint with fixes of every kind: text, a config value, an index, a shard's header, and a manual one.
fn broken() -> TempDir {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let changes = r#"[
      { set: { file: "config.json", at: "/vocab_size", to: 100 } },
      { replace: { file: "generation_config.json", find: "\n}", with: ",\n}" } },
      { set: { file: "model.safetensors.index.json", at: "/metadata/total_size", to: 1 } },
      { header_drop: { file: "model-00001-of-00002.safetensors", at: "/__metadata__" } },
      { remove: "tokenizer.json" },
    ]"#;
    let dir = support::made("llama-sharded", changes, room.path());
    fs::rename(dir, room.path().join("model")).expect("a rename");
    room
}

/// Runs the program in `room`; returns its exit code and output.
fn doctor(room: &Path, args: &[&str]) -> (i32, String) {
    let output = support::program().args(args).current_dir(room).output().expect("it runs");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("text");
    (output.status.code().expect("a code"), text(output.stdout) + &text(output.stderr))
}

#[test]
fn fixes_are_offered_shown_applied_and_undone() {
    let room = broken();
    let model = room.path().join("model");
    let before = seen(&model);
    let mut session = String::new();
    let mut run = |args: &[&str]| {
        let (code, text) = doctor(room.path(), args);
        session.push_str(&format!("$ ckpt-doctor {}\n{text}exit code {code}\n\n", args.join(" ")));
    };
    run(&["check", "model", "--output-format", "concise"]);
    run(&["check", "model", "--output-format", "concise", "--unsafe-fixes"]);
    run(&["check", "model", "--diff", "--unsafe-fixes"]);
    assert_eq!(seen(&model), before, "--diff writes nothing");
    run(&["check", "model", "--fix"]);
    run(&["check", "model", "--fix-only", "--unsafe-fixes", "--exit-non-zero-on-fix"]);
    run(&["check", "model", "--fix", "--unsafe-fixes", "--fail-on", "warning"]);
    run(&["undo", "model"]);
    run(&["undo", "model"]);
    run(&["undo", "model"]);
    assert_eq!(seen(&model), before);
    snapshot!("fix-session", session);
}

#[test]
fn json_lists_what_was_fixed_and_what_could_be() {
    let room = broken();
    let json = |args: &[&str]| -> Value { serde_json::from_str(&doctor(room.path(), args).1).expect("JSON") };
    let offered = json(&["check", "model", "--output-format", "json"]);
    let fixes: Vec<&Value> =
        offered["checkpoints"][0]["findings"].as_array().expect("a list").iter().map(|f| &f["fix"]).collect();
    snapshot!("fix-offered", serde_json::to_string_pretty(&fixes).expect("JSON"));
    let made = json(&["check", "model", "--fix", "--output-format", "json"]);
    snapshot!("fix-made", format!("{:#}", made["checkpoints"][0]["fixed"]));
}

#[test]
fn a_copy_is_made_elsewhere() {
    let room = broken();
    let model = room.path().join("model");
    let before = seen(&model);
    let (_, text) = doctor(room.path(), &["check", "model", "--fix", "--output", "repaired"]);
    assert!(text.starts_with("repaired: "), "{text}");
    assert_eq!(seen(&model), before);
    assert!(room.path().join("repaired/config.json").is_file());
    for (args, why) in [
        (["check", "model", "--output", "other"].as_slice(), "--output requires --fix"),
        (&["check", "model", "repaired", "--fix", "--output", "other"], "--output accepts one checkpoint"),
        (&["check", "model", "--fix", "--output", "repaired"], "files in it"),
        (&["check", "model", "--fix", "--output", "model/inside"], "lies inside"),
    ] {
        let (code, text) = doctor(room.path(), args);
        assert!(code == 2 && text.contains(why), "{args:?}: {code} {text}");
        assert!(!text.contains("--out "), "that is an option of another command: {text}");
    }
}

#[test]
fn plain_check_writes_nothing() {
    let room = broken();
    doctor(room.path(), &["check", "model"]);
    doctor(room.path(), &["check", "model", "--unsafe-fixes"]);
    assert!(!room.path().join("model/.ckpt-doctor").exists());
}

#[test]
fn undo_takes_the_paths_of_check() {
    let room = broken();
    let other = broken();
    fs::rename(other.path().join("model"), room.path().join("other")).expect("a rename");
    let whole = |dir: &str| seen(&room.path().join(dir));
    let before = (whole("model"), whole("other"));
    let mut session = String::new();
    let mut run = |args: &[&str]| {
        let (code, text) = doctor(room.path(), args);
        session.push_str(&format!("$ ckpt-doctor {}\n{text}exit code {code}\n\n", args.join(" ")));
    };
    let fix = |dirs: &[&str]| {
        let (code, text) = doctor(room.path(), &[&["check", "--fix-only"], dirs].concat());
        assert_eq!(code, 0, "{text}");
    };
    fix(&["."]);
    run(&["undo"]);
    assert_eq!((whole("model"), whole("other")), before);
    run(&["undo"]);
    run(&["undo", "model", "missing"]);

    fix(&["model", "other"]);
    run(&["undo", ".", "--adopt-journal"]);
    fs::write(room.path().join("model/generation_config.json"), "{}").expect("a file");
    run(&["undo", "model", ".", "other/config.json"]);
    assert_eq!(whole("other"), before.1);
    snapshot!("fix-undo-several", session);
}
