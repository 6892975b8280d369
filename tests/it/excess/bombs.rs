//! Files that a user passes, with too much in them: each is refused with a message that names it.

use std::fs;
use std::path::Path;
use std::process::Command;

use tempfile::TempDir;

use super::shape::Excess;
use crate::support::Draw;

/// A text that is repeated: before, after, and around what.
fn repeated(open: &str, inner: &str, close: &str, n: usize) -> String {
    format!("{}{inner}{}", open.repeat(n), close.repeat(n))
}

/// Expressions with too many terms, brackets or bytes.
fn expressions() -> Vec<String> {
    vec![
        repeated("", "1", "+1", 300_000),
        repeated("(", "1", ")", 5_000),
        repeated("[", "1", "]", 100_000),
        repeated("!", "true", "", 300_000),
        repeated("", "a", ".a", 100_000),
        repeated("true?1:", "1", "", 10_000),
        format!("size(\\\"{}\\\") > 0", "x".repeat(10_000_000)),
    ]
}

#[test]
fn files_of_a_user_are_refused_with_their_name() {
    let dir = TempDir::new().unwrap();
    let checkpoint = dir.path().join("model");
    fs::create_dir(&checkpoint).unwrap();
    Excess::Nesting.write(&checkpoint, 1, &mut Draw::new(1));
    for n in [9, 300, 3_000] {
        let glob = repeated("{a,", "b", "}", n);
        let settings = dir.path().join("settings.json5");
        fs::write(&settings, format!("{{\"per-path\": {{\"{glob}\": {{ignore: [\"ARC\"]}}}}}}")).unwrap();
        refused(&["check", "--config"], &settings, &checkpoint);
    }
    let rules = dir.path().join("rules");
    fs::create_dir_all(rules.join("checks")).unwrap();
    let recipe = dir.path().join("recipe.json5");
    for expression in expressions() {
        let rule = format!(
            r#"{{code: "XXX001", name: "x", severity: "error", summary: "x", why: "x", message: "x",
            check: {{assert: {{that: "{expression}"}}}}, fix: {{safety: "manual", help: "x"}}}}"#
        );
        fs::write(rules.join("checks/XXX001.json5"), rule).unwrap();
        refused(&["check", "--rules"], &rules, &checkpoint);
        let text = format!(
            r#"{{recipe: "x", summary: "s", donors: [{{role: "a", what: "w"}}], let: [{{name: "n", is: "{expression}"}}],
            documents: [{{name: "config.json", from: "a"}}], tensors: [{{from: "a", names: "."}}]}}"#
        );
        fs::write(&recipe, text).unwrap();
        refused(
            &["build-merged", "--out", "out", "--donor", &format!("a={}", checkpoint.display()), "--recipe"],
            &recipe,
            Path::new(""),
        );
    }
}

/// Runs the program on a file within a limit of memory; it must end with code 2 and name the file.
fn refused(args: &[&str], file: &Path, last: &Path) {
    let mut shell = Command::new("/bin/sh");
    let script = "ulimit -c 0; ulimit -v 524288; ulimit -t 60; exec \"$0\" \"$@\"";
    shell.args(["-c", script, env!("CARGO_BIN_EXE_ckpt-doctor")]).args(args).arg(file);
    shell.env("XDG_STATE_HOME", crate::support::state());
    if !last.as_os_str().is_empty() {
        shell.arg(last);
    }
    let output = shell.output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    let shown: String = errors.chars().take(300).collect();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {shown}");
    let name = file.file_name().unwrap().to_str().unwrap();
    assert!(errors.contains(name) && errors.len() < 4_000, "{args:?}: {} bytes: {shown}", errors.len());
}
