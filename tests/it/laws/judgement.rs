//! No byte below a path that is checked decides how it is judged.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;
use tempfile::TempDir;

use super::{base, cases};
use crate::support::Draw;

/// Folders of a case, from the top to the checkpoint.
const LEVELS: [&str; 5] = ["", "home", "home/download", "home/download/sub", "home/download/sub/checkpoint"];

/// Settings that silence everything, each in another way.
const SILENCING: [&str; 8] = [
    "{ ignore: ['ARC', 'CFG', 'FIL', 'IDX', 'JSN', 'LFS', 'SAF', 'SEC', 'TOK', 'AUT', 'GEN'] }",
    "{ select: ['VLA'] }",
    "{ severity: { ARC003: 'info', LFS001: 'info', JSN001: 'info', AUT001: 'info' } }",
    "{ 'per-path': { '**': { ignore: ['ARC', 'LFS', 'JSN', 'AUT'] } } }",
    "{ suppress: [{ rule: 'A', reason: 'x' }, { rule: 'L', reason: 'x' }, { rule: 'J', reason: 'x' }] }",
    "{ 'metadata-only': true, ignore: ['ARC', 'LFS'] }",
    "{ extend: 'other.json5', ignore: ['ARC'] }",
    "{ for: ['transformers==4.47.0'], 'fail-on': 'error', 'min-severity': 'error', ignore: ['ARC', 'LFS'] }",
];

/// Adds a trailing comma to a config.json.
fn comma(dir: &Path) {
    let text = fs::read_to_string(dir.join("config.json")).unwrap();
    fs::write(dir.join("config.json"), format!("{},}}", text.trim_end().trim_end_matches('}').trim_end())).unwrap();
}

/// A checkpoint with a tensor missing, a shard that is a pointer, or a document that is not JSON.
fn make(draw: &mut Draw, dir: &Path) {
    base(dir);
    match draw.below(3) {
        0 => comma(dir),
        1 => {
            let oid = "0123456789abcdef".repeat(4);
            let text = format!("version https://git-lfs.github.com/spec/v1\noid sha256:{oid}\nsize 4700\n");
            fs::write(dir.join("model.safetensors"), text).unwrap();
        }
        _ => {
            let text = fs::read_to_string(dir.join("config.json")).unwrap();
            let more = text.replace("\"num_hidden_layers\": 2", "\"num_hidden_layers\": 3");
            fs::write(dir.join("config.json"), more).unwrap();
        }
    }
}

fn doctor(cwd: &Path, args: &[&str]) -> Output {
    crate::support::program().current_dir(cwd).args(args).output().unwrap()
}

/// The report without what names the settings.
fn report(output: &Output) -> Value {
    let mut report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {output:?}"));
    for checkpoint in report["checkpoints"].as_array_mut().unwrap() {
        checkpoint.as_object_mut().unwrap().remove("settings");
    }
    report
}

/// The settings file that may decide: the nearest from the working directory upward that is not in what is checked.
fn trusted(planted: &[PathBuf], here: &Path, given: &Path) -> Option<PathBuf> {
    let allowed = |file: &&PathBuf| {
        let folder = file.parent().unwrap();
        here.starts_with(folder) && !folder.starts_with(given) && !folder.join("config.json").exists()
    };
    planted.iter().filter(allowed).max_by_key(|file| file.components().count()).cloned()
}

