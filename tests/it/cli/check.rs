//! `check` from the outside: directories, places, exit codes.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::{Value, json};
use tempfile::TempDir;

fn donor(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors").join(name)
}

fn doctor(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ckpt-doctor")).args(args).output().unwrap()
}

fn report(args: &[&str]) -> (Option<i32>, Value) {
    let output = doctor(args);
    let value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {output:?}"));
    (output.status.code(), value)
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
    }
}

#[test]
fn infinity_and_missing_modules_are_reported_with_their_places() {
    let work = TempDir::new().unwrap();
    let dir = work.path().join("spatialvla-tiny");
    copy(&donor("spatialvla-tiny"), &dir);
    for entry in
        fs::read_dir(&dir).unwrap().map(|e| e.unwrap().path()).filter(|p| p.extension().is_some_and(|e| e == "py"))
    {
        fs::remove_file(entry).unwrap();
    }
    let (code, report) = report(&["check", dir.to_str().unwrap(), "--output-format", "json"]);
    assert_eq!(code, Some(1));
    let findings: Vec<&Value> = report["checkpoints"][0]["findings"].as_array().unwrap().iter().collect();
    let serious: Vec<Value> = findings
        .iter()
        .filter(|f| f["severity"] != "info")
        .map(|f| {
            json!([
                f["code"],
                f["locations"][0]["file"],
                f["locations"][0]["line"],
                f["locations"][0]["column"],
                f["locations"][0]["pointer"]
            ])
        })
        .collect();
    assert_eq!(
        serious,
        [
            json!(["AUT001", "config.json", 8, 19, "/auto_map/AutoConfig"]),
            json!(["AUT001", "config.json", 9, 18, "/auto_map/AutoModel"]),
            json!(["AUT001", "processor_config.json", 22, 22, "/auto_map/AutoProcessor"]),
            json!(["JSN001", "processor_config.json", 128, 11, "/statistics/rh20t_rlds~11.0.0/action/std/0"]),
            json!(["JSN001", "processor_config.json", 129, 11, "/statistics/rh20t_rlds~11.0.0/action/std/1"]),
            json!(["JSN001", "processor_config.json", 130, 11, "/statistics/rh20t_rlds~11.0.0/action/std/2"]),
        ]
    );
}

#[test]
fn directories_are_searched_and_files_stand_for_their_checkpoint() {
    let work = TempDir::new().unwrap();
    let zoo = work.path().join("zoo");
    copy(&donor("llava3d-tiny"), &zoo.join("a"));
    copy(&donor("llava3d-tiny"), &zoo.join("deep/b"));
    let paths = |args: &[&str]| -> Vec<String> {
        let (_, report) = report(&[&["check", "--output-format", "json"], args].concat());
        report["checkpoints"].as_array().unwrap().iter().map(|c| c["path"].as_str().unwrap().to_owned()).collect()
    };
    let (a, b) = (zoo.join("a"), zoo.join("deep/b"));
    let names = |dirs: &[&Path]| -> Vec<String> { dirs.iter().map(|d| d.to_str().unwrap().to_owned()).collect() };
    assert_eq!(paths(&[zoo.to_str().unwrap()]), names(&[&a, &b]));
    // pre-commit passes files, several of one checkpoint.
    let (config, index) = (a.join("config.json"), a.join("model.safetensors.index.json"));
    assert_eq!(paths(&[config.to_str().unwrap(), index.to_str().unwrap()]), names(&[&a]));
    // Together with files of other checkpoints, of none, and one that the commit deletes.
    let (readme, gone) = (zoo.join("README.md"), b.join("model-00001-of-00002.safetensors"));
    fs::write(&readme, "").unwrap();
    let mixed = [readme.to_str().unwrap(), config.to_str().unwrap(), gone.to_str().unwrap()];
    assert_eq!(paths(&mixed), names(&[&a, &b]));
    assert_eq!(paths(&mixed[..1]), Vec::<String>::new());
    assert_eq!(doctor(&["check", mixed[0]]).status.code(), Some(0));
}

#[test]
fn exit_codes_follow_fail_on() {
    let vision = donor("spatialvla-tiny");
    let vision = vision.to_str().unwrap();
    let code = |args: &[&str]| doctor(&[&["check", vision], args].concat()).status.code();
    // The known faults of the published checkpoint are warnings: below the default of errors.
    assert_eq!(code(&[]), Some(0));
    assert_eq!(code(&["--fail-on", "warning"]), Some(1));
    assert_eq!(code(&["--fail-on", "info"]), Some(1));
    assert_eq!(code(&["--fail-on", "info", "--exit-zero"]), Some(0));
    let work = TempDir::new().unwrap();
    let nothing = doctor(&["check", work.path().to_str().unwrap()]);
    assert_eq!(nothing.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&nothing.stderr).contains("no checkpoint found"));
    assert_eq!(doctor(&["check", "/no/such/place"]).status.code(), Some(2));
    assert_eq!(doctor(&["check", vision, "--output-format", "tea"]).status.code(), Some(2));
}

