//! A whole checkpoint in memory: checked, rendered, repaired and checked again.

use std::collections::BTreeMap;
use std::sync::Arc;

use ckpt_doctor::check::{Finding, Outcome, check};
use ckpt_doctor::checkpoint::{Checkpoint, Document, Parts, PythonModule, Shard, Vocabulary};
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::report::model::CheckpointReport;
use ckpt_doctor::report::{Format, Report, Style, render};
use ckpt_doctor::surgery::repair::{Content, Repair, plan};

/// A file: its name, its length, and its bytes. Of a shard, the header is enough.
pub type File<'a> = (&'a str, u64, &'a [u8]);

/// The checkpoint of these files, as it would be planned.
pub fn planned(files: &[File]) -> Arc<Checkpoint> {
    let mut parts = Parts::default();
    for (name, len, bytes) in files {
        if name.ends_with(".safetensors") {
            parts.shards.push(Shard::parse(*name, *len, bytes));
        } else if name.ends_with(".json") {
            parts.documents.push(Document::parse(*name, bytes));
        } else if name.ends_with(".py") {
            parts.modules.push(PythonModule::parse(*name, bytes));
        } else if let Ok(vocabulary) = Vocabulary::parse(name, bytes) {
            parts.vocabularies.insert((*name).to_owned(), Arc::new(vocabulary));
        }
    }
    Arc::new(Checkpoint::planned("mutated", parts))
}

/// The invariants of a report in this format.
pub fn renders(checkpoint: &Arc<Checkpoint>, outcome: &Outcome, format: Format) {
    let report = Report::new(vec![CheckpointReport::new("mutated", None, checkpoint, outcome)], None);
    let text = render(&report, format, Style::default());
    assert!(!text.contains(|c: char| c.is_control() && c != '\n'), "{format:?} lets a control character through");
    if matches!(format, Format::Json | Format::Gitlab | Format::Sarif) {
        assert!(serde_json::from_str::<serde_json::Value>(&text).is_ok(), "{format:?} is not JSON");
    }
}

/// The invariants of a repair of these files: what was fixed is gone, a document that was read can still be read, the
/// repaired files give the findings that were planned, and a second repair finds nothing to do.
pub fn repairs(files: &[File], checkpoint: &Arc<Checkpoint>, outcome: &Outcome, knowledge: &Knowledge) {
    let check = |checkpoint: &Arc<Checkpoint>| check(checkpoint, knowledge);
    let repair = plan(checkpoint, outcome.clone(), true, &check);
    if repair.changes.is_empty() {
        return;
    }
    for change in &repair.changes {
        let Content::Text(text) = &change.new else { continue };
        let was_read = checkpoint.document(&change.name).is_some_and(|document| document.value.is_some());
        let document = Document::parse(change.name.as_str(), text.as_bytes());
        assert!(!was_read || document.value.is_some(), "{} can no longer be read: {text}", change.name);
    }
    let after = check(&written(files, &repair));
    assert_eq!(codes(&after), codes(&repair.outcome), "the written files give other findings than the plan");
    for fixed in &repair.fixed {
        let (before, now) = (count(outcome, &fixed.code), count(&after, &fixed.code));
        assert!(now < before, "{} is fixed, and found {now} times instead of {before}", fixed.code);
    }
}

/// The checkpoint of the repaired files, read from their bytes.
fn written(files: &[File], repair: &Repair) -> Arc<Checkpoint> {
    let mut contents: BTreeMap<&str, (u64, Vec<u8>)> =
        files.iter().map(|(name, len, bytes)| (*name, (*len, bytes.to_vec()))).collect();
    let mut shards = Vec::new();
    for change in &repair.changes {
        match &change.new {
            Content::Text(text) => drop(contents.insert(&change.name, (text.len() as u64, text.as_bytes().to_vec()))),
            Content::Shard(shard) => shards.push(shard.preview()),
        }
    }
    let files: Vec<File> = contents.iter().map(|(name, (len, bytes))| (*name, *len, bytes.as_slice())).collect();
    let checkpoint = planned(&files);
    if shards.is_empty() { checkpoint } else { Arc::new(checkpoint.replaced(Parts { shards, ..Parts::default() })) }
}

fn count(outcome: &Outcome, code: &str) -> usize {
    outcome.findings.iter().filter(|f| f.code == code).map(Finding::count).sum()
}

fn codes(outcome: &Outcome) -> BTreeMap<&str, usize> {
    outcome.findings.iter().map(|f| (f.code.as_str(), count(outcome, &f.code))).collect()
}
