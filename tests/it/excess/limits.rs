//! Each limit at one less, at itself and at one more: a finding tells that one more is too much, and nothing else changes.
//!
//! Every limit of the sources on what a stranger wrote has a row here, or a reason in [`reasons`].

mod directories;
mod documents;
mod pickles;
mod reasons;
mod shards;
mod sources;
mod templates;
mod verdicts;

use std::collections::BTreeMap;
use std::fs;
use std::sync::{Arc, OnceLock};

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::checkpoint::{Checkpoint, MemoryFiles, Source};
use ckpt_doctor::knowledge::Knowledge;
use tempfile::TempDir;

use crate::support::{knowledge, make_base};

/// The files of a checkpoint, by name.
type Files = BTreeMap<String, Vec<u8>>;

/// A limit on the content of one file.
struct Limit {
    /// What it is on.
    of: &'static str,
    /// The source file, and the constant or function there; a sum of constants where they bound one thing together.
    at: &'static str,
    most: usize,
    /// The file with so many, which `write` makes; it may change others.
    file: &'static str,
    write: fn(usize, &mut Files) -> Vec<u8>,
    /// A part of the finding on one more.
    says: &'static str,
}

/// All rows, by area.
const LIMITS: [&[Limit]; 5] =
    [directories::LIMITS, documents::LIMITS, pickles::LIMITS, shards::LIMITS, templates::LIMITS];

fn repeated(part: &str, n: usize) -> Vec<u8> {
    part.repeat(n).into_bytes()
}

/// So many parts with their number in place of `#`, and this between them.
fn numbered(part: &str, between: &str, n: usize) -> String {
    (0..n).map(|i| part.replace('#', &i.to_string())).collect::<Vec<_>>().join(between)
}

/// config.json of a tiny Llama with more members.
fn config(files: &Files, members: &str) -> Vec<u8> {
    let text = std::str::from_utf8(&files["config.json"]).unwrap();
    text.replacen('{', &format!("{{{members},"), 1).into_bytes()
}

/// A tiny Llama.
fn base() -> Files {
    static BASE: OnceLock<Files> = OnceLock::new();
    let read = || {
        let room = TempDir::new().unwrap();
        let dir = room.path().join("model");
        make_base("llama", &dir);
        let entries = fs::read_dir(&dir).unwrap().map(|entry| entry.unwrap());
        entries.map(|e| (e.file_name().into_string().unwrap(), fs::read(e.path()).unwrap())).collect()
    };
    BASE.get_or_init(read).clone()
}

fn read(files: Files) -> Checkpoint {
    Checkpoint::read(Source::Memory(MemoryFiles::new("model", files))).unwrap()
}

/// Findings as `code message`, with the number of those that they count besides.
fn findings(files: Files) -> Vec<String> {
    static KNOWLEDGE: OnceLock<Knowledge> = OnceLock::new();
    let outcome = check_for(&Arc::new(read(files)), KNOWLEDGE.get_or_init(knowledge), &RunOptions::default());
    let told = |hidden: u64| if hidden > 0 { format!(" (and {hidden} more)") } else { String::new() };
    outcome.findings.iter().map(|f| format!("{} {}{}", f.code, f.message, told(f.hidden))).collect()
}

/// Faults of reading: so many files are not checked in a moment.
fn faults(files: Files) -> Vec<String> {
    read(files).faults.iter().map(|fault| fault.kind.to_string()).collect()
}

/// Fails with every row on which one more than the limit is not told, or so many are.
#[track_caller]
fn one_more_is_told(limits: &[Limit], by: fn(Files) -> Vec<String>) {
    let mut wrong = Vec::new();
    for limit in limits {
        let [less, most, more] = [limit.most - 1, limit.most, limit.most + 1].map(|n| {
            let mut files = base();
            let bytes = (limit.write)(n, &mut files);
            files.insert(limit.file.to_owned(), bytes);
            by(files)
        });
        let is_told = |found: &[String]| found.iter().any(|finding| finding.contains(limit.says));
        if is_told(&less) || is_told(&most) || !is_told(&more) {
            wrong.push(format!("{} ({}):\n  {less:?}\n  {most:?}\n  {more:?}", limit.of, limit.at));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn one_more_than_a_limit_of_a_directory_is_told() {
    one_more_is_told(directories::LIMITS, faults);
}

#[test]
fn one_more_than_a_limit_of_a_document_is_told() {
    one_more_is_told(documents::LIMITS, findings);
}

#[test]
fn one_more_than_a_limit_of_a_pickle_is_told() {
    one_more_is_told(pickles::LIMITS, findings);
}

#[test]
fn one_more_than_a_limit_of_a_shard_is_told() {
    one_more_is_told(shards::LIMITS, findings);
}

#[test]
fn one_more_than_a_limit_of_a_template_is_told() {
    one_more_is_told(templates::LIMITS, findings);
}