#[test]
fn reports_can_be_written_beside_the_terminal() {
    let work = TempDir::new().unwrap();
    let (json, markdown) = (work.path().join("r.json"), work.path().join("r.md"));
    let run = doctor(&[
        "check",
        donor("llava3d-tiny").to_str().unwrap(),
        "--report",
        &format!("json={}", json.display()),
        "--report",
        &format!("markdown={}", markdown.display()),
    ]);
    assert_eq!(run.status.code(), Some(0));
    let value: Value = serde_json::from_slice(&fs::read(json).unwrap()).unwrap();
    assert_eq!((value["schema"].as_u64(), value["summary"]["verdict"].as_str()), (Some(3), Some("clean")));
    assert!(fs::read_to_string(markdown).unwrap().contains("llava3d-tiny"));
}

#[test]
fn a_fifo_does_not_block_and_hostile_names_are_escaped() {
    let work = TempDir::new().unwrap();
    let dir = work.path().join("c");
    copy(&donor("llava3d-tiny"), &dir);
    fs::remove_file(dir.join("generation_config.json")).unwrap();
    assert!(Command::new("mkfifo").arg(dir.join("generation_config.json")).status().unwrap().success());
    let index = dir.join("model.safetensors.index.json");
    let text = fs::read_to_string(&index).unwrap().replacen("lm_head.weight", "lm\\u001b[2Jhead.weight", 1);
    fs::write(&index, text).unwrap();
    for format in ["full", "concise", "json", "markdown"] {
        let run = doctor(&["check", dir.to_str().unwrap(), "--output-format", format]);
        assert_eq!(run.status.code(), Some(1), "{format}");
        assert!(!run.stdout.contains(&0x1b) && !run.stderr.contains(&0x1b), "{format}");
        assert!(String::from_utf8_lossy(&run.stdout).contains("FIFO"), "{format}");
    }
}

