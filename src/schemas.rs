//! The schemas in `schemas/`: generated from the types that read data files or are written as JSON, and validated
//! against every data file of this repository. `tests/it/reports/schemas.rs` validates real output.
#![allow(clippy::disallowed_methods, reason = "reads the files of this repository, and writes its schemas on request")]

use std::borrow::Cow;
use std::fs;
use std::path::{Path, PathBuf};

use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::checkpoint::FileName;
use crate::knowledge::architecture::Blueprint;
use crate::knowledge::directories::Directories;
use crate::knowledge::expression::{Expression, Template};
use crate::knowledge::loader::Loader;
use crate::knowledge::parts::ModelParts;
use crate::knowledge::processor::Processor;
use crate::knowledge::quantization::Scheme;
use crate::knowledge::recipe::{MergeFile, Recipe};
use crate::knowledge::rule::RuleFile;
use crate::knowledge::settings::Settings;
use crate::knowledge::source::{self, DataError};
use crate::knowledge::statistics::Pattern;
use crate::merge::dry_run::PlanDocument;
use crate::merge::manifest::Manifest;
use crate::report::Report;
use crate::report::baseline::Baseline;
use crate::report::compare::DiffDocument;
use crate::report::inspect::InspectDocument;
use crate::report::recipes::RecipesDocument;
use crate::report::verification::Verification;

macro_rules! text {
    ($type:ty, $name:literal, $about:literal) => {
        impl JsonSchema for $type {
            fn schema_name() -> Cow<'static, str> {
                $name.into()
            }

            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({ "type": "string", "description": $about })
            }
        }
    };
}

text!(Expression, "Expression", "An expression in CEL, the Common Expression Language: https://cel.dev");
text!(Template, "Template", "Text with expressions in braces; a literal brace is doubled.");
text!(FileName, "FileName", "The name of a file in the result: no folder, no `:`, no control character, not hidden.");
text!(Pattern, "Pattern", "A pattern for the name of an entry; that of a folder ends with `/`.");
text!(Loader, "Loader", "A version of transformers; it is mapped to the nearest known one.");

fn project() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A data file: its schema, the files of this repository that it describes, and the function that reads one.
struct Input {
    name: &'static str,
    schema: Value,
    files: Vec<(PathBuf, Value)>,
    read: fn(&str) -> Result<(), DataError>,
}

fn inputs() -> Vec<Input> {
    vec![
        input::<RuleFile>("rule", "A rule of ckpt-doctor", values("rules/checks")),
        input::<Blueprint>("architecture", "An architecture of ckpt-doctor", values("rules/architectures")),
        input::<Recipe>("recipe", "A recipe of ckpt-doctor", values("rules/recipes")),
        input::<ModelParts>("parts", "The parts of a model of ckpt-doctor", values("rules/parts")),
        input::<Processor>("processor", "A processor of ckpt-doctor", values("rules/processors")),
        input::<Scheme>("quantization", "A quantisation scheme of ckpt-doctor", values("rules/quantization")),
        input::<Directories>(
            "directories",
            "Kinds of directories of ckpt-doctor",
            vec![value(&project().join("rules/directories.json5"))],
        ),
        input::<Settings>("settings", "Settings of ckpt-doctor: ckpt-doctor.json5", settings()),
        input::<MergeFile>(
            "merge",
            "A merge file of ckpt-doctor",
            vec![value(&project().join("fixtures/merge.json5"))],
        ),
    ]
}

fn input<T: JsonSchema + DeserializeOwned>(name: &'static str, title: &str, files: Vec<(PathBuf, Value)>) -> Input {
    let read = |text: &str| source::parse::<T>(std::any::type_name::<T>(), text).map(drop);
    Input { name, schema: schema::<T>(title, SchemaSettings::draft2020_12()), files, read }
}

