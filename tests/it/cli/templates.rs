//! Chat templates that the program renders in a process of its own.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

/// Writes a directory whose tokenizer has these templates, the first one as the default.
fn write(dir: &Path, templates: &[&str]) {
    fs::create_dir_all(dir).unwrap();
    let named = |(number, text): (usize, &&str)| json!({ "name": if number == 0 { "default".to_owned() } else { number.to_string() }, "template": text });
    let list: Vec<Value> = templates.iter().enumerate().map(named).collect();
    fs::write(dir.join("config.json"), "{}").unwrap();
    fs::write(dir.join("tokenizer_config.json"), json!({ "chat_template": list }).to_string()).unwrap();
}

/// `code message` of the findings about templates, by directory.
fn findings(prefix: &[&str], dirs: &Path) -> Vec<Vec<String>> {
    let program = env!("CARGO_BIN_EXE_ckpt-doctor");
    let words = [prefix, &[program, "check", "--isolated", "--output-format", "json"]].concat();
    let output = std::process::Command::new(words[0])
        .args(&words[1..])
        .arg(dirs)
        .env("XDG_STATE_HOME", crate::support::state())
        .output()
        .unwrap();
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {output:?}"));
    let about = |finding: &&Value| ["TOK015", "TOK025", "TOK026"].iter().any(|code| finding["code"] == **code);
    let line = |f: &Value| {
        let place = f["locations"][0]["pointer"].as_str().unwrap_or_default();
        format!("{} {place} {}", f["code"].as_str().unwrap(), f["message"].as_str().unwrap())
    };
    let of = |checkpoint: &Value| checkpoint["findings"].as_array().unwrap().iter().filter(about).map(line).collect();
    report["checkpoints"].as_array().unwrap().iter().map(of).collect()
}

/// Findings as text, a paragraph for each directory.
fn lines(found: &[Vec<String>]) -> String {
    found.iter().map(|of| of.join("\n")).collect::<Vec<_>>().join("\n\n")
}

const RANGE: &str = "{% for i in range(messages|length) %}{{ messages[i].content }}{% endfor %}";
const WITHOUT_END: &str = "{% for i in range(9) %}";
/// Takes 2^50 steps that the engine does not count.
const DEADLY: &str =
    "{% set n = namespace(a=[1]) %}{% for i in range(50) %}{% set n.a = [n.a, n.a] %}{% endfor %}{{ n.a }}";
#[test]
fn templates_outside_the_allow_list_are_rendered() {
    let room = TempDir::new().unwrap();
    write(room.path(), &[RANGE, WITHOUT_END]);
    assert_eq!(
        findings(&["/usr/bin/env"], room.path()),
        [[
            "TOK015 /chat_template/1/template the chat template is invalid at its line 1: unexpected end of input, expected end of block"
        ]]
    );
}

#[test]
fn a_template_that_ends_its_process_is_refused_and_the_run_goes_on() {
    let room = TempDir::new().unwrap();
    write(&room.path().join("a"), &[RANGE, DEADLY, RANGE, WITHOUT_END]);
    write(&room.path().join("b"), &[RANGE]);
    write(&room.path().join("c"), &[DEADLY]);
    write(&room.path().join("d"), &[WITHOUT_END]);
    let found = findings(&["/usr/bin/env"], room.path());
    assert_eq!(found.len(), 4, "{found:#?}");
    snapshot!("templates-ended", lines(&found));
}

#[test]
fn without_a_process_templates_are_not_rendered_and_said_so() {
    let room = TempDir::new().unwrap();
    write(room.path(), &[RANGE, DEADLY, "{{ messages }}"]);
    // Room for the program's own threads and none for another process.
    let script = "ulimit -n 6; exec \"$0\" \"$@\"";
    let found = findings(&["/bin/sh", "-c", script], room.path());
    snapshot!("templates-without-process", lines(&found));
}

#[test]
fn a_process_that_gets_no_job_fails() {
    let output = crate::support::program().arg("--render-templates").output().unwrap();
    assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(2), [].as_slice()));
}
