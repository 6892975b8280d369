//! `check` from the outside: directories, places, exit codes.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::make_base;

fn donor(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors").join(name)
}

fn doctor(args: &[&str]) -> Output {
    crate::support::program().args(args).output().unwrap()
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
    let outside = doctor(&["check", mixed[0], mixed[0]]);
    assert_eq!(outside.status.code(), Some(0));
    let shown = String::from_utf8(outside.stdout).unwrap();
    assert_eq!(shown, "Nothing was checked: 0 checkpoints\n");
    let notes = String::from_utf8(outside.stderr).unwrap();
    assert!(notes.contains("README.md: the file belongs to no checkpoint (and 1 more files)"), "{notes}");
}

/// A copy of a donor without its config.json.
fn broken(dir: &Path) {
    copy(&donor("llava3d-tiny"), dir);
    fs::remove_file(dir.join("config.json")).unwrap();
}

#[test]
fn paths_that_cannot_be_checked_do_not_lose_the_other_reports() {
    let work = TempDir::new().unwrap();
    let root = work.path();
    copy(&donor("llava3d-tiny"), &root.join("a"));
    broken(&root.join("z"));
    fs::create_dir_all(root.join("empty")).unwrap();
    for file in ["gguf/llama-3-8b-Q4_K_M.gguf", "zero/global_step500/states.pt", "two/a.onnx", "two/b.onnx", "two/c.h5"]
    {
        fs::create_dir_all(root.join(file).parent().unwrap()).unwrap();
        fs::write(root.join(file), "").unwrap();
    }
    let args = [
        "check",
        "a",
        "missing",
        "empty",
        "gguf/llama-3-8b-Q4_K_M.gguf",
        "gguf",
        "zero",
        "two",
        "z",
        "--output-format",
    ];
    let run = |format: &str| {
        let output = crate::support::program().args(args).arg(format).current_dir(root).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{format}");
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    let (json, errors) = run("json");
    snapshot!("cli-unchecked", errors);
    let report: Value = serde_json::from_str(&json).unwrap();
    let paths: Vec<&Value> = report["checkpoints"].as_array().unwrap().iter().map(|c| &c["path"]).collect();
    assert_eq!(paths, ["a", "z"]);
    let unchecked: Vec<&Value> = report["unchecked"].as_array().unwrap().iter().map(|u| &u["path"]).collect();
    assert_eq!(unchecked, ["missing", "empty", "gguf/llama-3-8b-Q4_K_M.gguf", "gguf", "zero", "two"]);
    assert_eq!((&report["summary"]["unchecked"], &report["summary"]["verdict"]), (&json!(6), &json!("error")));
    for format in ["full", "concise", "jsonl", "github", "gitlab", "junit", "sarif", "markdown", "html"] {
        let (shown, _) = run(format);
        assert!(shown.contains("FIL009"), "{format}: {shown}");
        let names = shown.contains("llama-3-8b-Q4_K_M.gguf is GGUF, which is not read");
        assert_eq!(names, !["full", "concise"].contains(&format), "{format}: {shown}");
    }
    assert!(run("full").0.ends_with("in 2 checkpoints; 6 paths could not be checked\n"));
    // Weights that are not read beside a checkpoint are named, and are no reason to fail.
    let zoo = doctor(&["check", root.to_str().unwrap(), "--exit-zero"]);
    assert_eq!(zoo.status.code(), Some(0));
    let notes = String::from_utf8(zoo.stderr).unwrap();
    assert!(notes.starts_with("note: ") && notes.contains("two/a.onnx (and 1 more) is ONNX, which is not"), "{notes}");
}

/// Root may list every folder, so this needs a user who may not.
#[test]
fn a_folder_that_cannot_be_listed_is_not_clean() {
    use std::os::unix::fs::PermissionsExt as _;
    let work = TempDir::new().unwrap();
    let closed = work.path().join("closed");
    copy(&donor("llava3d-tiny"), &work.path().join("a"));
    fs::create_dir(&closed).unwrap();
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o000)).unwrap();
    let is_listed = fs::read_dir(&closed).is_ok();
    let run = doctor(&["check", work.path().to_str().unwrap()]);
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o700)).unwrap();
    assert_eq!(run.status.code(), Some(if is_listed { 0 } else { 2 }));
    assert_eq!(String::from_utf8_lossy(&run.stderr).contains("closed: cannot be listed"), !is_listed);
}