#[test]
fn rules_can_be_chosen_listed_and_explained() {
    let vision = donor("spatialvla-tiny");
    let vision = vision.to_str().unwrap();
    let codes = |args: &[&str]| -> Vec<String> {
        let (_, report) = report(&[&["check", vision, "--output-format", "json"], args].concat());
        let findings = report["checkpoints"][0]["findings"].as_array().unwrap().clone();
        findings.iter().map(|f| f["code"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(codes(&["--select", "JSN"]), ["JSN001", "JSN001", "JSN001"]);
    assert_eq!(codes(&["--ignore", "non-finite-number,VLA"]), Vec::<String>::new());
    let wrong = doctor(&["check", vision, "--ignore", "non-finite-numbr"]);
    assert_eq!(wrong.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("did you mean non-finite-number?"));

    let list = doctor(&["rules"]);
    let list = String::from_utf8(list.stdout).unwrap();
    assert!(list.lines().any(|l| l.split_whitespace().eq(["IDX005", "error", "shard-missing"])), "{list}");
    let one = doctor(&["explain", "shard-missing"]);
    assert_eq!(one.status.code(), Some(0));
    snapshot!("cli-explain", String::from_utf8(one.stdout).unwrap());
    let family = doctor(&["explain", "idx"]);
    let family = String::from_utf8(family.stdout).unwrap();
    assert!(family.starts_with("IDX: The index and its shards\n\nIDX001 "), "{family}");
    let words = ["IDX005", "error", "shard-missing", "a", "shard", "is", "missing"];
    assert!(family.lines().any(|l| l.split_whitespace().eq(words)), "{family}");
    for (word, hint) in [("IDX999", "no rule"), ("IDX05", "did you mean IDX005?"), ("CFG003", "CFG003 is now VLA001")] {
        for args in [["explain", word].as_slice(), &["check", vision, "--select", word]] {
            let refused = doctor(args);
            assert_eq!(refused.status.code(), Some(2), "{args:?}");
            let error = String::from_utf8(refused.stderr).unwrap();
            assert!(error.contains(hint), "{error}");
        }
    }
}

/// No page contains an expression of a template.
#[test]
fn every_rule_is_explained_with_an_example() {
    let rules = ckpt_doctor::knowledge::rule::RuleSet::embedded().unwrap();
    for rule in rules.all() {
        let page = String::from_utf8(doctor(&["explain", &rule.code]).stdout).unwrap();
        // The finding of the example can have a lower severity than others of its rule.
        let example = ["info", "warning", "error"].map(|level| format!("\nExample\n  {level}[{}]: ", rule.code));
        assert!(example.iter().any(|start| page.contains(start)), "{page}");
        let texts = rule.fixes.iter().flat_map(|fix| [&fix.title, &fix.help]).flatten();
        for expression in texts.chain([&rule.message]).flat_map(ckpt_doctor::knowledge::Template::expressions) {
            assert!(!page.contains(&format!("{{{expression}}}")), "{page}");
        }
    }
}

#[test]
fn the_load_is_predicted_for_the_given_versions() {
    let work = TempDir::new().unwrap();
    let dir = work.path().join("llama");
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/bases/llama"), &dir);
    // A file with one tensor: only the versions in the report matter.
    let header = br#"{"model.norm.weight":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}"#;
    let bytes = [&(header.len() as u64).to_le_bytes()[..], header, &[0; 4]].concat();
    fs::write(dir.join("model.safetensors"), bytes).unwrap();
    let loaders = |more: &[&str]| {
        let (_, report) = report(&[&["check", dir.to_str().unwrap(), "--output-format", "json"], more].concat());
        let loads = report["checkpoints"][0]["loads"].as_array().unwrap().clone();
        loads.iter().map(|l| json!([l["loader"], l["stands_for"]])).collect::<Vec<_>>()
    };
    // fixtures/bases/llama was written by 4.47.0.
    assert_eq!(loaders(&[]), [json!(["4.47.0", null]), json!(["5.23.0", null])]);
    assert_eq!(loaders(&["--for", "transformers==5.23.0"]), [json!(["5.23.0", null])]);
    assert_eq!(loaders(&["--for", "transformers==4.51.3"]), [json!(["4.47.0", "4.51.3"])]);
    let both = ["--for", "transformers==5.1.0", "--for", "transformers==4.47.0"];
    assert_eq!(loaders(&both), [json!(["5.23.0", "5.1.0"]), json!(["4.47.0", null])]);

    let shown = doctor(&[&["check", dir.to_str().unwrap()], &both[..]].concat());
    let shown = String::from_utf8(shown.stdout).unwrap();
    assert!(shown.contains(": raises with transformers 5.1.0 (predicted as 5.23.0) and 4.47.0"), "{shown}");

    for wrong in ["v5.23.0", "torch==2.0", "transformers==", "transformers==main"] {
        let output = doctor(&["check", dir.to_str().unwrap(), "--for", wrong]);
        assert_eq!(output.status.code(), Some(2), "{wrong}");
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(errors.contains("known versions are 4.47.0, 4.57.6, 5.23.0"), "{errors}");
    }
    // A class of custom code, known for one version only.
    let spatialvla = donor("spatialvla-tiny");
    let (_, report) =
        report(&["check", spatialvla.to_str().unwrap(), "--for", "transformers==5.23.0", "--output-format", "json"]);
    let load = &report["checkpoints"][0]["loads"][0];
    assert_eq!((&load["verdict"], &load["tensors"]), (&json!("not-predicted"), &Value::Null));
    let findings = report["checkpoints"][0]["findings"].as_array().unwrap();
    let unknown = findings.iter().find(|f| f["code"] == "ARC001").unwrap();
    assert!(unknown["message"].as_str().unwrap().contains(" under transformers 5.23.0;"));
}

/// Gemma 3 text inside PaliGemma: the model type exists in transformers 5.23.0, but not in 4.47.0.
#[test]
fn a_part_of_another_loader_is_built_as_by_that_loader() {
    let dir = tempfile::tempdir().unwrap();
    let config = json!({
        "architectures": ["PaliGemmaForConditionalGeneration"], "model_type": "paligemma", "transformers_version": "4.57.0",
        "text_config": { "model_type": "gemma3_text", "num_hidden_layers": 1 }, "vision_config": { "num_hidden_layers": 1 },
    });
    fs::write(dir.path().join("config.json"), config.to_string()).unwrap();
    let index = json!({ "metadata": {}, "weight_map": { "a.weight": "model-00001-of-00001.safetensors" } });
    fs::write(dir.path().join("model.safetensors.index.json"), index.to_string()).unwrap();
    let path = dir.path().to_str().unwrap();
    let loads = |more: &[&str]| {
        let (_, report) = report(&[&["check", path, "--metadata-only", "--output-format", "json"], more].concat());
        let found = report["checkpoints"][0].clone();
        let codes = found["findings"].as_array().unwrap().iter().map(|f| f["code"].as_str().unwrap().to_owned());
        (
            found["loads"]
                .as_array()
                .unwrap()
                .iter()
                .filter(|load| !load["tensors"].is_null())
                .map(|load| load["loader"].clone())
                .collect::<Vec<_>>(),
            codes.collect::<Vec<_>>(),
        )
    };
    let (loaders, codes) = loads(&[]);
    assert_eq!(loaders, ["5.23.0"]);
    assert!(!codes.iter().any(|c| c == "ARC001" || c == "ARC002"), "{codes:?}");
    let (loaders, codes) = loads(&["--for", "transformers==4.47.0"]);
    assert!(loaders.is_empty() && codes.iter().filter(|c| *c == "ARC001").count() == 1, "{codes:?}");
}
