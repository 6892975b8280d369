//! Repairs that are interrupted or refused, and repaired copies.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ckpt_doctor::check::check;
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::checkpoint::journal::{InodeIdentity, Journal};
use ckpt_doctor::surgery::repair::{Content, Repair, plan};
use ckpt_doctor::surgery::{FileChange, Recovered, RepairError, Trust, journal, overlay};
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

use super::seen;
use crate::support;

/// A checkpoint with one file to change and one to add.
fn broken() -> (TempDir, PathBuf) {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let changes =
        r#"[{ encode: { file: "config.json", to: "utf-8-bom" } }, { remove: "model.safetensors.index.json" }]"#;
    let dir = support::made("llama-sharded", changes, room.path());
    (room, dir)
}

fn repair(dir: &Path) -> Repair {
    let knowledge = support::knowledge();
    let checkpoint = Arc::new(Checkpoint::open(dir).expect("a directory"));
    let outcome = check(&checkpoint, &knowledge);
    let repair = plan(&checkpoint, outcome, false, &|c| check(c, &knowledge));
    let names: Vec<&str> = repair.changes.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["config.json", "model.safetensors.index.json"]);
    repair
}

/// Name and content of every file, except hidden ones.
fn contents(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    seen(dir).into_iter().filter(|(name, _)| !name.starts_with('.')).map(|(name, seen)| (name, seen.3)).collect()
}

/// Writes a changed journal with a new authenticator, as if the repair had been begun in the folder of the journal.
fn sign_again(path: &Path, change: impl FnOnce(&mut Journal)) {
    let folder = path.ancestors().find(|folder| folder.ends_with(".ckpt-doctor")).expect("a folder");
    let mut journal: Journal = serde_json::from_slice(&fs::read(path).expect("a journal")).expect("a journal");
    journal.folder = Some(InodeIdentity::of(folder).expect("a folder"));
    change(&mut journal);
    let key = journal::key(&support::user(), folder).expect("a key");
    fs::write(path, serde_json::to_vec(&journal.signed(&key)).expect("JSON")).expect("a journal");
}

fn adopting() -> Trust {
    Trust { adopts: true, ..support::own() }
}

/// Every state that a killed run can leave, and the result of the recovery.
#[test]
fn an_interrupted_repair_is_finished_or_rolled_back() {
    let (_room, dir) = broken();
    let before = contents(&dir);
    let repair = repair(&dir);
    journal::write(&repair, &support::user(), &|_| {}).expect("written");
    let after = contents(&dir);
    assert_ne!(before, after);
    let folder = dir.join(".ckpt-doctor");
    let filed = fs::read(folder.join("undo/1.json")).expect("a journal");
    journal::undo(&dir, &support::own()).expect("undone");
    assert_eq!(contents(&dir), before);
    assert!(!folder.exists());

    for step in 0..=7 {
        for damaged in [false, true] {
            // 0: staged, no journal. 1: the journal. 2: the original linked. 3, 4: each file replaced. 5: the journal
            // archived. 6: the staging folder removed. 7: unchanged.
            let staging = folder.join("new");
            if step < 7 {
                fs::create_dir_all(&staging).expect("a folder");
                for name in ["config.json", "model.safetensors.index.json"] {
                    fs::write(staging.join(name), &after[name]).expect("a file");
                }
            }
            if (1..7).contains(&step) {
                fs::write(folder.join("journal.json"), &filed).expect("a journal");
                sign_again(&folder.join("journal.json"), |_| {});
            }
            if (2..7).contains(&step) {
                fs::create_dir_all(folder.join("undo/1")).expect("a folder");
                fs::hard_link(dir.join("config.json"), folder.join("undo/1/config.json")).expect("a link");
            }
            if (3..7).contains(&step) {
                fs::rename(staging.join("config.json"), dir.join("config.json")).expect("a rename");
            }
            if (4..7).contains(&step) {
                let name = "model.safetensors.index.json";
                fs::rename(staging.join(name), dir.join(name)).expect("a rename");
            }
            if (5..7).contains(&step) {
                fs::rename(folder.join("journal.json"), folder.join("undo/1.json")).expect("a rename");
            }
            if step == 6 {
                fs::remove_dir_all(&staging).expect("removed");
            }
            // A truncated staged file cannot be used.
            let cut = staging.join("model.safetensors.index.json");
            let damaged = damaged && cut.exists();
            if damaged {
                fs::write(&cut, "{").expect("a file");
            }

            let found = support::look(&dir, false, &support::knowledge()).findings;
            assert!(found.iter().all(|f| f.code != "FIL015"), "{found:?}");
            assert_eq!(found.iter().any(|f| f.code == "FIL010"), (1..5).contains(&step), "step {step}");
            let recovery = journal::recover(&dir, &support::own()).expect("recovered");
            let recovered = recovery.outcome;
            let listed: Vec<_> = recovery.files.iter().map(|(change, name)| (*change, name.as_str())).collect();
            match recovered {
                Some(Recovered::Finished) => assert_eq!(
                    listed,
                    [(FileChange::Replaced, "config.json"), (FileChange::Added, "model.safetensors.index.json")]
                ),
                Some(Recovered::RolledBack) if step == 3 => assert_eq!(listed, [(FileChange::Restored, "config.json")]),
                _ => assert_eq!(listed, []),
            }
            let (outcome, files) = match step {
                1..=3 if damaged => (Some(Recovered::RolledBack), &before),
                1..=4 => (Some(Recovered::Finished), &after),
                5 | 6 => (None, &after),
                _ => (None, &before),
            };
            assert_eq!((recovered, &contents(&dir)), (outcome, files), "step {step}, damaged: {damaged}");
            if files == &after {
                journal::undo(&dir, &support::own()).expect("undone");
            }
            assert_eq!(contents(&dir), before, "step {step}");
            assert!(!folder.exists(), "step {step}: the folder is left behind");
        }
    }
}

