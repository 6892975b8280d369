//! The form of a checkpoint decides nothing: the order and spelling of JSON, the order of tensors, the number of shards, the name
//! and place of the directory, and files that no loader opens.

use std::collections::BTreeSet;
use std::fmt::Debug;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use ckpt_doctor::check::Outcome;
use ckpt_doctor::check::finding::Finding;
use ckpt_doctor::check::load::LoadReport;
use ckpt_doctor::check::verdict::{ObjectVerdict, PredictedLoad};
use ckpt_doctor::checkpoint::{self, Checkpoint, hex};
use ckpt_doctor::knowledge::Knowledge;
use serde_json::Value;
use sha2::{Digest as _, Sha256};

use super::verdicts::{COMPARED, holds};
use crate::support::change::Change;
use crate::support::weights::{Shard, Weights, join, split};
use crate::support::{Case, Draw, knowledge, open};

/// What a form must leave as it is.
#[derive(PartialEq, Eq)]
struct Answer {
    /// Loader, object, verdict, reason and codes.
    verdicts: BTreeSet<String>,
    findings: Vec<String>,
}

impl Answer {
    /// `directory` is the name of the directory, which some loaders put into their messages.
    fn new(outcome: &Outcome, directory: &Path, with_places: bool) -> Self {
        let finding = |finding: &Finding| {
            let Finding { code, severity, message, locations, .. } = finding;
            let places: Vec<_> = locations.iter().map(|at| (&at.file, &at.pointer, &at.tensor)).collect();
            if with_places {
                format!("{code} {severity:?} {message} {places:?}")
            } else {
                format!("{code} {severity:?}")
            }
        };
        let verdict = |load: &PredictedLoad| {
            let object = |object: &ObjectVerdict| {
                let why = object.why.as_deref().filter(|_| with_places).map(apart_from_order).unwrap_or_default();
                format!("{}: {} {:?} {why} {:?}", load.version(), object.object.name(), object.verdict, object.findings)
            };
            load.objects.iter().map(object).collect::<Vec<_>>()
        };
        let lists = |load: &PredictedLoad| {
            let lists =
                load.tensors.as_ref().map(|LoadReport { missing, unexpected, unbuilt, mismatched, silent, .. }| {
                    let names = [missing, unexpected, unbuilt].map(|list| sorted(list));
                    (names, sorted(mismatched), sorted(silent))
                });
            format!("{}: {lists:?}", load.version())
        };
        let name = directory.file_name().unwrap().to_string_lossy().into_owned();
        let unnamed = |text: String| text.replace(&format!(" in {name}"), " in DIRECTORY");
        // A message may tell the command that opens the directory.
        let in_command = |text: String| text.replace(&format!("--model-path {name} "), "--model-path DIRECTORY ");
        let mut findings: Vec<String> = outcome.findings.iter().map(finding).map(in_command).collect();
        findings.sort();
        let loads = outcome.verdicts.iter();
        Self { verdicts: loads.clone().flat_map(verdict).chain(loads.map(lists)).map(unnamed).collect(), findings }
    }

    /// What the other answer lacks, and what it has in addition.
    fn differences(&self, other: &Self) -> Vec<String> {
        let lines = |answer: &Self| answer.verdicts.iter().chain(&answer.findings).cloned().collect::<Vec<String>>();
        let (mine, others) = (lines(self), lines(other));
        let mut found: Vec<String> =
            mine.iter().filter(|one| !others.contains(one)).map(|one| format!("- {one}")).collect();
        found.extend(others.iter().filter(|one| !mine.contains(one)).map(|one| format!("+ {one}")));
        if found.is_empty() && self != other {
            found.push("another number of equal findings".to_owned());
        }
        found
    }
}

/// The elements as text, in one order.
fn sorted(list: &[impl Debug]) -> Vec<String> {
    let mut texts: Vec<String> = list.iter().map(|entry| format!("{entry:?}")).collect();
    texts.sort();
    texts
}

/// Copies a directory with its folders; false when it has something that is neither file nor folder.
pub(super) fn copy_whole(from: &Path, to: &Path) -> bool {
    fs::create_dir_all(to).unwrap();
    fs::read_dir(from).unwrap().map(|entry| entry.unwrap()).all(|entry| {
        let (kind, target) = (entry.file_type().unwrap(), to.join(entry.file_name()));
        match (kind.is_dir(), kind.is_file()) {
            (true, _) => copy_whole(&entry.path(), &target),
            // A sparse file of a fixture may have terabytes.
            (_, true) => entry.metadata().unwrap().len() < 64 << 20 && fs::copy(entry.path(), &target).is_ok(),
            _ => false,
        }
    })
}

/// A reason without the keyword that Python's `TypeError` names: the first of the call, which is the first in the file.
fn apart_from_order(why: &str) -> &str {
    why.split_once("unexpected keyword argument").map_or(why, |(start, _)| start)
}

