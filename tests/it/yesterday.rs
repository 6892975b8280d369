//! What the revision 38ea486 wrote is read, undone and verified: `fixtures/yesterday`, and docs/compatibility.md.

use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::time::{Duration, SystemTime};

use serde_json::Value;
use tempfile::TempDir;

use crate::support::{copy, files, program, project};

fn fixture(name: &str) -> PathBuf {
    project().join("fixtures/yesterday").join(name)
}

/// The directory as the earlier revision left it. A checkout has other times and inodes than the journal, as an upgrade of the
/// program has not: originals get their times again, and a journal of a header the inode of its shard.
fn left(name: &str) -> TempDir {
    let dir = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    copy_tree(&fixture(name), dir.path());
    let own = dir.path().join(".ckpt-doctor");
    let journal = ["journal.json", "undo/1.json"].map(|name| own.join(name)).into_iter().find(|path| path.exists());
    let Some(journal) = journal else { return dir };
    let mut written: Value = serde_json::from_slice(&fs::read(&journal).unwrap()).unwrap();
    assert_eq!(written["version"], 2);
    for file in written["files"].as_array_mut().unwrap() {
        let name = file["name"].as_str().unwrap().to_owned();
        let [seconds, nanoseconds] = [0, 1].map(|at| file["old"]["mtime"][at].as_u64().unwrap());
        let time = SystemTime::UNIX_EPOCH + Duration::new(seconds, u32::try_from(nanoseconds).unwrap());
        let [kept, own_file] = [own.join("undo/1").join(&name), dir.path().join(&name)];
        for path in [kept, own_file].into_iter().filter(|path| path.exists()) {
            fs::File::options().append(true).open(path).unwrap().set_modified(time).unwrap();
        }
        if let Some(header) = file.get_mut("header") {
            header["inode"] = fs::metadata(dir.path().join(&name)).unwrap().ino().into();
        }
    }
    fs::write(&journal, serde_json::to_vec_pretty(&written).unwrap()).unwrap();
    dir
}

fn copy_tree(from: &Path, to: &Path) {
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            fs::create_dir_all(&target).unwrap();
            copy_tree(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}

fn doctor(args: &[&str], dir: &Path) -> Output {
    program().args(args).arg(dir).output().unwrap()
}

#[track_caller]
fn ends_with(output: &Output, code: i32) -> String {
    let text = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "{text}");
    text
}

/// Every file of a directory but hidden ones, with its bytes.
fn contents(dir: &Path) -> Vec<(String, Vec<u8>)> {
    let own = files(dir, "").into_iter().map(|path| (path.strip_prefix(dir).unwrap().to_owned(), path));
    let own = own.map(|(name, path)| (name.to_string_lossy().into_owned(), fs::read(path).unwrap()));
    own.filter(|(name, _)| !name.starts_with('.')).collect()
}

#[test]
fn a_repair_of_an_earlier_revision_is_undone_by_who_knows_it() {
    for (repaired, before) in [("repaired", "before"), ("header", "header-before")] {
        let dir = left(repaired);
        let found = contents(dir.path());
        let refused = ends_with(&doctor(&["undo"], dir.path()), 2);
        assert!(refused.contains("--adopt-journal"), "{repaired}: {refused}");
        assert!(contents(dir.path()) == found, "{repaired}: a refusal changes nothing");
        ends_with(&doctor(&["undo", "--adopt-journal"], dir.path()), 0);
        assert!(contents(dir.path()) == contents(&fixture(before)), "{repaired}: the files before the repair");
    }
}

/// `config.json` is the repaired one, `generation_config.json` is not yet.
#[test]
fn an_interrupted_repair_of_an_earlier_revision_is_finished_or_rolled_back() {
    let dir = left("interrupted");
    let found = contents(dir.path());
    let report = ends_with(&doctor(&["check"], dir.path()), 1);
    assert!(report.contains("FIL015"), "{report}");
    let refused = ends_with(&doctor(&["check", "--fix"], dir.path()), 2);
    assert!(refused.contains("--adopt-journal"), "{refused}");
    assert!(contents(dir.path()) == found, "a refusal changes nothing");
    ends_with(&doctor(&["check", "--fix", "--adopt-journal"], dir.path()), 0);
    assert!(contents(dir.path()) == contents(&fixture("repaired")), "finished");

    let dir = left("interrupted");
    ends_with(&doctor(&["undo", "--adopt-journal"], dir.path()), 0);
    assert!(contents(dir.path()) == contents(&fixture("before")), "rolled back");
}

