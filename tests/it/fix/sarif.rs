//! Fixes in SARIF: applying the replacements gives the same text as `--fix`.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::check::{Outcome, check};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::report::model::CheckpointReport;
use ckpt_doctor::report::{Format, Report, Style, render};
use ckpt_doctor::surgery::repair::{Content, plan};
use serde_json::Value;

use super::codes;
use crate::support;

/// Families whose rules check texts.
const OF_TEXTS: [&str; 8] = ["AUT", "CFG", "GEN", "IDX", "JSN", "PRC", "SEC", "TOK"];

/// The byte at a line and column: both start at 1, columns count characters, and the line end follows the last one.
fn offset(text: &str, line: &Value, column: &Value) -> usize {
    let number = |value: &Value| usize::try_from(value.as_u64().expect("a number")).expect("a small one") - 1;
    let before: usize = text.split_inclusive('\n').take(number(line)).map(str::len).sum();
    let mut places = text[before..].char_indices().map(|(at, _)| at).chain([text.len() - before]);
    before + places.nth(number(column)).expect("a column of the text")
}

/// Applies replacements, all of them relative to the original text.
fn replaced(text: &str, change: &Value) -> String {
    let mut replacements: Vec<(usize, usize, &str)> = Vec::new();
    for replacement in change["replacements"].as_array().expect("a list") {
        let region = &replacement["deletedRegion"];
        let start = offset(text, &region["startLine"], &region["startColumn"]);
        let end = offset(text, &region["endLine"], &region["endColumn"]);
        replacements.push((start, end, replacement["insertedContent"]["text"].as_str().unwrap_or_default()));
    }
    replacements.sort_unstable();
    let (mut out, mut at) = (String::new(), 0);
    for (start, end, new) in replacements {
        out.push_str(&text[at..start]);
        out.push_str(new);
        at = end;
    }
    out + &text[at..]
}

/// Compares each finding's fix in SARIF with the result of applying only this fix; returns the codes with a fix.
fn compared(dir: &Path, knowledge: &Knowledge) -> Vec<String> {
    let checkpoint = Arc::new(Checkpoint::open(dir).expect("a directory"));
    let outcome = check(&checkpoint, knowledge);
    let mut seen = Vec::new();
    for finding in &outcome.findings {
        let mut alone = finding.clone();
        if let Some(fix) = &mut alone.fix {
            // What the load after it proves is tried elsewhere.
            fix.needs_whole_load = false;
        }
        let one = Outcome { findings: vec![alone], ..Outcome::default() };
        let report = Report::new(vec![CheckpointReport::new("model", None, &checkpoint, &one)], None);
        let log = render(&report, Format::Sarif, Style { cap: 8, ..Style::default() });
        let log: Value = serde_json::from_str(&log).expect("JSON");
        let Some(fixes) = log["runs"][0]["results"][0]["fixes"].as_array() else { continue };
        let [fix] = fixes.as_slice() else { panic!("{}: {} fixes", finding.code, fixes.len()) };
        let mut shown: BTreeMap<String, String> = BTreeMap::new();
        for change in fix["artifactChanges"].as_array().expect("a list") {
            let uri = change["artifactLocation"]["uri"].as_str().expect("an address");
            let file = uri.strip_prefix("model/").expect("a file of the checkpoint");
            let text = fs::read_to_string(dir.join(file)).expect("text");
            shown.insert(file.to_owned(), replaced(&text, change));
        }
        let repair = plan(&checkpoint, one, true, &|_| Outcome::default());
        let written: BTreeMap<String, String> = repair
            .changes
            .iter()
            .map(|change| match &change.new {
                Content::Text(text) => (change.name.clone(), text.to_string()),
                Content::Shard(_) => panic!("{}: a shard is no text", finding.code),
            })
            .collect();
        assert_eq!(shown, written, "{}: {}", finding.code, finding.message);
        seen.push(finding.code.clone());
    }
    seen
}

#[test]
fn replacements_equal_the_written_fix() {
    let knowledge = support::knowledge();
    let of_texts = |name: &str| OF_TEXTS.iter().any(|family| name.starts_with(family));
    let compared = support::on_cases(&knowledge, of_texts, |_, _, dir| compared(dir, &knowledge));
    snapshot!("fix-in-sarif", codes(compared.iter().flat_map(|(_, codes)| codes)));
}
