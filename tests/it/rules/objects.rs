//! What is said of a tokenizer with a tokenizer.json, and of an image processor alone, by version.

use std::sync::Arc;

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::checkpoint::{Checkpoint, MemoryFiles, Source};
use serde_json::{Map, Value, json};

use crate::support::knowledge;

/// The files of a case: those of all cases, with its class, and with one value set or one key taken out.
fn files(all: &Map<String, Value>, case: &Value) -> Vec<(String, Vec<u8>)> {
    let mut files = all.clone();
    files["tokenizer_config.json"]["tokenizer_class"] = case["class"].clone();
    let (parent, key) = case["pointer"].as_str().unwrap().rsplit_once('/').unwrap();
    let document = &mut files[case["file"].as_str().unwrap()];
    match (document.pointer_mut(parent).unwrap(), case.get("to")) {
        (Value::Array(list), Some(value)) => list[key.parse::<usize>().unwrap()] = value.clone(),
        (object, Some(value)) => object[key] = value.clone(),
        (object, None) => drop(object.as_object_mut().unwrap().remove(key).unwrap()),
    }
    files.into_iter().map(|(name, document)| (name, document.to_string().into_bytes())).collect()
}

/// Holds that each version says of an object what a case has, and that a rule of `codes` reports what is refused. A case with
/// `said` is not predicted, or loads with other ids.
fn hold(case: &Value, files: Vec<(String, Vec<u8>)>, versions: &[String], object: &str, codes: &[&str]) {
    let checkpoint = Arc::new(Checkpoint::read(Source::Memory(MemoryFiles::new("model", files))).unwrap());
    let outcome = check_for(&checkpoint, &knowledge(), &RunOptions::for_versions(versions));
    let verdicts = versions.iter().map(|version| {
        let load = outcome.verdicts.iter().find(|load| load.loader == *version).unwrap();
        json!(load.objects.iter().find(|verdict| verdict.object.name() == object).unwrap().verdict)
    });
    let said = case.get("said").unwrap_or(&case["actual"]);
    assert_eq!(&verdicts.collect::<Value>(), said, "{case}");
    let is_own = outcome.findings.iter().any(|finding| codes.contains(&&*finding.code));
    assert_eq!(is_own, said.as_array().unwrap().contains(&json!("raises")), "{case}");
}

fn versions(data: &Value) -> Vec<String> {
    serde_json::from_value(data["versions"].clone()).unwrap()
}

/// `tests/peer/tokenizer_files.py` opens the cases with `AutoTokenizer`, and compares `actual`.
#[test]
fn a_tokenizer_loads_as_its_class_and_the_library_read_it() {
    let data: Value = serde_json::from_str(include_str!("../../data/tokenizer-cases.json")).unwrap();
    for case in data["cases"].as_array().unwrap() {
        let files = files(data["files"].as_object().unwrap(), case);
        hold(case, files, &versions(&data), "tokenizer", &["TOK028", "TOK029"]);
    }
}

/// `tests/peer/preprocessors.py` opens the cases with `AutoImageProcessor` or `AutoFeatureExtractor`, and compares `actual`.
#[test]
fn an_image_processor_alone_loads_as_its_class_takes_the_settings() {
    let data: Value = serde_json::from_str(include_str!("../../data/preprocessor-cases.json")).unwrap();
    for case in data["cases"].as_array().unwrap() {
        let files = [("config.json", "config"), ("preprocessor_config.json", "settings")];
        let files = files.map(|(name, key)| (name.to_owned(), case[key].to_string().into_bytes()));
        hold(case, files.to_vec(), &versions(&data), "processor", &["PRC040"]);
    }
}
