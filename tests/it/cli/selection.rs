//! Selection and suppression: settings, suppressions, baselines, a user's own rules.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};
use tempfile::TempDir;

/// A folder with the tiny SpatialVLA under `models/vla`: three JSN001 in its `processor_config.json`, one VLA024.
fn zoo() -> TempDir {
    let zoo = TempDir::new().unwrap();
    let to = zoo.path().join("models/vla");
    fs::create_dir_all(&to).unwrap();
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors/spatialvla-tiny");
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
    }
    zoo
}

/// Runs the program in `dir`.
fn doctor(dir: &Path, args: &[&str]) -> Output {
    crate::support::program().current_dir(dir).args(args).output().unwrap()
}

/// Both output streams and the exit code.
fn transcript(dir: &Path, args: &[&str]) -> String {
    let output = doctor(dir, args);
    let text = |bytes: Vec<u8>| {
        let text = String::from_utf8(bytes).unwrap();
        // Messages contain the whole path of settings.
        text.replace(&format!("{}/", dir.canonicalize().unwrap().display()), "")
            .replace(&format!("{}/", dir.display()), "")
    };
    let (out, err) = (text(output.stdout), text(output.stderr));
    format!("$ ckpt-doctor {}\n{out}--- stderr\n{err}--- exit {}\n", args.join(" "), output.status.code().unwrap())
}

/// `CODE severity` of each finding, and of each suppressed finding.
fn found(dir: &Path, args: &[&str]) -> (Vec<String>, Vec<String>) {
    let args = [&["check", "models", "--output-format", "json"], args].concat();
    let output = doctor(dir, &args);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {output:?}"));
    let list = |key: &str| {
        let of = |c: &Value| c[key].as_array().cloned().unwrap_or_default();
        let all = report["checkpoints"].as_array().unwrap().iter().flat_map(of);
        all.map(|f| format!("{} {}", f["code"].as_str().unwrap(), f["severity"].as_str().unwrap())).collect()
    };
    (list("findings"), list("suppressed"))
}

fn settings(dir: &Path, text: &str) {
    fs::write(dir.join("ckpt-doctor.json5"), text).unwrap();
}

const INFINITY: [&str; 3] = ["JSN001 warning"; 3];