#[test]
fn each_exit_code_has_its_meaning() {
    let work = TempDir::new().unwrap();
    let root = work.path();
    let (sound, bad) = (donor("llava3d-tiny"), root.join("bad"));
    broken(&bad);
    let gguf = root.join("x.gguf");
    fs::write(&gguf, "").unwrap();
    let (sound, bad, gguf) = (sound.to_str().unwrap(), bad.to_str().unwrap(), gguf.to_str().unwrap());
    let code = |args: &[&str]| doctor(&[&["check"], args].concat()).status.code().unwrap();
    assert_eq!(code(&[sound]), 0);
    assert_eq!(code(&[bad]), 1);
    assert_eq!(code(&[sound, bad]), 1);
    assert_eq!(code(&[bad, "--exit-zero"]), 0);
    // Could not be checked: alone, beside findings, and although findings do not count.
    assert_eq!(code(&[gguf]), 2);
    assert_eq!(code(&[sound, gguf]), 2);
    assert_eq!(code(&[bad, gguf]), 2);
    assert_eq!(code(&[bad, gguf, "--exit-zero"]), 2);
    assert_eq!(code(&[sound, gguf, "--diff"]), 2);
    // Wrong arguments.
    assert_eq!(code(&[sound, "--no-such-option"]), 2);
    assert_eq!(code(&[sound, "--select", "XYZ"]), 2);
    assert_eq!(code(&[sound, "-q", "--statistics"]), 2);
    let shown = String::from_utf8(doctor(&["check", gguf]).stdout).unwrap();
    assert_eq!(shown, "Nothing was checked: 0 checkpoints; 1 path could not be checked\n");
    let (_, report) = report(&["check", gguf, "--output-format", "json"]);
    assert_eq!(report["summary"]["verdict"], "not-checked");
}

#[test]
fn severities_can_be_hidden_without_changing_the_exit_code() {
    let vision = donor("spatialvla-tiny");
    let vision = vision.to_str().unwrap();
    let run = |args: &[&str]| {
        let (code, report) = report(&[&["check", vision, "--output-format", "json"], args].concat());
        let found = report["checkpoints"][0]["findings"].as_array().unwrap().clone();
        let codes: Vec<String> = found.iter().map(|f| f["code"].as_str().unwrap().to_owned()).collect();
        (code.unwrap(), codes, report["summary"]["hidden"].as_u64(), report["summary"]["counts"].clone())
    };
    let counts = json!({ "error": 0, "warning": 3, "info": 1 });
    assert_eq!(
        run(&[]),
        (0, ["JSN001", "JSN001", "JSN001", "VLA024"].map(str::to_owned).to_vec(), None, counts.clone())
    );
    let warnings = ["JSN001"; 3].map(str::to_owned).to_vec();
    assert_eq!(run(&["--min-severity", "warning"]), (0, warnings, Some(1), counts.clone()));
    let strict = ["--min-severity", "error", "--fail-on", "warning"];
    assert_eq!(run(&strict), (1, Vec::new(), Some(4), counts));
    let shown = doctor(&["check", vision, "--min-severity", "error"]);
    let shown = String::from_utf8(shown.stdout).unwrap();
    assert!(shown.ends_with("Found 3 warnings, 1 info in 1 checkpoint, 4 hidden by --min-severity\n"), "{shown}");
    for format in ["full", "concise"] {
        let quiet = doctor(&["check", vision, "-q", "--min-severity", "error", "--output-format", format]);
        assert_eq!(String::from_utf8(quiet.stdout).unwrap(), "", "{format}");
    }
}