/// Every state that a killed undo can leave, with and without `RENAME_EXCHANGE`.
#[test]
fn an_interrupted_undo_is_finished() {
    let (_room, dir) = broken();
    let before = contents(&dir);
    let folder = dir.join(".ckpt-doctor");
    let (kept, config, index) = (folder.join("undo/1"), "config.json", "model.safetensors.index.json");
    for step in 0..=4 {
        for exchanged in [false, true] {
            journal::write(&repair(&dir), &support::user(), &|_| {}).expect("written");
            let after = contents(&dir);
            // 0: the journal is current again. 1: the original restored. 2: the added file removed. 3: the originals
            // removed. 4: the journal removed.
            fs::rename(folder.join("undo/1.json"), folder.join("journal.json")).expect("a rename");
            if step >= 1 {
                fs::rename(kept.join(config), dir.join(config)).expect("a rename");
                if exchanged {
                    fs::write(kept.join(config), &after[config]).expect("a file");
                }
            }
            if step >= 2 {
                fs::rename(dir.join(index), kept.join(index)).expect("a rename");
                if !exchanged {
                    fs::remove_file(kept.join(index)).expect("removed");
                }
            }
            if step >= 3 {
                fs::remove_dir_all(&kept).expect("removed");
            }
            if step >= 4 {
                fs::remove_file(folder.join("journal.json")).expect("removed");
            }
            let recovered = journal::recover(&dir, &support::own()).expect("recovered").outcome;
            let (outcome, files) = match step {
                0 => (Some(Recovered::Finished), &after),
                1..=3 => (Some(Recovered::RolledBack), &before),
                _ => (None, &before),
            };
            assert_eq!((recovered, &contents(&dir)), (outcome, files), "step {step}, {exchanged}");
            if step == 0 {
                journal::undo(&dir, &support::own()).expect("undone");
            }
            assert_eq!(contents(&dir), before, "step {step}, {exchanged}");
            assert!(!folder.exists(), "step {step}, {exchanged}: the folder is left behind");
        }
    }
}

/// A shard whose header lacks its metadata, and has room for it.
fn without_metadata() -> (TempDir, PathBuf, PathBuf) {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let dir = support::made("llama-sharded", "[]", room.path());
    let path = dir.join("model-00001-of-00002.safetensors");
    drop_metadata(&path);
    (room, dir, path)
}