#[test]
fn a_merge_of_an_earlier_revision_is_verified() {
    let (merged, body, words) = (fixture("merge/merged"), fixture("merge/body"), fixture("merge/words"));
    let alone = ends_with(&doctor(&["verify"], &merged), 2);
    assert!(alone.contains("tensors: 12 equal"), "{alone}");
    let donors = [format!("body={}", body.display()), format!("words={}", words.display())];
    let with_donors = ["verify", "--donor", &donors[0], "--donor", &donors[1]];
    let both = ends_with(&doctor(&with_donors, &merged), 2);
    assert!(both.contains("tensors recomputed from donor body: 11 equal"), "{both}");
    assert!(both.contains("tensors recomputed from donor words: 1 equal"), "{both}");
    assert!(both.contains("does not say which tensors the recipe"), "{both}");

    let dir = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    copy(&merged, dir.path());
    let weights = dir.path().join("model.safetensors");
    let mut bytes = fs::read(&weights).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&weights, bytes).unwrap();
    ends_with(&doctor(&with_donors, dir.path()), 1);
}

/// The recipe of that merge, which a user wrote, gives the same tensors today.
#[test]
fn a_recipe_for_an_earlier_revision_gives_the_same_weights() {
    let dir = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let out = dir.path().join("merged");
    let donors = ["body", "words"].map(|role| format!("{role}={}", fixture("merge").join(role).display()));
    let mut merge = program();
    merge.args(["build-merged", "--donor", &donors[0], "--donor", &donors[1], "--recipe"]);
    let output = merge.arg(fixture("merge/recipe.json5")).arg("--out").arg(&out).output().unwrap();
    ends_with(&output, 0);
    for name in ["model.safetensors", "config.json"] {
        assert!(fs::read(out.join(name)).unwrap() == fs::read(fixture("merge/merged").join(name)).unwrap(), "{name}");
    }
}

/// The settings have every key of that revision, a rule of the user, and a baseline, which accept all findings.
#[test]
fn settings_rules_and_a_baseline_of_an_earlier_revision_are_read() {
    let dir = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    copy_tree(&fixture(""), dir.path());
    let mut check = program();
    check.current_dir(dir.path()).args(["check", "before", "--config", "ckpt-doctor.json5", "--output-format", "json"]);
    let output = check.output().unwrap();
    ends_with(&output, 0);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["summary"]["suppressed"], 3, "two of the baseline and one of the settings");
    assert_eq!(report["summary"]["counts"], serde_json::json!({ "error": 0, "warning": 0, "info": 0 }));
}

/// What a newer version wrote is refused with its number.
#[test]
fn a_document_of_a_newer_version_is_refused_by_its_number() {
    let dir = left("repaired");
    let journal = dir.path().join(".ckpt-doctor/undo/1.json");
    let text = fs::read_to_string(&journal).unwrap();
    fs::write(&journal, text.replace("\"version\": 2", "\"version\": 99")).unwrap();
    let refused = ends_with(&doctor(&["undo", "--adopt-journal"], dir.path()), 2);
    assert!(refused.contains("99"), "{refused}");

    let dir = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    copy_tree(&fixture(""), dir.path());
    let merged = dir.path().join("merge/merged");
    let manifest = merged.join("merge-manifest.json");
    let text = fs::read_to_string(&manifest).unwrap();
    fs::write(&manifest, text.replace("\"schema\": 3", "\"schema\": 99")).unwrap();
    let refused = ends_with(&doctor(&["verify"], &merged), 2);
    assert!(refused.contains("its schema is 99"), "{refused}");

    let baseline = dir.path().join("baseline.json");
    let text = fs::read_to_string(&baseline).unwrap();
    fs::write(&baseline, text.replace("\"schema\": 1", "\"schema\": 99")).unwrap();
    let given = ["check", "--baseline", baseline.to_str().unwrap()];
    let refused = ends_with(&doctor(&given, &dir.path().join("before")), 2);
    assert!(refused.contains("baseline version 99"), "{refused}");
}
