//! The schemas in `schemas/`: made from the types that read the files, and held against every file that is shipped.
#![allow(clippy::disallowed_methods, reason = "reads the project's own files, and writes its schemas when asked")]

use std::borrow::Cow;
use std::fs;
use std::path::{Path, PathBuf};

use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde_json::{Value, json};

use super::architecture::Blueprint;
use super::expression::{Expression, Template};
use super::loader::Loader;
use super::processor::Processor;
use super::quantization::Scheme;
use super::recipe::Recipe;
use super::rule::Rule;
use super::settings::Settings;
use super::source;
use crate::checkpoint::FaultKind;

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
text!(Template, "Template", "Text with expressions in braces; a brace itself is written twice.");
text!(Loader, "Loader", "A version of transformers; the nearest known one stands for it.");

impl JsonSchema for FaultKind {
    fn schema_name() -> Cow<'static, str> {
        "FaultKind".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let names: Vec<&str> = Self::ALL.iter().map(|kind| kind.name()).collect();
        json_schema!({ "type": "string", "enum": names, "description": "A kind of fault." })
    }
}

fn project() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Each schema by its file, and the folder whose files it is for.
fn all() -> Vec<(&'static str, Option<&'static str>, Value)> {
    vec![
        ("rule", Some("rules/checks"), schema::<Rule>("A rule of ckpt-doctor")),
        ("architecture", Some("rules/architectures"), schema::<Blueprint>("An architecture of ckpt-doctor")),
        ("recipe", Some("rules/recipes"), schema::<Recipe>("A recipe of ckpt-doctor")),
        ("processor", Some("rules/processors"), schema::<Processor>("A processor of ckpt-doctor")),
        ("quantization", Some("rules/quantization"), schema::<Scheme>("A quantisation scheme of ckpt-doctor")),
        ("settings", None, schema::<Settings>("Settings of ckpt-doctor: ckpt-doctor.json5")),
    ]
}

fn schema<T: JsonSchema>(title: &str) -> Value {
    let schema = SchemaSettings::draft2020_12().into_generator().into_root_schema_for::<T>();
    let mut schema = schema.to_value();
    schema["title"] = title.into();
    without_lists(&mut schema);
    schema
}

/// A map in the order it was written is a list in memory, and so is its default; in a file it is none.
fn without_lists(schema: &mut Value) {
    if let Value::Object(map) = schema {
        if map.get("type") == Some(&json!("object")) && map.get("default") == Some(&json!([])) {
            map.remove("default");
        }
        map.values_mut().for_each(without_lists);
    }
}

/// Name and value of every JSON5 file below a folder.
fn values(folder: &Path) -> Vec<(PathBuf, Value)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(values(&path));
        } else if path.extension().is_some_and(|e| e == "json5") {
            let text = fs::read_to_string(&path).unwrap();
            found.push((path.clone(), source::parse(&path.display().to_string(), &text).unwrap()));
        }
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    found
}

/// The settings in the fixtures, and what `init` writes.
fn settings() -> Vec<(PathBuf, Value)> {
    let cases = values(&project().join("fixtures"));
    let mut found: Vec<_> =
        cases.into_iter().filter_map(|(path, case)| Some((path, case.get("settings")?.clone()))).collect();
    assert!(!found.is_empty());
    found.extend(values(&project().join("src/cli/init")));
    found
}

#[test]
fn schemas_are_fresh() {
    let write = std::env::var_os("CKPT_DOCTOR_WRITE").is_some();
    for (name, _, schema) in all() {
        let file = project().join(format!("schemas/{name}.schema.json"));
        let text = format!("{}\n", serde_json::to_string_pretty(&schema).unwrap());
        if write {
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            fs::write(&file, &text).unwrap();
        }
        let stale = "is stale: run `CKPT_DOCTOR_WRITE=1 cargo test --lib schemas`, and commit it";
        assert!(fs::read_to_string(&file).unwrap_or_default() == text, "{} {stale}", file.display());
    }
}

#[test]
fn every_shipped_file_is_valid_and_none_with_a_misspelt_key_is() {
    for (name, folder, schema) in all() {
        let validator = jsonschema::draft202012::new(&schema).unwrap();
        let files = folder.map_or_else(settings, |folder| values(&project().join(folder)));
        assert!(!files.is_empty(), "{name}");
        for (path, mut value) in files {
            let wrong: Vec<String> = validator
                .iter_errors(&value)
                .map(|e| format!("{}: {}: {e}", path.display(), e.instance_path()))
                .collect();
            assert!(wrong.is_empty(), "{}", wrong.join("\n"));
            value["sumary"] = json!("a slip of the pen");
            assert!(!validator.is_valid(&value), "{}", path.display());
        }
    }
}

/// The schema says no where the program does, below the first level too.
#[test]
fn what_the_program_refuses_is_not_valid() {
    let of = |name: &str| {
        let schema = all().into_iter().find(|(n, ..)| *n == name).unwrap().2;
        jsonschema::draft202012::new(&schema).unwrap()
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
    let (_, mut one) = values(&project().join("rules/checks/jsn")).remove(0);
    assert!(rule.is_valid(&one));
    one["check"]["fault"]["kind"] = json!([]);
    assert!(!rule.is_valid(&one));
}