/// Replaces the metadata of a shard by spaces, so that the header that has them again is written in place.
pub(super) fn drop_metadata(path: &Path) {
    let bytes = fs::read(path).expect("a shard");
    let at = 8 + usize::try_from(u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"))).expect("a length");
    let text = std::str::from_utf8(&bytes[8..at]).expect("text");
    let bare = text.replace(r#""__metadata__":{"format":"pt"},"#, "");
    assert_ne!(bare, text);
    fs::write(path, [&bytes[..8], format!("{bare:width$}", width = text.len()).as_bytes(), &bytes[at..]].concat())
        .expect("a shard");
}

fn fix(dir: &Path) {
    let knowledge = support::knowledge();
    let checkpoint = Arc::new(Checkpoint::open(dir).expect("a directory"));
    let repair = plan(&checkpoint, check(&checkpoint, &knowledge), false, &|c| check(c, &knowledge));
    journal::write(&repair, &support::user(), &|_| {}).expect("written");
}

#[test]
fn a_header_is_edited_in_place() {
    let (_room, dir, path) = without_metadata();
    let (before, inode) = (seen(&dir), fs::metadata(&path).expect("a shard").ino());
    fix(&dir);
    assert_eq!(fs::metadata(&path).expect("a shard").ino(), inode, "the shard was not written anew");
    let (after, folder) = (seen(&dir), dir.join(".ckpt-doctor"));
    let name = "model-00001-of-00002.safetensors";
    let (old, new) = (&before[name].3, &after[name].3);
    assert!(old.len() == new.len() && old != new);
    let journal: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.join("undo/1.json")).expect("a journal")).expect("JSON");
    let header = 8 + usize::try_from(u64::from_le_bytes(new[..8].try_into().expect("eight bytes"))).expect("a length");
    let digest = ckpt_doctor::checkpoint::hex(&Sha256::digest(&new[..header]));
    assert_eq!(journal["files"][0]["new"], serde_json::json!({ "len": new.len(), "sha256": digest }));
    assert!(fs::metadata(folder.join("undo/1").join(name)).expect("both headers").len() < old.len() as u64);
    journal::undo(&dir, &support::own()).expect("undone");
    assert_eq!(seen(&dir), before);

    // Each state that a killed repair or undo can leave: the journal is current, and the shard has the old header, the new
    // one, or parts of both.
    let torn = [&new[..100], &old[100..]].concat();
    for (bytes, outcome) in [(old, Recovered::RolledBack), (&torn, Recovered::RolledBack), (new, Recovered::Finished)] {
        fix(&dir);
        fs::rename(folder.join("undo/1.json"), folder.join("journal.json")).expect("a rename");
        fs::write(&path, bytes).expect("a shard");
        assert_eq!(journal::recover(&dir, &support::own()).expect("recovered").outcome, Some(outcome));
        if outcome == Recovered::Finished {
            journal::undo(&dir, &support::own()).expect("undone");
        }
        assert_eq!((&contents(&dir)[name], folder.exists()), (old, false));
    }

    // Another program saved the shard: under another inode it was never edited, under the same one nobody knows.
    for is_replaced in [true, false] {
        fix(&dir);
        fs::rename(folder.join("undo/1.json"), folder.join("journal.json")).expect("a rename");
        let saved = [&old[..], b"more"].concat();
        if is_replaced {
            fs::write(dir.join("new"), &saved).expect("a file");
            fs::rename(dir.join("new"), &path).expect("a rename");
            assert_eq!(
                journal::recover(&dir, &support::own()).expect("recovered").outcome,
                Some(Recovered::RolledBack)
            );
        } else {
            fs::write(&path, &saved).expect("a file");
            let error = journal::recover(&dir, &support::own()).expect_err("refused");
            assert!(matches!(error, RepairError::ChangedSinceRepair { .. }), "{error}");
        }
        assert_eq!(contents(&dir)[name], saved);
        fs::write(&path, old).expect("a file");
    }
}