/// Without a word, `--hash` would look like a proof for files whose hash nobody recorded.
#[cfg(unix)]
#[test]
fn hashes_are_counted_with_the_files_that_have_none() {
    let work = TempDir::new().unwrap();
    let dir = work.path().join("models--org--name/snapshots/0123456789abcdef0123456789abcdef01234567");
    make_base("llama", &dir);
    let blobs = dir.join("../../blobs");
    fs::create_dir(&blobs).unwrap();
    // Of an empty file, as git names it.
    let blob = "e69de29bb2d1d6434b8b29ae775ad8c2e48c5391";
    fs::write(blobs.join(blob), "").unwrap();
    std::os::unix::fs::symlink(format!("../../blobs/{blob}"), dir.join("notes.txt")).unwrap();
    let others = fs::read_dir(&dir).unwrap().count() - 1;
    let output = doctor(&["check", dir.to_str().unwrap(), "--isolated", "--hash"]);
    let notes = String::from_utf8(output.stderr).unwrap();
    assert!(notes.ends_with(&format!(": 1 file compared with recorded hashes, {others} not\n")), "{notes}");
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

#[cfg(unix)]
#[test]
fn links_are_followed_into_directories_that_the_user_names_alone() {
    let work = TempDir::new().unwrap();
    let [dir, store, other] = ["model", "store", "other"].map(|name| work.path().join(name));
    make_base("llama", &dir);
    for (name, place) in [("config.json", &store), ("model.safetensors", &store), ("generation_config.json", &other)] {
        fs::create_dir_all(place).unwrap();
        fs::rename(dir.join(name), place.join(name)).unwrap();
        std::os::unix::fs::symlink(place.join(name), dir.join(name)).unwrap();
    }
    let verdict = |report: &Value| report["checkpoints"][0]["loads"][0]["objects"].clone();
    let codes = |report: &Value| -> Vec<String> {
        let findings = report["checkpoints"][0]["findings"].as_array().unwrap();
        findings.iter().map(|finding| finding["code"].as_str().unwrap().to_owned()).collect()
    };
    let model = dir.to_str().unwrap();
    let (code, alone) = report(&["check", model, "--output-format", "json"]);
    assert_eq!((code, codes(&alone)), (Some(1), ["FIL014", "FIL012", "FIL006"].map(str::to_owned).to_vec()), "{alone}");
    let option = ["--follow-links", store.to_str().unwrap()];
    let (code, followed) = report(&[&["check", model, "--output-format", "json"], &option[..]].concat());
    assert_eq!((code, codes(&followed)), (Some(0), vec!["FIL012".to_owned()]), "{followed}");
    assert_ne!(verdict(&alone), verdict(&followed));
    let missing = doctor(&["check", model, "--follow-links", "no-such-directory"]);
    assert_eq!(missing.status.code(), Some(2));
    assert!(
        String::from_utf8_lossy(&missing.stderr).contains("--follow-links no-such-directory: No such file"),
        "{missing:?}"
    );
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
    let error =
        doctor(&["explain", "RuntimeError:", "size mismatch for lm_head.weight: copying a param with shape [7]"]);
    snapshot!("cli-explain-error", String::from_utf8(error.stdout).unwrap());
    let unknown = doctor(&["explain", "hello printer"]);
    assert_eq!(unknown.status.code(), Some(2));
    let said = String::from_utf8(unknown.stderr).unwrap();
    assert!(said.starts_with("error: no known problem has a text like this; `ckpt-doctor check DIR` tells"), "{said}");
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
    let known = ["4.47.0", "4.57.6", "5.23.0"].map(|version| json!([version, null]));
    assert_eq!(loaders(&[]), known);
    assert_eq!(loaders(&["--for", "all"]), known);
    assert_eq!(loaders(&["--for", "transformers==5.23.0"]), [json!(["5.23.0", null])]);
    assert_eq!(loaders(&["--for", "transformers==4.51.3"]), [json!(["4.47.0", "4.51.3"])]);
    let both = ["--for", "transformers==5.1.0", "--for", "transformers==4.47.0"];
    assert_eq!(loaders(&both), [json!(["5.23.0", "5.1.0"]), json!(["4.47.0", null])]);

    let shown = doctor(&[&["check", dir.to_str().unwrap()], &both[..]].concat());
    let shown = String::from_utf8(shown.stdout).unwrap();
    assert!(shown.contains(": raises with transformers 5.1.0 (judged as 5.23.0) and 4.47.0"), "{shown}");

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
    assert_eq!(loaders, ["4.57.6", "5.23.0"]);
    assert!(!codes.iter().any(|c| c == "ARC001" || c == "ARC002"), "{codes:?}");
    let (loaders, codes) = loads(&["--for", "transformers==4.47.0"]);
    assert!(loaders.is_empty() && codes.iter().filter(|c| *c == "ARC001").count() == 1, "{codes:?}");
}

/// A program that is named is judged by the known facts alone, and transformers as without it.
#[test]
fn a_program_is_judged_by_known_facts() {
    let dir = tempfile::tempdir().unwrap();
    make_base("llama", &dir.path().join("model"));
    let model = dir.path().join("model");
    let path = model.to_str().unwrap();
    let verdicts = |more: &[&str]| {
        let (code, report) = report(&[&["check", path, "--output-format", "json"], more].concat());
        let loads = report["checkpoints"][0]["loads"].as_array().unwrap().clone();
        let verdict =
            |load: &Value| format!("{} {}", load["loader"].as_str().unwrap(), load["verdict"].as_str().unwrap());
        (code, loads.iter().map(verdict).collect::<Vec<_>>())
    };
    let (_, plain) = verdicts(&[]);
    let (code, named) = verdicts(&["--for", "vllm,mlx-lm"]);
    let programs = ["vllm 0.19.1 not-predicted", "mlx-lm 0.32.2 not-predicted"].map(str::to_owned);
    assert_eq!((code, &named), (Some(0), &[plain, programs.to_vec()].concat()));
    fs::rename(model.join("model.safetensors"), model.join("weights.safetensors")).unwrap();
    let (code, named) = verdicts(&["--for", "mlx-lm"]);
    assert_eq!((code, named.last().map(String::as_str)), (Some(1), Some("mlx-lm 0.32.2 raises")));
    let said = doctor(&["check", path, "--for", "mlx-lm"]);
    let said = String::from_utf8_lossy(&said.stdout).into_owned();
    assert!(said.contains(", and mlx-lm 0.32.2"), "{said}");
}

/// Another program cuts the shard off while a part of it is mapped: a finding, and no signal. Tried again when the check was
/// over before.
#[test]
#[cfg(target_os = "linux")]
fn a_shard_that_is_cut_off_during_the_read_is_a_finding() {
    const NAME: &str = "model.safetensors";
    const LEN: usize = 48 << 20;
    let dir = TempDir::new().unwrap();
    let path = dir.path().join(NAME);
    let entry = format!(r#"{{"dtype":"U8","shape":[{LEN}],"data_offsets":[0,{LEN}]}}"#);
    let header = format!(r#"{{"__metadata__":{{"format":"pt"}},"w":{entry}}}"#);
    let shard = [&header.len().to_le_bytes()[..], header.as_bytes(), &vec![1; LEN]].concat();
    let reason = (0..200).find_map(|_| {
        fs::write(&path, &shard).unwrap();
        let mut check = crate::support::program();
        check.args(["check", "--deep", "--fail-on", "warning", "--output-format", "json"]).arg(dir.path());
        let mut check = check.stdout(std::process::Stdio::piped()).spawn().unwrap();
        let maps = format!("/proc/{}/maps", check.id());
        while !fs::read_to_string(&maps).is_ok_and(|maps| maps.contains(NAME)) && check.try_wait().unwrap().is_none() {}
        fs::File::options().write(true).open(&path).unwrap().set_len(8192).unwrap();
        let output = check.wait_with_output().unwrap();
        assert!(output.status.code().is_some(), "{output:?}");
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        let findings = report["checkpoints"][0]["findings"].as_array().unwrap();
        let unread = findings.iter().find(|finding| finding["code"] == "FIL004")?;
        assert_eq!(output.status.code(), Some(1));
        let message = unread["message"].as_str().unwrap();
        // A thread that opens the shard later sees another size.
        assert!(message.contains("while it was read"), "{message}");
        message.contains("became shorter").then(|| message.to_owned())
    });
    assert_eq!(reason.as_deref(), Some("model.safetensors could not be read: it became shorter while it was read"));
}

/// Continuous integration reads one or the other.
#[test]
fn a_junit_report_fails_exactly_when_the_exit_code_does() {
    let room = TempDir::new().unwrap();
    let warning = r#"[{ set: { file: "generation_config.json", at: "/temperature", to: 0.7 } }]"#;
    let error = r#"[{ remove: "tokenizer.json" }, { write: { file: "config.json", bytes: "{" } }]"#;
    for (name, changes) in [("clean", "[]"), ("warning", warning), ("error", error)] {
        fs::rename(crate::support::made("llama", changes, room.path()), room.path().join(name)).unwrap();
    }
    let mut codes = Vec::new();
    for name in ["clean", "warning", "error", "missing"] {
        let hidden = ["--fail-on", "warning", "--min-severity", "error"];
        for options in [&[][..], &["--fail-on", "warning"], &hidden, &["--fail-on", "info"], &["--exit-zero"]] {
            let path = room.path().join(name);
            let args = [&["check", path.to_str().unwrap(), "--output-format", "junit"], options].concat();
            let run = doctor(&args);
            let text = String::from_utf8(run.stdout).unwrap();
            let fails = text.contains("<failure") || text.contains("<error");
            assert_eq!(fails, run.status.code() != Some(0), "{name} {options:?}: {text}");
            codes.push(run.status.code().unwrap());
        }
    }
    assert_eq!(codes, [0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 1, 1, 1, 1, 0, 2, 2, 2, 2, 2]);
}
