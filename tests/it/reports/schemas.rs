//! The published schemas, compared with real output.

use std::fs;
use std::path::Path;
use std::process::Command;

use jsonschema::Validator;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{project, tried};

/// A schema of `schemas/` with `additionalProperties: false` for every object.
fn schema(name: &str) -> Value {
    let text = fs::read_to_string(project().join(format!("schemas/{name}.schema.json"))).unwrap();
    let mut schema: Value = serde_json::from_str(&text).unwrap();
    close(&mut schema);
    schema
}

fn close(schema: &mut Value) {
    match schema {
        Value::Object(map) => {
            map.values_mut().for_each(close);
            if map.get("properties").is_some_and(Value::is_object) && map.get("type") == Some(&json!("object")) {
                map.entry("additionalProperties").or_insert(json!(false));
            }
        }
        Value::Array(list) => list.iter_mut().for_each(close),
        _ => {}
    }
}

/// The validator of one definition of the report schema.
fn definition(name: &str) -> Validator {
    let report = schema("report");
    let root = json!({ "$ref": format!("#/$defs/{name}"), "$defs": report["$defs"] });
    jsonschema::draft202012::new(&root).unwrap()
}

#[track_caller]
fn holds(validator: &Validator, value: &Value) {
    let wrong: Vec<String> = validator.iter_errors(value).map(|e| format!("{}: {e}", e.instance_path())).collect();
    assert!(wrong.is_empty(), "{}\n{value:#}", wrong.join("\n"));
}

/// The program's JSON output.
fn printed(dir: &Path, args: &[&str]) -> Value {
    let output = crate::support::program().args(args).current_dir(dir).output().unwrap();
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{args:?}: {e}: {output:?}"))
}

#[test]
fn findings_and_loads_of_every_case_follow_the_report_schema() {
    let (finding, load) = (definition("Finding"), definition("PredictedLoad"));
    for tried in tried() {
        for found in &tried.outcome.findings {
            holds(&finding, &serde_json::to_value(found).unwrap());
        }
        for verdict in &tried.outcome.verdicts {
            holds(&load, &serde_json::to_value(verdict).unwrap());
        }
    }
}

#[test]
fn reports_of_checks_and_fixes_follow_their_schema() {
    let report = jsonschema::draft202012::new(&schema("report")).unwrap();
    let room = TempDir::new().unwrap();
    let model = room.path().join("model");
    for donor in ["llava3d-tiny", "spatialvla-tiny"] {
        let donor = project().join("fixtures/donors").join(donor);
        let copied = Command::new("cp").arg("-r").arg(donor).arg(&model).status().unwrap();
        assert!(copied.success());
        let settings = r#"{ "$schema": "x", suppress: [{ rule: "VLA024", reason: "known" }] }"#;
        fs::write(room.path().join("ckpt-doctor.json5"), settings).unwrap();
        let config = fs::read_to_string(model.join("config.json")).unwrap();
        fs::write(model.join("config.json"), config.replacen("\"hidden_size\": 64", "\"hidden_size\": 48", 1)).unwrap();
        holds(&report, &printed(room.path(), &["check", "model", "--deep", "--output-format", "json"]));
        let fixed = printed(room.path(), &["check", "model", "--fix", "--unsafe-fixes", "--output-format", "json"]);
        assert!(fixed["checkpoints"][0]["fixed"].is_array(), "{fixed:#}");
        holds(&report, &fixed);
        fs::remove_dir_all(&model).unwrap();
    }
}

#[test]
fn reports_and_manifests_of_merges_follow_their_schemas() {
    let report = jsonschema::draft202012::new(&schema("report")).unwrap();
    let manifest = jsonschema::draft202012::new(&schema("manifest")).unwrap();
    let verification = jsonschema::draft202012::new(&schema("verification")).unwrap();
    let room = TempDir::new().unwrap();
    let cases: [(&str, &[&str]); 4] = [
        ("plain", &[]),
        ("hashed", &["--hash-donors", "--hash", "sha256"]),
        ("bare", &["--hash", "none"]),
        ("seam", &["--set", "projector=keep"]),
    ];
    for (name, more) in cases {
        let out = room.path().join(name);
        let out = out.to_str().unwrap();
        let args = ["merge", "fixtures/merge.json5", "--out", out, "--output-format", "json"];
        holds(&report, &printed(project(), &[&args[..], more].concat()));
        match fs::read_to_string(Path::new(out).join("merge-manifest.json")) {
            Ok(text) => {
                holds(&manifest, &serde_json::from_str(&text).unwrap());
                let donor = "vision=fixtures/donors/llava3d-tiny";
                let verify = printed(project(), &["verify", out, "--donor", donor, "--output-format", "json"]);
                holds(&verification, &verify);
            }
            Err(_) => assert_eq!(name, "seam"),
        }
    }
}

#[test]
fn inspections_follow_their_schema() {
    let inspect = jsonschema::draft202012::new(&schema("inspect")).unwrap();
    let shard = "fixtures/donors/llava3d-tiny/model-00001-of-00002.safetensors";
    for path in ["fixtures/donors/llava3d-tiny", "fixtures/donors/spatialvla-tiny", "fixtures/bases/llama", shard] {
        holds(&inspect, &printed(project(), &["inspect", path, "--output-format", "json"]));
        holds(&inspect, &printed(project(), &["inspect", path, "--tensors", "--output-format", "json"]));
    }
    let room = TempDir::new().unwrap();
    fs::copy(project().join(shard), room.path().join("model.safetensors")).unwrap();
    holds(&inspect, &printed(room.path(), &["inspect", ".", "--output-format", "json"]));
}

#[test]
fn differences_follow_their_schema() {
    let diff = jsonschema::draft202012::new(&schema("diff")).unwrap();
    let [one, other] = ["fixtures/donors/llava3d-tiny", "fixtures/donors/spatialvla-tiny"];
    for pair in [[one, other], [one, one]] {
        holds(&diff, &printed(project(), &["diff", pair[0], pair[1], "--output-format", "json"]));
    }
}

#[test]
fn the_list_of_recipes_follows_its_schema() {
    let recipes = jsonschema::draft202012::new(&schema("recipes")).unwrap();
    let list = printed(project(), &["recipes", "--output-format", "json"]);
    holds(&recipes, &list);
    assert!(list["recipes"].as_array().unwrap().iter().any(|recipe| recipe["name"] == "spatialvla-llava3d"));
}