/// A journal may come with a download.
#[test]
fn headers_that_do_not_fit_the_journal_are_not_written() {
    let (_room, dir, path) = without_metadata();
    fix(&dir);
    let folder = dir.join(".ckpt-doctor");
    let kept = folder.join("undo/1").join(path.file_name().expect("a name"));
    let (journal, headers) = (folder.join("undo/1.json"), fs::read(&kept).expect("both headers"));
    let text = fs::read_to_string(&journal).expect("a journal");
    let after = contents(&dir);
    let mut others = headers.clone();
    others[20] ^= 1;
    let harms: [(&str, &dyn Fn()); 6] = [
        ("changed since", &|| fs::write(&kept, &headers[1..]).expect("a file")),
        ("changed since", &|| fs::remove_file(&kept).expect("removed")),
        ("the two headers", &|| fs::write(&kept, &others).expect("a file")),
        ("not that of your key", &|| {
            fs::write(&journal, text.replace(r#""old_len": "#, r#""old_len": 9"#)).expect("a journal");
        }),
        ("changed since", &|| {
            sign_again(&journal, |journal| journal.files[0].header.as_mut().expect("an edit").old_len += 8);
        }),
        ("version 4", &|| fs::write(&journal, text.replace(r#""version": 3"#, r#""version": 4"#)).expect("a journal")),
    ];
    for (word, harm) in harms {
        harm();
        let error = journal::undo(&dir, &support::own()).expect_err("refused").to_string();
        assert!(error.contains(word), "{error}");
        assert_eq!(contents(&dir), after);
        fs::write(&kept, &headers).expect("a file");
        fs::write(&journal, &text).expect("a journal");
    }
    fs::rename(&journal, folder.join("journal.json")).expect("a rename");
    fs::write(&kept, &headers[1..]).expect("a file");
    let error = journal::recover(&dir, &support::own()).expect_err("refused");
    assert!(matches!(error, RepairError::UnusableJournal { .. }), "{error}");
    assert_eq!(contents(&dir), after);
}

/// Another program saved a file between the link to the original and the exchange, and the run was killed before it could
/// exchange the files back.
#[test]
fn a_file_saved_during_an_interrupted_repair_is_returned_to_those_who_vouch_for_it() {
    let (_room, dir) = broken();
    journal::write(&repair(&dir), &support::user(), &|_| {}).expect("written");
    let folder = dir.join(".ckpt-doctor");
    fs::rename(folder.join("undo/1.json"), folder.join("journal.json")).expect("a rename");
    fs::create_dir(folder.join("new")).expect("a folder");
    fs::write(folder.join("new/config.json"), "saved").expect("a file");
    let after = contents(&dir);
    // Somebody else may have put it there.
    let error = journal::recover(&dir, &support::own()).expect_err("refused");
    assert!(matches!(&error, RepairError::Unaccounted { path } if path.ends_with("new/config.json")), "{error}");
    assert_eq!(contents(&dir), after);
    let recovery = journal::recover(&dir, &adopting()).expect("recovered");
    assert_eq!(recovery.outcome, Some(Recovered::RolledBack));
    assert_eq!(recovery.files[0], (FileChange::Returned, "config.json".to_owned()));
    assert_eq!(fs::read_to_string(dir.join("config.json")).expect("a file"), "saved");
    assert!(!folder.exists());
}

/// What stays when the removal of the last temporary files failed.
#[test]
fn an_empty_folder_is_removed_by_the_next_run() {
    let (_room, dir) = broken();
    let folder = dir.join(".ckpt-doctor");
    for names in
        [&[][..], &["lock"], &[".gitignore", "lock"], &[".gitignore", "lock", "undo/"], &["new/"], &["undo/1/"]]
    {
        fs::create_dir(&folder).expect("a folder");
        for name in names {
            match name.strip_suffix('/') {
                Some(name) => fs::create_dir_all(folder.join(name)).expect("a folder"),
                None => fs::write(folder.join(name), "").expect("a file"),
            }
        }
        assert_eq!(journal::recover(&dir, &support::own()).expect("recovered").outcome, None);
        assert!(!folder.exists(), "{names:?}");
    }
    fs::create_dir(&folder).expect("a folder");
    fs::write(folder.join("notes"), "mine").expect("a file");
    journal::recover(&dir, &support::own()).expect("recovered");
    assert_eq!(seen(&folder).into_keys().collect::<Vec<_>>(), ["notes"]);
}

/// Repairs of ckpt-doctor 0.1 before headers were edited in place, and before journals had an authenticator.
#[test]
fn a_repair_with_an_old_journal_is_undone_for_those_who_vouch_for_it() {
    let (_room, dir) = broken();
    let before = contents(&dir);
    journal::write(&repair(&dir), &support::user(), &|_| {}).expect("written");
    let path = dir.join(".ckpt-doctor/undo/1.json");
    let mut journal: Journal = serde_json::from_slice(&fs::read(&path).expect("a journal")).expect("a journal");
    (journal.version, journal.folder, journal.authenticator) = (1, None, None);
    journal.files.iter_mut().filter_map(|file| file.old.as_mut()).for_each(|old| old.identity = None);
    let text = serde_json::to_string(&journal).expect("JSON");
    assert!(!text.contains("header") && !text.contains("identity"), "{text}");
    fs::write(&path, text).expect("a journal");
    let error = journal::undo(&dir, &support::own()).expect_err("refused");
    assert!(matches!(error, RepairError::ForeignJournal { .. }), "{error}");
    journal::undo(&dir, &adopting()).expect("undone");
    assert_eq!(contents(&dir), before);
}

#[test]
fn files_changed_after_a_repair_are_not_restored() {
    let (_room, dir) = broken();
    journal::write(&repair(&dir), &support::user(), &|_| {}).expect("written");
    fs::write(dir.join("config.json"), "{}").expect("a file");
    let now = contents(&dir);
    let error = journal::undo(&dir, &support::own()).expect_err("refused");
    assert!(matches!(&error, RepairError::ChangedSinceRepair { path, .. } if path.ends_with("config.json")), "{error}");
    assert!(error.to_string().contains(".ckpt-doctor/undo/1"), "{error}");
    assert_eq!(contents(&dir), now);
}

#[test]
fn a_file_that_changes_during_planning_stops_the_repair() {
    let (_room, dir) = broken();
    let repair = repair(&dir);
    fs::write(dir.join("config.json"), "{}").expect("a file");
    let now = contents(&dir);
    assert!(matches!(journal::write(&repair, &support::user(), &|_| {}), Err(RepairError::ChangedWhilePlanned { .. })));
    assert_eq!(contents(&dir), now);
    assert!(!dir.join(".ckpt-doctor").exists());
}

#[test]
fn an_edit_that_changes_nothing_is_an_error_of_the_program() {
    let (_owner, dir) = broken();
    let mut repair = repair(&dir);
    let before = contents(&dir);
    repair.changes.retain(|change| change.name == "config.json");
    let text = fs::read_to_string(dir.join("config.json")).expect("text");
    repair.changes[0].new = Content::Text(text.into());
    assert!(matches!(journal::write(&repair, &support::user(), &|_| {}), Err(RepairError::ChangesNothing { .. })));
    assert_eq!(contents(&dir), before);
}

#[test]
fn mode_is_kept_and_the_last_repair_is_undone_first() {
    let (_room, dir) = broken();
    fs::set_permissions(dir.join("config.json"), PermissionsExt::from_mode(0o640)).expect("a mode");
    let before = seen(&dir);
    journal::write(&repair(&dir), &support::user(), &|_| {}).expect("written");
    assert_eq!(fs::metadata(dir.join("config.json")).expect("a file").mode() & 0o7777, 0o640);
    assert_eq!(fs::read_to_string(dir.join(".ckpt-doctor/.gitignore")).expect("a file").lines().last(), Some("*"));
    let between = contents(&dir);
    let text = fs::read(dir.join("config.json")).expect("a file");
    fs::write(dir.join("config.json"), [b"\xef\xbb\xbf", &*text].concat()).expect("a file");
    let knowledge = support::knowledge();
    let checkpoint = Arc::new(Checkpoint::open(&dir).expect("a directory"));
    let second = plan(&checkpoint, check(&checkpoint, &knowledge), false, &|c| check(c, &knowledge));
    journal::write(&second, &support::user(), &|_| {}).expect("written");
    assert_eq!(contents(&dir), between);
    assert_eq!(journal::undo(&dir, &support::own()).expect("undone").left, 1);
    fs::write(dir.join("config.json"), &text).expect("a file");
    assert_eq!(journal::undo(&dir, &support::own()).expect("undone").left, 0);
    assert_eq!(seen(&dir), before);
    assert!(matches!(journal::undo(&dir, &support::own()), Err(RepairError::NothingToUndo { .. })));
}

#[test]
fn links_are_never_written_through() {
    let (room, dir) = broken();
    let blobs = room.path().join("blobs");
    fs::create_dir(&blobs).expect("a folder");
    let blob = blobs.join("0123456789abcdef0123456789abcdef01234567");
    fs::rename(dir.join("config.json"), &blob).expect("a rename");
    symlink(&blob, dir.join("config.json")).expect("a link");
    let bytes = fs::read(&blob).expect("a file");
    let repair = repair(&dir);
    let error = journal::write(&repair, &support::user(), &|_| {}).expect_err("refused");
    assert!(error.to_string().contains("--fix --output DIR"), "{error}");
    assert!(!dir.join(".ckpt-doctor").exists());
    let out = room.path().join("repaired");
    overlay(&repair, &out, &|_| {}).expect("a copy");
    assert_eq!(fs::read(&blob).expect("a file"), bytes);
    assert!(fs::symlink_metadata(out.join("config.json")).expect("a file").is_file());
}

#[test]
fn a_copy_leaves_the_original_alone() {
    let (room, dir) = broken();
    let before = seen(&dir);
    let repair = repair(&dir);
    let out = room.path().join("repaired");
    overlay(&repair, &out, &|_| {}).expect("a copy");
    assert_eq!(seen(&dir), before);
    let found = check(&Arc::new(Checkpoint::open(&out).expect("open")), &support::knowledge()).findings;
    assert_eq!(found, repair.outcome.findings);
    let shard = "model-00001-of-00002.safetensors";
    let inode = |dir: &Path| fs::metadata(dir.join(shard)).expect("a shard").ino();
    assert_eq!(inode(&out), inode(&dir), "an unchanged shard is a link");
    for target in [dir.clone(), dir.join("inside")] {
        assert!(overlay(&repair, &target, &|_| {}).is_err(), "{}", target.display());
    }
}