#[test]
fn no_byte_below_a_checked_path_decides_how_it_is_judged() {
    for seed in 0..cases(30) {
        let mut draw = Draw::new(seed);
        let room = TempDir::new().unwrap();
        let top = room.path().canonicalize().unwrap();
        let levels = LEVELS.map(|level| top.join(level));
        fs::create_dir_all(&levels[4]).unwrap();
        make(&mut draw, &levels[4]);
        let mut planted = Vec::new();
        for level in &levels {
            if draw.once_in(2) {
                fs::write(level.join("ckpt-doctor.json5"), draw.one(&SILENCING)).unwrap();
                fs::write(level.join("other.json5"), "{ ignore: ['LFS', 'JSN'] }").unwrap();
                planted.push(level.join("ckpt-doctor.json5"));
            }
            if draw.once_in(4) && level != &top {
                // A work tree with git-lfs, in which pointers are expected.
                fs::create_dir_all(level.join(".git/lfs")).unwrap();
                fs::write(level.join(".gitattributes"), "*.safetensors filter=lfs -text\n").unwrap();
            }
        }
        let given = &levels[2 + draw.below(3)];
        let here = &levels[draw.below(levels.len())];
        let shown = match given.strip_prefix(here) {
            Ok(below) if below.as_os_str().is_empty() => ".".to_owned(),
            Ok(below) if draw.once_in(2) => below.display().to_string(),
            _ => given.display().to_string(),
        };
        let decides = trusted(&planted, here, given);
        let free = doctor(here, &["check", &shown, "--output-format", "json"]);
        let fixed = match &decides {
            Some(file) => vec!["--config", file.to_str().unwrap()],
            None => vec!["--isolated"],
        };
        let forced = doctor(here, &[&["check", &shown, "--output-format", "json"], &fixed[..]].concat());
        let context = format!("seed {seed}: check {shown} in {}, {decides:?} of {planted:?}", here.display());
        assert_eq!(free.status.code(), forced.status.code(), "{context}");
        assert_eq!(report(&free), report(&forced), "{context}");
        let json: Value = serde_json::from_slice(&free.stdout).unwrap();
        let used = json["checkpoints"][0]["settings"].as_str().map(PathBuf::from);
        assert_eq!(used, decides, "{context}");
        if decides.is_none() && !here.ancestors().any(|dir| dir.join(".git").exists() && !dir.starts_with(given)) {
            assert_eq!(free.status.code(), Some(1), "{context}");
        }
        let notes = String::from_utf8(free.stderr).unwrap();
        for ignored in planted.iter().filter(|file| Some(*file) != decides.as_ref()) {
            let above = |dir: &Path| given.starts_with(dir) || dir.starts_with(given);
            let nearer = decides.as_ref().is_none_or(|used| ignored.starts_with(used.parent().unwrap()));
            let name = ignored.strip_prefix(here).unwrap_or(ignored).display().to_string();
            if nearer && above(ignored.parent().unwrap()) {
                assert!(notes.contains(&format!("{name} is ")), "{context}: {name} is not named in {notes}");
            }
        }
    }
}

/// Its formats: every one says that the rules were changed.
#[test]
fn a_verdict_under_settings_says_so_in_every_format() {
    let room = TempDir::new().unwrap();
    base(&room.path().join("model"));
    comma(&room.path().join("model"));
    let formats =
        ["full", "table", "concise", "json", "jsonl", "github", "gitlab", "junit", "sarif", "markdown", "html"];
    for silencing in &SILENCING[..6] {
        fs::write(room.path().join("ckpt-doctor.json5"), silencing).unwrap();
        for format in formats {
            let shown = doctor(room.path(), &["check", "model", "--output-format", format]);
            let shown = String::from_utf8(shown.stdout).unwrap();
            let start: String = shown.chars().take(2000).collect();
            assert!(shown.contains("ckpt-doctor.json5"), "{format} under {silencing}: {start}");
        }
    }
    for format in formats {
        let shown = doctor(room.path(), &["check", "model", "--isolated", "--output-format", format]);
        assert!(!String::from_utf8(shown.stdout).unwrap().contains("ckpt-doctor.json5"), "{format}");
    }
}

/// A folder that somebody else owns does not decide, even above the working directory.
#[test]
fn the_settings_of_another_owner_are_ignored() {
    let room = TempDir::new().unwrap();
    let dir = room.path().join("shared/work");
    base(&dir.join("model"));
    comma(&dir.join("model"));
    fs::write(dir.join("ckpt-doctor.json5"), SILENCING[0]).unwrap();
    assert_eq!(doctor(&dir, &["check", "model"]).status.code(), Some(0));
    // Only root can give a folder away; other users see the first half of the test.
    let nobody = Some(rustix::fs::Uid::from_raw(65_534));
    for given_away in [&dir, &dir.join("ckpt-doctor.json5")] {
        if rustix::fs::chown(given_away, nobody, None).is_err() {
            return;
        }
        let output = doctor(&dir, &["check", "model"]);
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        let notes = String::from_utf8(output.stderr).unwrap();
        assert!(notes.contains("ckpt-doctor.json5 belongs to another user and is ignored"), "{notes}");
        rustix::fs::chown(given_away, Some(rustix::process::geteuid()), None).unwrap();
    }
}