#[test]
fn the_nearest_settings_file_applies_and_the_command_line_overrides_it() {
    let zoo = zoo();
    let root = zoo.path();
    assert_eq!(found(root, &["--isolated"]).0, [&INFINITY[..], &["VLA024 info"]].concat());
    settings(root, r#"{ select: ["VLA"], "fail-on": "info" }"#);
    assert_eq!(found(root, &[]).0, ["VLA024 info"]);
    assert_eq!(doctor(root, &["check", "models"]).status.code(), Some(1));
    assert_eq!(doctor(root, &["check", "models", "--fail-on", "error"]).status.code(), Some(0));
    settings(root, r#"{ select: ["VLA"], "fail-on": "info", "min-severity": "warning" }"#);
    assert_eq!(found(root, &[]).0, Vec::<String>::new());
    assert_eq!(found(root, &["--min-severity", "info"]).0, ["VLA024 info"]);
    assert_eq!(doctor(root, &["check", "models"]).status.code(), Some(1));
    settings(root, r#"{ select: ["VLA"], "fail-on": "info" }"#);
    assert_eq!(found(root, &["--extend-select", "JSN"]).0.len(), 4);
    assert_eq!(found(root, &["--select", "JSN"]).0, INFINITY);
    assert_eq!(found(root, &["--isolated", "--ignore", "JSN"]).0, ["VLA024 info"]);
    // A nearer file replaces the one above, unless it extends it.
    let models = &root.join("models");
    let lines = |args: &[&str]| {
        let shown = doctor(models, &[&["check", "--output-format", "concise"], args].concat()).stdout;
        String::from_utf8(shown).unwrap().lines().filter(|line| line.contains('[')).count()
    };
    settings(models, r#"{ severity: { "non-finite-number": "error" }, ignore: ["VLA"] }"#);
    assert_eq!(lines(&["vla"]), 3);
    settings(models, r#"{ extend: "../ckpt-doctor.json5", "extend-select": ["JSN001"], severity: { JSN: "error" } }"#);
    assert_eq!(lines(&["vla"]), 4);
    assert_eq!(doctor(models, &["check", "vla"]).status.code(), Some(1));
    // It is in the directory that is checked, so the one above applies.
    assert_eq!((lines(&["."]), found(root, &[]).0.len()), (1, 1));
    // Another file given by name; its paths start at its folder.
    fs::create_dir(root.join("ci")).unwrap();
    fs::write(
        root.join("ci/strict.json5"),
        r#"{ "per-path": { "../models/vla": { severity: { JSN001: "error" } } } }"#,
    )
    .unwrap();
    assert_eq!(found(root, &["--config", "ci/strict.json5"]).0[0], "JSN001 error");
    let both = doctor(root, &["check", "models", "--config", "ci/strict.json5", "--isolated"]);
    assert_eq!(both.status.code(), Some(2));
}

/// Downloaded files must not change how they are checked.
#[test]
fn settings_inside_a_checkpoint_are_ignored() {
    let zoo = zoo();
    let (root, vla) = (zoo.path(), zoo.path().join("models/vla"));
    settings(&vla, "{ ignore: ['JSN', 'VLA'] }");
    settings(root, "{ ignore: ['VLA'] }");
    assert_eq!(found(root, &[]).0, INFINITY);
    snapshot!("selection-passed-over", transcript(root, &["check", "models", "--output-format", "concise"]));
    assert_eq!(found(root, &["--config", "models/vla/ckpt-doctor.json5"]).0, Vec::<String>::new());
    // Neither for a checkpoint in a folder of the checkpoint.
    fs::create_dir(vla.join("inner")).unwrap();
    fs::copy(vla.join("config.json"), vla.join("inner/config.json")).unwrap();
    let inner = transcript(root, &["check", "models/vla/inner", "--output-format", "concise"]);
    assert!(inner.contains("models/vla/ckpt-doctor.json5 is inside a checkpoint and is ignored"), "{inner}");
}

#[test]
fn settings_can_differ_by_path() {
    let zoo = zoo();
    let root = zoo.path();
    let with = |per_path: &str| {
        settings(root, &format!("{{ 'per-path': {per_path} }}"));
        found(root, &[]).0
    };
    assert_eq!(with("{ '**/processor_config.json': { ignore: ['JSN001'] } }"), ["VLA024 info"]);
    assert_eq!(with("{ 'models': { ignore: ['JSN001', 'VLA'] } }"), Vec::<String>::new());
    assert_eq!(
        with("{ 'models/*': { ignore: ['JSN'], severity: { VLA024: 'error', VLA: 'info' } } }"),
        ["VLA024 error"]
    );
    assert_eq!(
        with("{ 'models/other': { ignore: ['JSN001', 'VLA'] }, 'm*': { severity: { VLA: 'warning' } } }")[0],
        "VLA024 warning"
    );
    // `*` matches within a name, and a glob starts at the folder of its file.
    assert_eq!(with("{ '*.json': { ignore: ['JSN'] }, 'vla': { ignore: ['JSN'] } }").len(), 4);
}

#[test]
fn errors_in_settings_have_a_position() {
    let zoo = zoo();
    let root = zoo.path();
    fs::write(root.join("circle.json5"), "{ extend: 'ckpt-doctor.json5' }").unwrap();
    let mut shown = String::new();
    for text in [
        "{\n  selct: ['JSN'],\n}",
        "{ select: ['JSN001', 'JSM'] }",
        "{ suppress: [\n  { rule: 'JSN001' },\n] }",
        "{ suppress: [{ rule: 'JSN001', reason: ' ' }] }",
        "{ suppress: [{ rule: 'JSN001', reson: 'x' }] }",
        "{ severity: { JSN001: 'warn' } }",
        "{ severity: { JSN999: 'error' } }",
        "{ 'per-path': { 'a/[': { ignore: ['JSN001'] } } }",
        "{ 'per-path': { 'a': { ignore: ['nonfinite-number'] } } }",
        "{ for: ['torch==2.0'] }",
        "{ 'fail-on': 'eror' }",
        "{ rules: 'no-such-folder' }",
        "{ baseline: 'none.json' }",
        "{ extend: 'none.json5' }",
        "{ extend: 'circle.json5' }",
        "{ select: ['JSN'",
    ] {
        settings(root, text);
        shown.push_str(&format!("{text}\n{}\n", transcript(root, &["check", "models"])));
    }
    settings(root, &"[".repeat(1_000_000));
    shown.push_str(&transcript(root, &["check", "models"]));
    snapshot!("selection-settings-wrong", shown);
    assert!(!shown.contains("--- exit 0") && !shown.contains("--- exit 1"), "{shown}");
    // A FIFO under this name does not block.
    fs::remove_file(root.join("ckpt-doctor.json5")).unwrap();
    assert!(Command::new("mkfifo").arg(root.join("ckpt-doctor.json5")).status().unwrap().success());
    assert_eq!(doctor(root, &["check", "models"]).status.code(), Some(2));
}

#[test]
fn suppressed_findings_are_not_counted_and_have_a_reason() {
    let zoo = zoo();
    let root = zoo.path();
    settings(
        root,
        r#"{
  "fail-on": "warning",
  suppress: [
    { rule: "JSN001", path: "models/vla/processor_config.json", reason: "the statistics of rh20t are not read" },
    { rule: "IDX006", path: "models/vla", reason: "none there" },
  ],
}"#,
    );
    assert_eq!(
        found(root, &[]),
        (vec!["SUP001 warning".to_owned(), "VLA024 info".to_owned()], INFINITY.map(str::to_owned).to_vec())
    );
    snapshot!("selection-suppressed", transcript(root, &["check", "models"]));
    let json = doctor(root, &["check", "models", "--output-format", "json"]);
    let report: Value = serde_json::from_slice(&json.stdout).unwrap();
    assert_eq!(report["summary"]["suppressed"], 3);
    let accepted = &report["checkpoints"][0]["suppressed"][0]["accepted"];
    assert_eq!(accepted["reason"], "the statistics of rh20t are not read");
    assert!(accepted["by"].as_str().unwrap().ends_with("/ckpt-doctor.json5: suppress[0]"), "{accepted}");
    let sarif = doctor(root, &["check", "models", "--output-format", "sarif"]);
    let sarif: Value = serde_json::from_slice(&sarif.stdout).unwrap();
    let results = sarif["runs"][0]["results"].as_array().unwrap();
    let external = |r: &&Value| r["suppressions"][0]["kind"] == "external" && r["ruleId"] == "JSN001";
    assert_eq!((results.len(), results.iter().filter(external).count()), (5, 3));
    for format in ["github", "gitlab", "junit", "concise"] {
        let shown = String::from_utf8(doctor(root, &["check", "models", "--output-format", format]).stdout).unwrap();
        assert!(!shown.contains("JSN001") && shown.contains("SUP001"), "{format}: {shown}");
    }
}

/// It may apply to checkpoints that were not checked.
#[test]
fn a_suppression_is_unused_only_if_all_its_paths_were_checked() {
    let zoo = zoo();
    let root = zoo.path();
    fs::create_dir_all(root.join("models/other")).unwrap();
    fs::copy(root.join("models/vla/config.json"), root.join("models/other/config.json")).unwrap();
    let unused = |suppress: &str, args: &[&str]| {
        settings(root, &format!("{{ suppress: [{{ {suppress}, reason: 'a test' }}] }}"));
        let output = doctor(root, &[&["check", "--output-format", "concise"], args].concat());
        String::from_utf8(output.stdout).unwrap().matches("SUP001").count()
    };
    // Used in one checkpoint, unused in the other.
    assert_eq!(unused("rule: 'JSN001'", &["models"]), 0);
    assert_eq!(unused("rule: 'LFS001'", &["models"]), 0, "below models is not all that lies below the file");
    // The settings file is in the directory that is checked, and must be named.
    let named = ["--config", "ckpt-doctor.json5"];
    let whole = |args: &[&str]| unused("rule: 'LFS001'", &[&["."], &named[..], args].concat());
    assert_eq!(whole(&[]), 1);
    assert_eq!(unused("rule: 'LFS001', path: 'models/**'", &["models"]), 1);
    assert_eq!(unused("rule: 'LFS001', path: 'models/*'", &["models/vla"]), 0);
    assert_eq!(unused("rule: 'LFS001', path: 'models/vla'", &["models/vla/config.json"]), 1);
    assert_eq!(unused("rule: 'LFS001', path: 'models/vla/*.json'", &["models/vla"]), 1);
    assert_eq!(unused("rule: 'LFS001', path: 'models/gone'", &["models/vla"]), 0);
    assert_eq!(unused("rule: 'LFS001', path: 'models/gone'", &["models"]), 1);
    assert_eq!(whole(&["--ignore", "LFS"]), 0);
    assert_eq!(whole(&["--ignore", "SUP"]), 0);
}

#[test]
fn a_baseline_suppresses_earlier_findings() {
    let zoo = zoo();
    let root = zoo.path();
    let check = ["check", "models", "--output-format", "concise", "--fail-on", "warning", "--baseline", "known.json"];
    assert!(transcript(root, &check).contains("--write-baseline creates it"));
    let mut shown = transcript(root, &[&check[..], &["--write-baseline"]].concat());
    shown.push_str(&fs::read_to_string(root.join("known.json")).unwrap());
    shown.push_str(&transcript(root, &check));
    // One finding is fixed, and another one is new.
    let file = root.join("models/vla/processor_config.json");
    let text = fs::read_to_string(&file).unwrap().replacen("Infinity", "0.0", 1);
    fs::write(&file, text).unwrap();
    fs::write(root.join("models/vla/stray.safetensors"), "").unwrap();
    shown.push_str(&transcript(root, &check));
    // Findings of rules that did not run, and of checkpoints that were not checked, stay in the baseline.
    shown.push_str(&transcript(root, &[&check[..], &["--select", "FIL", "--write-baseline"]].concat()));
    snapshot!("selection-baseline", shown);
    let codes = fs::read_to_string(root.join("known.json")).unwrap();
    assert!(codes.contains("JSN001") && codes.contains("VLA024"), "{codes}");
    // From any working directory, and by a setting.
    settings(root, "{ baseline: 'known.json' }");
    let from = doctor(&root.join("models"), &["check", "vla", "--output-format", "json"]);
    let report: Value = serde_json::from_slice(&from.stdout).unwrap();
    assert_eq!(report["checkpoints"][0]["suppressed"].as_array().unwrap().len(), report["summary"]["suppressed"]);
    assert!(report["summary"]["suppressed"].as_u64() >= Some(3), "{report}");
    let none = transcript(root, &["check", "models", "--isolated", "--write-baseline"]);
    assert!(none.contains("no baseline file given") && none.contains("exit 2"), "{none}");
    fs::write(root.join("known.json"), json!({ "schema": 2, "findings": [] }).to_string()).unwrap();
    assert!(transcript(root, &check).contains("baseline version 2 is unknown; expected 1"));
}

#[test]
fn findings_can_be_counted_by_rule() {
    let zoo = zoo();
    let mut shown = String::new();
    for format in ["full", "json", "sarif"] {
        shown.push_str(&transcript(zoo.path(), &["check", "models", "--statistics", "--output-format", format]));
    }
    settings(zoo.path(), "{ select: [] }");
    shown.push_str(&transcript(zoo.path(), &["check", "models", "--statistics"]));
    snapshot!("selection-statistics", shown);
}

#[test]
fn verbose_explains_skipped_rules() {
    let zoo = zoo();
    let args = ["check", "models", "-v", "--output-format", "concise", "--ignore", "SAF,IDX,JSN,ADP,LFS,FIL"];
    snapshot!("selection-verbose", transcript(zoo.path(), &args));
}

const OWN: &str = r#"{
  code: "ACME001",
  name: "model-without-licence",
  severity: "warning",
  summary: "no LICENSE file",
  why: "Our models are not shipped without one.",
  check: { assert: { that: "has_file('LICENSE')" } },
  message: "{directory} has no LICENSE",
}"#;

#[test]
fn rules_of_the_user_run_and_are_listed_and_explained() {
    let zoo = zoo();
    let root = zoo.path();
    fs::create_dir_all(root.join("own/checks/acme")).unwrap();
    let file = root.join("own/checks/acme/ACME001.json5");
    fs::write(&file, OWN).unwrap();
    assert_eq!(found(root, &["--rules", "own", "--select", "ACME"]).0, ["ACME001 warning"]);
    let list = transcript(root, &["rules", "--rules", "own"]);
    assert!(list.contains("ACME001  warning  model-without-licence") && list.contains("IDX005"), "{list}");
    // From the settings, without an option on the command line.
    settings(root, "{ rules: 'own', severity: { ACME: 'error' }, select: ['ACME'] }");
    assert_eq!(found(root, &[]).0, ["ACME001 error"]);
    let mut shown = transcript(root, &["explain", "model-without-licence"]);
    for (from, to) in [
        ("ACME001", "IDX005"),
        ("model-without-licence", "shard-missing"),
        ("ACME001", "acme-1"),
        ("has_file('LICENSE')", "has_file('LICENSE'"),
        ("has_file('LICENSE')", "open('/etc/passwd') == ''"),
        ("has_file('LICENSE')", "has_file('../../../../../../../etc/passwd')"),
        ("has_file('LICENSE')", "range(5000).all(a, range(5000).all(b, range(5000).all(c, a + b + c >= 0)))"),
        ("summary:", "sumary:"),
    ] {
        fs::write(&file, OWN.replace(from, to)).unwrap();
        shown.push_str(&format!(
            "{from} → {to}\n{}",
            transcript(
                root,
                &[
                    "check",
                    "models",
                    "--isolated",
                    "--rules",
                    "own",
                    "--select",
                    "ACME",
                    "--output-format",
                    "concise",
                    "-v"
                ]
            )
            .lines()
            .filter(|l| !l.contains("not selected"))
            .collect::<Vec<_>>()
            .join("\n")
        ));
        shown.push('\n');
    }
    fs::remove_file(&file).unwrap();
    shown.push_str(&transcript(root, &["rules", "--isolated", "--rules", "own"]));
    snapshot!("selection-own-rules", shown);
}

#[test]
fn init_writes_settings_that_change_nothing_and_overwrites_nothing() {
    let zoo = zoo();
    let root = zoo.path();
    let before = found(root, &["--isolated"]);
    let mut shown = transcript(root, &["init", "--pre-commit"]);
    assert_eq!(found(root, &[]), before);
    shown.push_str(&transcript(root, &["init"]));
    fs::remove_file(root.join("ckpt-doctor.json5")).unwrap();
    shown.push_str(&transcript(root, &["init", "--pre-commit"]));
    assert!(!root.join("ckpt-doctor.json5").exists(), "all or nothing");
    shown.push_str(&transcript(root, &["init", "nowhere"]));
    snapshot!("selection-init", shown);
    // The commented lines are valid settings as well.
    fs::create_dir_all(root.join("rules/checks")).unwrap();
    fs::write(root.join("rules/checks/a.json5"), OWN).unwrap();
    assert_eq!(doctor(root, &["init"]).status.code(), Some(0));
    let file = root.join("ckpt-doctor.json5");
    let text = fs::read_to_string(&file).unwrap();
    let on = |line: &str| match line.strip_prefix("  // ") {
        Some(key)
            if key.starts_with([' ', '}', '"'])
                || key.split_once(": ").is_some_and(|(k, _)| k.chars().all(char::is_lowercase)) =>
        {
            key.to_owned()
        }
        _ => line.to_owned(),
    };
    let text: Vec<String> =
        text.lines().filter(|l| !l.contains("extend: ") && !l.contains("baseline: ")).map(on).collect();
    fs::write(&file, text.join("\n")).unwrap();
    let (found, _) = found(root, &[]);
    assert!(before.0.len() == 4 && found.is_empty(), "selected is JSN001, and ignored where it is: {found:?}");
}