/// Another order of the members of all objects, and the characters of strings as escapes. Lists stay.
fn respelled(value: &Value, draw: &mut Draw) -> String {
    match value {
        Value::Object(map) => {
            let mut members: Vec<String> = Vec::new();
            for (key, value) in map {
                let member = format!("{} :\t{}", escaped(key), respelled(value, draw));
                members.insert(draw.below(members.len() + 1), member);
            }
            format!("{{\n{} }}", members.join(" ,\n"))
        }
        Value::Array(items) => {
            let items: Vec<String> = items.iter().map(|item| respelled(item, draw)).collect();
            format!("[ {} ]", items.join(","))
        }
        Value::String(text) => escaped(text),
        other => other.to_string(),
    }
}

/// A string with every tenth letter and everything outside ASCII as an escape.
fn escaped(text: &str) -> String {
    let mut out = String::from("\"");
    for (number, unit) in text.encode_utf16().enumerate() {
        match u8::try_from(unit) {
            Ok(byte @ (b' '..=b'!' | b'#'..=b'[' | b']'..=b'~')) if number % 10 != 3 => out.push(char::from(byte)),
            _ => out.push_str(&format!("\\u{unit:04x}")),
        }
    }
    out + "\""
}

/// Documents that strict JSON reads, without a key given twice.
fn plain_documents(checkpoint: &Checkpoint) -> Vec<(String, Value)> {
    let documents = checkpoint.documents.iter().chain(&checkpoint.nested.documents);
    let sound = documents.filter(|(_, document)| document.faults.is_empty());
    let index_is_sound = checkpoint.index.as_ref().is_none_or(|index| index.faults.is_empty());
    let sound = sound.filter(|(name, _)| index_is_sound || !name.ends_with(".index.json"));
    let parsed = sound.filter_map(|(name, document)| {
        Some((name.clone(), serde_json::from_str::<Value>(document.text.as_deref()?).ok()?))
    });
    parsed.collect()
}

/// Whether the header and data of every shard are as safetensors writes them.
pub(super) fn has_plain_shards(checkpoint: &Checkpoint) -> bool {
    let is_plain =
        |shard: &checkpoint::Shard| !shard.is_pickle() && shard.faults.is_empty() && shard.metadata().is_some();
    !checkpoint.shards.is_empty() && checkpoint.shards.values().all(is_plain)
}

fn respell(dir: &Path, checkpoint: &Checkpoint, draw: &mut Draw) -> bool {
    let documents = plain_documents(checkpoint);
    for (name, value) in &documents {
        fs::write(dir.join(name), respelled(value, draw)).unwrap();
    }
    !documents.is_empty()
}

/// Another order of the tensors, in header and data, of every shard.
fn reorder(dir: &Path, checkpoint: &Checkpoint, draw: &mut Draw) -> bool {
    if !has_plain_shards(checkpoint) {
        return false;
    }
    let names: Vec<&String> = checkpoint.shards.keys().collect();
    for name in names {
        let bytes = fs::read(dir.join(name)).unwrap();
        let (header, data) = split(&bytes);
        let Ok(Value::Object(header)) = serde_json::from_str::<Value>(header) else { return false };
        let mut entries: Vec<(String, Value)> = Vec::new();
        for (name, entry) in header {
            entries.insert(draw.below(entries.len() + 1), (name, entry));
        }
        let (mut shuffled, mut moved) = (serde_json::Map::new(), Vec::new());
        for (name, mut entry) in entries {
            if let Some([Some(begin), Some(end)]) =
                entry.pointer("/data_offsets").map(|at| [&at[0], &at[1]].map(Value::as_u64))
            {
                let range = usize::try_from(begin).unwrap()..usize::try_from(end).unwrap();
                entry["data_offsets"] = serde_json::json!([moved.len(), moved.len() + range.len()]);
                moved.extend_from_slice(&data[range]);
            }
            shuffled.insert(name, entry);
        }
        let mut header = Value::Object(shuffled).to_string();
        header.push_str(&" ".repeat((8 - header.len() % 8) % 8));
        fs::write(dir.join(name), join(header.as_bytes(), &moved)).unwrap();
    }
    true
}

/// `model.safetensors` as two shards with their index.
fn reshard(dir: &Path, checkpoint: &Checkpoint, draw: &mut Draw) -> bool {
    let is_whole = checkpoint.index.is_none()
        && checkpoint.shards.keys().eq(["model.safetensors"])
        && checkpoint.config().is_some();
    if !is_whole || !has_plain_shards(checkpoint) {
        return false;
    }
    let mut weights = Weights::read(dir);
    let [whole] = &mut weights.shards[..] else { return false };
    if whole.tensors.len() < 2 {
        return false;
    }
    let second = whole.tensors.split_off(1 + draw.below(whole.tensors.len() - 1));
    "model-00001-of-00002.safetensors".clone_into(&mut whole.file);
    weights.shards.push(Shard { file: "model-00002-of-00002.safetensors".to_owned(), tensors: second });
    fs::remove_file(dir.join("model.safetensors")).unwrap();
    weights.write(dir);
    weights.write_index(dir);
    true
}

