//! `inspect` of what is not a model alone: an adapter, a pipeline, a file of tensors.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

use crate::support::made;
use crate::support::pickle::StateDict;

/// Standard output of `inspect ARGS` in a folder, or else its standard error.
fn shown(room: &Path, args: &[&str]) -> String {
    let run = crate::support::program().arg("inspect").args(args).current_dir(room).output().unwrap();
    String::from_utf8(if run.status.success() { run.stdout } else { run.stderr }).unwrap()
}

#[test]
fn an_adapter_has_targets() {
    let room = TempDir::new().unwrap();
    let changes = r#"[
        { reshape: { name: "base_model.model.model.layers.0.self_attn.q_proj.lora_A.weight", shape: [2, 16] } },
        { reshape: { name: "base_model.model.model.layers.0.self_attn.q_proj.lora_B.weight", shape: [16, 2] } },
        { add_tensor: { name: "base_model.model.score.weight", shape: [2, 16] } },
    ]"#;
    fs::rename(made("lora", changes, room.path()), room.path().join("adapter")).unwrap();
    snapshot!("inspect-adapter", shown(room.path(), &["adapter"]));
}

#[test]
fn a_pipeline_has_parts() {
    let room = TempDir::new().unwrap();
    let pipeline = room.path().join("pipeline");
    fs::create_dir_all(pipeline.join("scheduler")).unwrap();
    fs::rename(made("llama", "[]", room.path()), pipeline.join("text_encoder")).unwrap();
    let index = r#"{
        "_class_name": "SomePipeline", "_diffusers_version": "0.31.0", "scheduler": ["diffusers", "DDIMScheduler"],
        "text_encoder": ["transformers", "LlamaModel"], "safety_checker": [null, null], "requires_safety_checker": true
    }"#;
    fs::write(pipeline.join("model_index.json"), index).unwrap();
    snapshot!("inspect-pipeline", shown(room.path(), &["pipeline"]));
}

#[test]
fn a_pickle_is_a_file_of_tensors() {
    let room = TempDir::new().unwrap();
    let mut state = StateDict::default();
    for layer in 0..3 {
        state.add(&format!("layers.{layer}.weight"), "F32", &[2, 3], vec![0; 24]);
    }
    fs::write(room.path().join("weights.pt"), state.zip()).unwrap();
    snapshot!("inspect-pickle", shown(room.path(), &["weights.pt"]));
    // Named by its first bytes alone.
    fs::write(room.path().join("projector.bin"), state.zip()).unwrap();
    assert!(
        shown(room.path(), &["projector.bin"]).starts_with("projector.bin: 1 file, 3 tensors, 18 parameters, 72 B\n")
    );
    fs::write(room.path().join("notes.bin"), "text").unwrap();
    let error = shown(room.path(), &["notes.bin"]);
    assert!(error.starts_with("error: notes.bin: "), "{error}");
}