/// The schemas of the program's JSON output.
fn outputs() -> Vec<(&'static str, Value)> {
    let settings = || SchemaSettings::draft2020_12().for_serialize();
    vec![
        ("report", schema::<Report>("The JSON report of ckpt-doctor check and build-merged", settings())),
        ("inspect", schema::<InspectDocument<'_>>("The JSON report of ckpt-doctor inspect", settings())),
        ("diff", schema::<DiffDocument<'_>>("The JSON report of ckpt-doctor diff", settings())),
        ("recipes", schema::<RecipesDocument<'_>>("The JSON list of ckpt-doctor recipes", settings())),
        ("verification", schema::<Verification>("The JSON report of ckpt-doctor verify", settings())),
        ("plan", schema::<PlanDocument>("The plan of ckpt-doctor build-merged --dry-run --plan", settings())),
        ("manifest", schema::<Manifest>("merge-manifest.json of ckpt-doctor build-merged", settings())),
    ]
}

fn schema<T: JsonSchema>(title: &str, settings: SchemaSettings) -> Value {
    let mut schema = settings.into_generator().into_root_schema_for::<T>().to_value();
    schema["title"] = title.into();
    without_lists(&mut schema);
    schema
}

/// Removes defaults of ordered maps: they are lists in memory, but objects in a file.
fn without_lists(schema: &mut Value) {
    if let Value::Object(map) = schema {
        if map.get("type") == Some(&json!("object")) && map.get("default") == Some(&json!([])) {
            map.remove("default");
        }
        map.values_mut().for_each(without_lists);
    }
}

/// Path and value of a JSON5 file.
fn value(path: &Path) -> (PathBuf, Value) {
    let text = fs::read_to_string(path).unwrap();
    (path.to_owned(), source::parse(&path.display().to_string(), &text).unwrap())
}

/// Path and value of every JSON5 file below a directory of the project.
fn values(folder: &str) -> Vec<(PathBuf, Value)> {
    let mut found = Vec::new();
    let mut folders = vec![project().join(folder)];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "json5") {
                found.push(value(&path));
            }
        }
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    found
}

/// The settings in the fixtures, and the template of `init`.
fn settings() -> Vec<(PathBuf, Value)> {
    let cases = values("fixtures");
    let mut found: Vec<_> =
        cases.into_iter().filter_map(|(path, case)| Some((path, case.get("settings")?.clone()))).collect();
    assert!(!found.is_empty());
    found.extend(values("src/cli/init"));
    found
}

#[test]
fn schemas_are_fresh() {
    let inputs = inputs().into_iter().map(|input| (input.name, input.schema));
    for (name, schema) in inputs.chain(outputs()) {
        let text = format!("{}\n", serde_json::to_string_pretty(&schema).unwrap());
        assert_fresh(&format!("schemas/{name}.schema.json"), &text);
    }
}

/// Fails when the generated file of this path has another text; writes it when `CKPT_DOCTOR_WRITE` is set.
pub fn assert_fresh(path: &str, text: &str) {
    let file = project().join(path);
    if std::env::var_os("CKPT_DOCTOR_WRITE").is_some() {
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(&file, text).unwrap();
    }
    let stale = "is stale: run `CKPT_DOCTOR_WRITE=1 cargo test --lib`, and commit it";
    assert!(fs::read_to_string(&file).unwrap_or_default() == text, "{path} {stale}");
}

#[test]
fn every_data_file_is_valid_and_unknown_keys_are_rejected() {
    for Input { name, schema, files, .. } in inputs() {
        let validator = jsonschema::draft202012::new(&schema).unwrap();
        assert!(!files.is_empty(), "{name}");
        for (path, mut value) in files {
            let wrong: Vec<String> = validator
                .iter_errors(&value)
                .map(|e| format!("{}: {}: {e}", path.display(), e.instance_path()))
                .collect();
            assert!(wrong.is_empty(), "{}", wrong.join("\n"));
            value["sumary"] = json!("an unknown key");
            assert!(!validator.is_valid(&value), "{}", path.display());
        }
    }
}

/// Editors find the schema of a file by its `$schema`; the program ignores this key.
#[test]
fn every_file_may_name_its_schema() {
    for Input { name, schema, files, read } in inputs() {
        let validator = jsonschema::draft202012::new(&schema).unwrap();
        let (_, mut value) = files.into_iter().next().unwrap();
        value["$schema"] = json!(format!("schemas/{name}.schema.json"));
        assert!(validator.is_valid(&value), "{name}");
        read(&value.to_string()).unwrap_or_else(|error| panic!("{error}"));
    }
    let baseline = json!({ "$schema": "a.json", "schema": 1, "findings": [] }).to_string();
    let baseline = Baseline::parse("baseline.json", &baseline).unwrap_or_else(|error| panic!("{error}"));
    assert!(baseline.text().contains("a.json"), "{}", baseline.text());
}

/// The schema rejects everything that the program rejects, at all levels.
#[test]
fn the_schema_rejects_what_the_program_rejects() {
    let of = |name: &str| {
        let input = inputs().into_iter().find(|input| input.name == name).unwrap();
        jsonschema::draft202012::new(&input.schema).unwrap()
    };
    let (rule, settings) = (of("rule"), of("settings"));
    for (wrong, right) in [
        (json!({ "suppress": [{ "rule": "JSN" }] }), json!({ "suppress": [{ "rule": "JSN", "reason": "known" }] })),
        (json!({ "per-path": { "a": { "ignor": [] } } }), json!({ "per-path": { "a": { "ignore": [] } } })),
        (json!({ "severity": { "JSN": "warn" } }), json!({ "severity": { "JSN": "warning" } })),
        (json!({ "extend_select": [] }), json!({ "extend-select": [] })),
    ] {
        assert!(!settings.is_valid(&wrong) && settings.is_valid(&right), "{wrong}");
        assert!(source::parse::<Settings>("s", &wrong.to_string()).is_err(), "{wrong}");
        assert!(source::parse::<Settings>("s", &right.to_string()).is_ok(), "{right}");
    }
    let (_, mut one) = values("rules/checks/jsn").remove(0);
    assert!(rule.is_valid(&one));
    one["check"]["fault"]["kind"] = json!([]);
    assert!(!rule.is_valid(&one));
}