/// The directory as the hub cache has it: links to blobs.
#[cfg(unix)]
fn as_hub_cache(made: &Path, room: &Path) -> Option<PathBuf> {
    let repository = room.join("models--org--name");
    let dir = repository.join("snapshots/0123456789abcdef0123456789abcdef01234567");
    copy_whole(made, &dir).then_some(())?;
    fs::create_dir_all(repository.join("blobs")).unwrap();
    for entry in fs::read_dir(&dir).unwrap() {
        let entry = entry.unwrap();
        if entry.file_type().unwrap().is_file() {
            let blob = hex(&Sha256::digest(fs::read(entry.path()).unwrap()));
            fs::rename(entry.path(), repository.join("blobs").join(&blob)).unwrap();
            std::os::unix::fs::symlink(format!("../../blobs/{blob}"), entry.path()).unwrap();
        }
    }
    Some(dir)
}

/// Rules of which another form has other findings for a reason: recorded digests, and a budget that every file takes from.
const EXCEPTED: [&str; 3] = ["FIL011", "SAF023", "SAF025"];

/// Whether the name and place of the directory are what the case is about: it was renamed, or lies in a work tree.
fn is_of_a_place(case: &Case) -> bool {
    let is_placed = |change: &Change| match change {
        // The signature of a journal is of its folder.
        Change::Directory(_) | Change::OwnJournal => true,
        Change::Write { file, .. } => file.starts_with(".."),
        _ => false,
    };
    case.changes.iter().any(is_placed)
}

/// Files that no loader opens beside weights and documents.
const UNOPENED: [(&str, &[u8]); 11] = [
    ("notes.txt", b"loss 0.4 after 1000 steps\n"),
    ("old.json", b"{\"model_type\": "),
    ("results.json", b"{\"accuracy\": NaN}"),
    ("config_old.json", b"{\"model_type\": \"llama\", \"hidden_size\": -1}"),
    ("events.out.tfevents.1700000000.host", b"\x18\0\0\0\0\0\0\0"),
    ("old.safetensors", b"\xff\xff\xff\xff\xff\xff\xff\xff"),
    ("eval/metrics.json", b"{"),
    ("plot.py", b"def f(:\n"),
    ("training_args.bin", b"\x80\x02}q\0."),
    ("optimizer.pt", b"PK\x03\x04"),
    ("model.onnx", b""),
];

/// Makes the checkpoint of a case again in a room, in another form; `None` when the case cannot have it.
type Form<'f> = &'f (dyn Fn(&Path, &Path, &Checkpoint, &mut Draw) -> Option<PathBuf> + Sync);

/// A form that is made by a change of a copy of the directory; `false` is "it cannot be made".
fn changed(
    change: impl Fn(&Path, &Checkpoint, &mut Draw) -> bool + Sync,
) -> impl Fn(&Path, &Path, &Checkpoint, &mut Draw) -> Option<PathBuf> + Sync {
    move |made, room, checkpoint, draw| {
        let dir = room.join(made.file_name().unwrap());
        (copy_whole(made, &dir) && change(&dir, checkpoint, draw)).then_some(dir)
    }
}

/// A form, and what it may change.
struct Kept<'f> {
    /// Whether messages, reasons and places stay as they are, too.
    with_places: bool,
    /// True of a finding that the form may add: its code, and whether it is information.
    is_own: &'f (dyn Fn(&Knowledge, &str, bool) -> bool + Sync),
    form: Form<'f>,
}

impl Kept<'_> {
    /// What differs between the answers for a case and for its other form; `None` when it cannot have it.
    fn differing(&self, case: &Case, made: &Path, knowledge: &Knowledge) -> Option<Vec<String>> {
        let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        let (checkpoint, before) = open(made, case.deep, &case.loaders, knowledge);
        let mut draw = Draw::new(case.name.bytes().map(u64::from).sum());
        let is_excepted = is_of_a_place(case) || EXCEPTED.iter().any(|code| case.code.as_deref() == Some(code));
        let dir = if is_excepted { None } else { (self.form)(made, room.path(), &checkpoint, &mut draw) }?;
        let (_, after) = open(&dir, case.deep, &case.loaders, knowledge);
        COMPARED.fetch_add(after.verdicts.len(), Ordering::Relaxed);
        let [before, mut after] =
            [(before, made), (after, &dir)].map(|(outcome, dir)| Answer::new(&outcome, dir, self.with_places));
        after.findings.retain(|finding| {
            let (code, rest) = finding.split_once(' ').unwrap();
            before.findings.contains(finding) || !(self.is_own)(knowledge, code, rest.starts_with("Info"))
        });
        Some(before.differences(&after).into_iter().map(|why| format!("{}: {why}", case.name)).collect())
    }

    /// Tries the form on every case.
    fn holds(&self) {
        let (knowledge, tried) = (knowledge(), AtomicUsize::new(0));
        let look = |case: &Case, made: &Path| -> Vec<String> {
            let differing = self.differing(case, made, &knowledge);
            tried.fetch_add(usize::from(differing.is_some()), Ordering::Relaxed);
            differing.unwrap_or_default()
        };
        holds(PART, look, &knowledge);
        // Some cases are links, FIFOs or damaged shards.
        let tried = tried.into_inner();
        assert!(tried * PART > 200, "{tried} cases have this form");
    }
}

