//! Models that were saved with a wrapper: one finding, and one fix that gives every tensor the name that its class saves.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::surgery::repair::{Content, Repair};

use super::{codes, planned};
use crate::support::{self, knowledge};

/// Models by base, with the renames that make the names of the file of those of the class: vision-language models save
/// others than they have.
const MODELS: [(&str, &[(&str, &str)]); 4] = [
    ("llama-sharded", &[]),
    ("paligemma", &[]),
    ("qwen2.5-vl", &[("model.visual.", "visual."), ("model.language_model.", "model.")]),
    ("gemma3", &[("model.language_model.", "language_model.model."), ("model.", "")]),
];

/// Prefixes of all names; the last ones are no data.
const PREFIXES: [&str; 5] = ["_orig_mod.", "module._orig_mod.", "base_model.model.", "student.", "policy.model."];

/// Names of the tensors.
fn names(dir: &Path) -> BTreeSet<String> {
    let checkpoint = Checkpoint::open(dir).expect("a directory");
    checkpoint.tensors().map(|(_, tensor)| tensor.name.clone()).collect()
}

fn names_after(repair: &Repair) -> BTreeSet<String> {
    let mut shards: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for (shard, tensor) in repair.original.tensors() {
        shards.entry(&shard.name).or_default().push(tensor.name.clone());
    }
    for change in &repair.changes {
        if let Content::Shard(shard) = &change.new {
            shards.insert(&change.name, shard.tensors.iter().map(|tensor| tensor.name.clone()).collect());
        }
    }
    shards.into_values().flatten().collect()
}

/// The renames that make the file of a model.
fn as_saved(renames: &[(&str, &str)]) -> String {
    let change = |(from, to): &(&str, &str)| format!(r#"{{ rename_tensors: {{ from: "{from}", to: "{to}" }} }}, "#);
    renames.iter().map(change).collect()
}

/// The start of a name up to the first number, with it: a layer.
fn layer(name: &str) -> Option<String> {
    let parts: Vec<&str> = name.split('.').collect();
    let at = parts.iter().position(|part| part.parse::<u64>().is_ok())?;
    Some(parts[..=at].join(".") + ".")
}

fn is_repaired(what: &str, base: &'static str, saved: &str, wrapping: &str, code: &str) {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let sound = names(&support::made(base, &format!("[{saved}]"), &room.path().join("sound")));
    let dir = support::made(base, &format!("[{saved}{wrapping}]"), &room.path().join("wrapped"));
    let (outcome, repair) = planned(&dir, false, &knowledge());
    let told = codes(outcome.findings.iter().map(|finding| &finding.code));
    assert_eq!(codes(repair.fixed.iter().map(|fixed| &fixed.code)), code, "{what}: of {told}");
    assert_eq!(names_after(&repair), sound, "{what}");
    let left = codes(repair.outcome.findings.iter().filter(|f| f.code.starts_with("ARC")).map(|f| &f.code));
    assert_eq!(left, "", "{what}");
}

#[test]
fn one_prefix_is_one_finding_and_one_fix() {
    for (base, renames) in MODELS {
        for prefix in PREFIXES {
            let wrapping = format!(r#"{{ rename_tensors: {{ from: "", to: "{prefix}" }} }}"#);
            is_repaired(&format!("{base}, {prefix}"), base, &as_saved(renames), &wrapping, "ARC013");
        }
    }
}

#[test]
fn parts_inside_of_names_are_one_finding_and_one_fix() {
    for (base, renames) in MODELS {
        let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
        let saved = as_saved(renames);
        let sound = names(&support::made(base, &format!("[{saved}]"), room.path()));
        let layers: BTreeSet<String> = sound.iter().filter_map(|name| layer(name)).collect();
        for part in ["_fsdp_wrapped_module", "_checkpoint_wrapped_module", "_orig_mod"] {
            let inside =
                |layer: &String| format!(r#"{{ rename_tensors: {{ from: "{layer}", to: "{layer}{part}." }} }}, "#);
            let outside = format!(r#"{{ rename_tensors: {{ from: "", to: "{part}." }} }}"#);
            let wrapping = layers.iter().map(inside).collect::<String>() + &outside;
            is_repaired(&format!("{base}, {part}"), base, &saved, &wrapping, "ARC015");
        }
    }
}

/// Two copies of a model in one file: whichever prefix is taken off, the tensors of the other one stay unused.
#[test]
fn of_two_copies_none_is_chosen() {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let sound = support::made("llama", "[]", &room.path().join("sound"));
    let twice: Vec<String> = Checkpoint::open(&sound)
        .expect("a directory")
        .tensors()
        .map(|(_, t)| format!(r#"{{ add_tensor: {{ name: "teacher.{}", shape: {:?} }} }}"#, t.name, t.shape))
        .collect();
    let changes = format!(r#"[{{ rename_tensors: {{ from: "", to: "student." }} }}, {}]"#, twice.join(", "));
    let dir = support::made("llama", &changes, &room.path().join("twice"));
    let (_, repair) = planned(&dir, false, &knowledge());
    assert!(repair.fixed.is_empty(), "{:?}", repair.fixed);
    assert!(repair.withdrawn.iter().any(|fix| fix.reason.contains("unused")), "{:?}", repair.withdrawn);
}

/// The weights beside an adapter's matrices are those of the base model.
#[test]
fn an_adapter_is_not_dropped() {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let changes = r#"[
      { rename_tensors: { from: "", to: "base_model.model." } },
      { rename_tensors: { from: "base_model.model.model.layers.0.self_attn.q_proj.", to: "base_model.model.model.layers.0.self_attn.q_proj.base_layer." } },
      { add_tensor: { name: "base_model.model.model.layers.0.self_attn.q_proj.lora_A.default.weight", shape: [4, 32] } },
      { add_tensor: { name: "base_model.model.model.layers.0.self_attn.q_proj.lora_B.default.weight", shape: [32, 4] } },
    ]"#;
    let dir = support::made("llama", changes, room.path());
    let (outcome, repair) = planned(&dir, false, &knowledge());
    assert!(repair.fixed.is_empty(), "{:?}", repair.fixed);
    let help =
        |f: &&ckpt_doctor::check::Finding| f.fix.as_ref().is_some_and(|fix| fix.title().contains("merge_and_unload"));
    assert!(outcome.findings.iter().any(|finding| help(&finding)), "{:?}", outcome.findings);
}
