//! Sound models of named families, as real classes saved them: no error, and no fix that breaks them.
//!
//! `tests/data/named-models.jsonl` has the config and the tensors of tiny models that the version in each line saved and opened:
//! transformers, or PEFT for adapters. The stored layer that predicts further tokens was added by hand, under the names of the
//! published checkpoints, and each version ignores it. Revision 38ea486 reports errors for all but Phi-3 and wav2vec2 under their
//! own version, and its unsafe fixes change the number of layers, the rank, the sizes of a stage or the number of labels. Phi-3
//! was broken by its fix for transformers 4, and wav2vec2 refused for 4.47.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::check::{Outcome, Severity, check_for};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::surgery::repair::{Content, Repair, plan};
use serde_json::Value;

use crate::support::project;
use crate::support::weights::{Shard, Weights};

/// The models of the file: name, version, and what is written for each.
fn models() -> Vec<Value> {
    let text = fs::read_to_string(project().join("tests/data/named-models.jsonl")).expect("text");
    text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect()
}

fn write(model: &Value, dir: &Path) {
    let file = model["file"].as_str().expect("a file");
    fs::write(dir.join(file), serde_json::to_string_pretty(&model["config"]).expect("JSON")).expect("a file");
    let weights = if file == "config.json" { "model.safetensors" } else { "adapter_model.safetensors" };
    let mut shard = Shard::new(weights);
    for (name, tensor) in model["tensors"].as_object().expect("tensors") {
        let shape: Vec<u64> = serde_json::from_value(tensor[1].clone()).expect("a shape");
        shard.add(name, tensor[0].as_str().expect("a type"), &shape);
    }
    Weights { shards: vec![shard] }.write(dir);
}

/// What is found for these versions, and what all fixes together would change.
fn judged(dir: &Path, versions: &[String], knowledge: &Knowledge) -> (Outcome, Repair) {
    let checkpoint = Arc::new(Checkpoint::open(dir).expect("a directory"));
    let judge = |c: &Arc<Checkpoint>| check_for(c, knowledge, &RunOptions::for_versions(versions));
    let outcome = judge(&checkpoint);
    let repair = plan(&checkpoint, outcome.clone(), true, &judge);
    (outcome, repair)
}

fn errors(outcome: &Outcome) -> Vec<String> {
    let errors = outcome.findings.iter().filter(|f| f.severity == Severity::Error);
    errors.map(|f| format!("{}: {}", f.code, f.message)).collect()
}

#[test]
fn sound_models_have_no_error_and_no_fix_that_changes_them() {
    let knowledge = Knowledge::embedded().unwrap();
    for model in models() {
        let dir = tempfile::tempdir().unwrap();
        write(&model, dir.path());
        let version = model["version"].as_str().unwrap();
        let own = if model["file"] == "config.json" { version.to_owned() } else { format!("peft=={version}") };
        for versions in [vec![own], Vec::new()] {
            let (outcome, repair) = judged(dir.path(), &versions, &knowledge);
            let of = format!("{} of {version} for {versions:?}", model["name"]);
            assert_eq!(errors(&outcome), [] as [&str; 0], "{of}");
            let changed: Vec<&str> = repair.changes.iter().map(|change| change.name.as_str()).collect();
            // Phi-3 of transformers 5 is written in the form of transformers 4 beside its own; the next test reads it.
            let is_rope = model["name"] == "Phi-3 longrope" && changed == ["config.json"];
            assert!(changed.is_empty() || is_rope, "{of}: {changed:?}");
        }
    }
}

#[test]
fn a_repaired_longrope_has_the_form_that_transformers_4_accepts() {
    let knowledge = Knowledge::embedded().unwrap();
    let model = models().into_iter().find(|m| m["name"] == "Phi-3 longrope" && m["version"] == "5.23.0").unwrap();
    let dir = tempfile::tempdir().unwrap();
    write(&model, dir.path());
    let versions = ["4.57.6".to_owned()];
    let (outcome, repair) = judged(dir.path(), &versions, &knowledge);
    assert_eq!(outcome.findings.iter().filter(|f| f.code == "CFG032").count(), 1);
    let text = repair.changes.iter().find_map(|change| match &change.new {
        Content::Text(text) => Some(text.to_string()),
        Content::Shard(_) => None,
    });
    let config: Value = serde_json::from_str(&text.expect("a repaired config")).unwrap();
    let parameters = &model["config"]["rope_parameters"];
    let expected = serde_json::json!({ "type": "longrope", "short_factor": parameters["short_factor"],
        "long_factor": parameters["long_factor"] });
    assert_eq!(config["rope_scaling"], expected);

    // The form that the fix wrote before, which both versions of transformers 4 refuse.
    let mut refused = model.clone();
    refused["config"]["rope_scaling"] = parameters.clone();
    write(&refused, dir.path());
    let (outcome, _) = judged(dir.path(), &versions, &knowledge);
    assert!(errors(&outcome).iter().any(|text| text.starts_with("CFG026")), "{:?}", errors(&outcome));

    // Parameters without a place in that form: a person has to decide.
    let mut more = model;
    more["config"]["rope_parameters"]["attention_factor"] = 1.2.into();
    write(&more, dir.path());
    let (_, repair) = judged(dir.path(), &versions, &knowledge);
    assert!(repair.changes.is_empty());
}

#[test]
fn a_layer_that_predicts_further_tokens_leads_to_no_depth() {
    let knowledge = Knowledge::embedded().unwrap();
    let models = models();
    let stored = models.iter().filter(|m| m["name"].as_str().is_some_and(|name| name.ends_with("MTP layer")));
    for model in stored {
        let dir = tempfile::tempdir().unwrap();
        let depth_after = |model: &Value| {
            write(model, dir.path());
            let (outcome, repair) = judged(dir.path(), &[], &knowledge);
            let depth = repair.changes.iter().find_map(|change| match &change.new {
                Content::Text(text) => serde_json::from_str::<Value>(text).ok()?["num_hidden_layers"].as_u64(),
                Content::Shard(_) => None,
            });
            let votes: Vec<Value> = outcome.votes.iter().map(|vote| vote.voted_value.clone()).collect();
            (depth, votes)
        };
        let mut without_key = model.clone();
        without_key["config"].as_object_mut().unwrap().remove("num_nextn_predict_layers");
        assert_eq!(depth_after(&without_key), (None, Vec::new()), "{}", model["name"]);
        // A layer too few: the vote leads to the number of ordinary layers, which is 2 of the 3 that are stored.
        let mut too_few = model.clone();
        too_few["config"]["num_hidden_layers"] = 1.into();
        let (_, votes) = depth_after(&too_few);
        assert_eq!(votes, [Value::from(2)], "{}", model["name"]);
    }
}

#[test]
fn a_wrong_rank_of_fused_experts_is_an_error_without_a_fix() {
    let knowledge = Knowledge::embedded().unwrap();
    let mut model = models().into_iter().find(|m| m["name"] == "fused experts alone").unwrap();
    let dir = tempfile::tempdir().unwrap();
    // Four experts of rank 2: 8 rows are no multiple of 3.
    model["config"]["r"] = 3.into();
    write(&model, dir.path());
    let (outcome, repair) = judged(dir.path(), &[], &knowledge);
    assert!(
        errors(&outcome).iter().any(|text| text.contains("gives rank 3 for each expert")),
        "{:?}",
        errors(&outcome)
    );
    assert!(repair.changes.is_empty());
}