/// Law *form*: what differs between a case and a drawn form of it, named.
pub(super) fn form(case: &Case, made: &Path, knowledge: &Knowledge, draw: &mut Draw) -> Vec<String> {
    let number = draw.below(6);
    let (name, differing) = match number {
        0 => ("respelled", keeps(true, &changed(respell)).differing(case, made, knowledge)),
        1 => ("reordered", keeps(true, &changed(reorder)).differing(case, made, knowledge)),
        2 => ("resharded", keeps(false, &changed(reshard)).differing(case, made, knowledge)),
        3 => ("renamed", keeps(true, &renamed).differing(case, made, knowledge)),
        4 => {
            ("in the cache", keeps(true, &|made, room, _, _| as_hub_cache(made, room)).differing(case, made, knowledge))
        }
        _ => {
            let form = Kept { with_places: true, is_own: &is_info_or_harm, form: &changed(add_unopened) };
            ("with a file", form.differing(case, made, knowledge))
        }
    };
    differing.unwrap_or_default().into_iter().map(|why| format!("{name}: {why}")).collect()
}

/// One case of so many is tried in a plain `cargo test`.
const PART: usize = 20;

/// A form that adds no finding.
fn keeps(with_places: bool, form: Form<'_>) -> Kept<'_> {
    Kept { with_places, is_own: &|_, _, _| false, form }
}

/// The directory under another name.
fn renamed(made: &Path, room: &Path, _: &Checkpoint, _: &mut Draw) -> Option<PathBuf> {
    let dir = room.join("another-name");
    copy_whole(made, &dir).then_some(dir)
}

#[test]
fn order_and_spelling_of_json_decide_nothing() {
    keeps(true, &changed(respell)).holds();
}

#[test]
fn the_order_of_tensors_decides_nothing() {
    keeps(true, &changed(reorder)).holds();
}

#[test]
fn the_number_of_shards_decides_nothing() {
    keeps(false, &changed(reshard)).holds();
}

#[test]
fn the_name_of_the_directory_decides_nothing() {
    keeps(true, &renamed).holds();
}

#[cfg(unix)]
#[test]
fn links_of_the_hub_cache_decide_nothing() {
    keeps(true, &|made, room, _, _| as_hub_cache(made, room)).holds();
}

/// Adds a file that no loader opens.
fn add_unopened(dir: &Path, checkpoint: &Checkpoint, draw: &mut Draw) -> bool {
    // Beside weights of no known name another library may open any.
    let is_told = |name: &String| name.starts_with("model") || name.starts_with("adapter_model.");
    if checkpoint.index.is_none() && !checkpoint.shards.keys().any(is_told) {
        return false;
    }
    let (mut name, bytes) = draw.one(&UNOPENED);
    let mut bytes = bytes.to_vec();
    let whole = ["model.safetensors", "model-00001-of-00002.safetensors"].map(|name| fs::read(dir.join(name)));
    if let Some(shard) = whole.into_iter().flatten().next().filter(|shard| shard.len() > 9 && draw.once_in(2)) {
        (name, bytes) = ("old.safetensors", shard);
        // In the length of the header, the header or the data.
        let end = if draw.once_in(2) { bytes.len() } else { 64 };
        let at = draw.below(end.min(bytes.len()));
        bytes[at] ^= u8::try_from(1 + draw.below(255)).unwrap();
    }
    let path = dir.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    !path.exists() && fs::write(path, bytes).is_ok()
}

/// Whether a finding is information, or of a rule with a harm.
fn is_info_or_harm(knowledge: &Knowledge, code: &str, is_info: bool) -> bool {
    is_info || knowledge.rules.all().any(|rule| rule.code == code && rule.harm.is_some())
}

/// It may have a finding of its own, of a harm or of severity info.
#[test]
fn a_file_that_no_loader_opens_decides_nothing() {
    Kept { with_places: true, is_own: &is_info_or_harm, form: &changed(add_unopened) }.holds();
}
