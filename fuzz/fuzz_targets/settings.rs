//! Settings files, a chain of up to three, and their effect on the findings of a checkpoint.
//!
//! The first byte selects the form of the rest: 0 to 3 are whole files, separated by 0xff, the extended one first; the others
//! are lines for the values of a file, which reach the globs and selectors without the JSON around them.

#![no_main]

use std::path::Path;
use std::sync::LazyLock;

use ckpt_doctor::knowledge::rule::{RuleSet, Severity};
use ckpt_doctor::knowledge::selection::Choice;
use ckpt_doctor::knowledge::settings::{Chain, SettingsSource};
use libfuzzer_sys::fuzz_target;
use serde_json::{Value, json};

static RULES: LazyLock<RuleSet> = LazyLock::new(|| RuleSet::embedded().expect("built-in files"));

/// Findings: the file and the code.
const FINDINGS: [(Option<&str>, &str); 5] = [
    (None, "FIL001"),
    (Some("config.json"), "CFG001"),
    (Some("model.safetensors"), "SAF002"),
    (Some("model.safetensors.index.json"), "IDX005"),
    (Some("odd [name]{x}.json"), "JSN001"),
];

/// A settings file with these values.
fn file(lines: &[&str]) -> Value {
    let line = |at: usize| lines.get(at).copied().unwrap_or_default();
    let severity = if line(3).len() % 2 == 0 { "error" } else { "info" };
    json!({
        "per-path": { line(0): { "ignore": [line(1)], "severity": { line(2): severity } } },
        "suppress": [{ "rule": line(4), "path": line(5), "reason": line(3) }],
        "for": [line(6)],
        "extend-select": [line(1)],
        "severity": { line(2): severity },
    })
}

fn chain(data: &[u8]) -> Option<Chain> {
    let (form, rest) = data.split_first()?;
    let dir = |at: usize| Path::new(["/models", "/models/a", "/models/a/b"][at % 3]);
    let mut sources = Vec::new();
    if form % 8 < 4 {
        for (at, bytes) in rest.split(|b| *b == 0xff).take(3).enumerate() {
            let text = std::str::from_utf8(bytes).ok()?;
            sources.push(SettingsSource::parse("ckpt-doctor.json5", dir(at), text).ok()?);
        }
    } else {
        let lines: Vec<&str> = std::str::from_utf8(rest).ok()?.split('\n').collect();
        let text = file(&lines).to_string();
        let source = SettingsSource::parse("ckpt-doctor.json5", dir(usize::from(*form)), &text);
        sources.push(source.expect("keys and types are those of a settings file"));
    }
    Some(Chain(sources))
}

fuzz_target!(|data: &[u8]| {
    let Some(chain) = chain(data) else { return };
    drop((chain.fail_on(), chain.min_severity(), chain.rules(), chain.baseline(), chain.versions()));
    let mut rules = RULES.clone();
    let policy = match chain.govern(&mut rules, Choice::default()) {
        Ok(policy) => policy,
        Err(error) => return drop(error.to_string()),
    };
    assert_eq!(
        rules.rules.len() + rules.unselected.len(),
        RULES.rules.len() + RULES.unselected.len(),
        "a rule is lost"
    );
    assert!(policy.suppressions.iter().all(|s| !s.reason.trim().is_empty() && !s.codes.is_empty()));
    for root in ["/models", "/models/a/b/checkpoint-1", "/other", "relative/x"].map(Path::new) {
        for (file, code) in FINDINGS {
            let graded = policy.grade(root, file, code, Severity::Warning);
            let suppressed = policy.suppression(root, file, code);
            assert!(!policy.is_empty() || graded == Some(Severity::Warning) && suppressed.is_none());
            if let Some(entry) = suppressed.and_then(|at| policy.suppressions.get(at)) {
                assert!(entry.codes.contains(code) && entry.concerns(root, file.into_iter()));
            }
        }
    }
});
