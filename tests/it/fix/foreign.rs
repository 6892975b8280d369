//! Journals of others: those that came with a download, with a copy, or from another user, and those that were changed.

use std::collections::BTreeMap;
use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, symlink};
use std::path::{Path, PathBuf};
use std::process::Command;

use ckpt_doctor::checkpoint::journal::{Journal, StateFolder};
use ckpt_doctor::surgery::{Recovered, RepairError, Trust, journal};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

use crate::support;

const INDEX: &str = "model.safetensors.index.json";
const SHARD: &str = "model-00001-of-00002.safetensors";

/// A checkpoint `model` of which one file is replaced, one is added, and a header is edited in place.
fn broken() -> (TempDir, PathBuf) {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let changes =
        r#"[{ encode: { file: "config.json", to: "utf-8-bom" } }, { remove: "model.safetensors.index.json" }]"#;
    let made = support::made("llama-sharded", changes, room.path());
    let model = room.path().join("model");
    fs::rename(made, &model).expect("a rename");
    super::journal::drop_metadata(&model.join(SHARD));
    (room, model)
}

/// Every file below a directory, but for the lock.
fn tree(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let files = support::files(dir, "").into_iter().filter(|path| !path.ends_with(".ckpt-doctor/lock"));
    files.map(|path| (path.clone(), fs::read(path).expect("a file"))).collect()
}

/// The files of a checkpoint itself.
fn own_files(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    tree(dir).into_iter().filter(|(path, _)| !path.starts_with(dir.join(".ckpt-doctor"))).collect()
}

fn run(command: &mut Command) -> (Option<i32>, String) {
    let output = command.output().expect("the program");
    let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).expect("text")).concat();
    (output.status.code(), text)
}

fn doctor(room: &Path, args: &[&str]) -> (Option<i32>, String) {
    run(support::program().args(args).current_dir(room))
}

/// Repairs the checkpoint, and takes it back to the moment after the journal was written: nothing is replaced yet.
fn interrupted(model: &Path) {
    let folder = model.join(".ckpt-doctor");
    let shard = fs::read(model.join(SHARD)).expect("a shard");
    let (code, text) = doctor(model, &["check", ".", "--fix-only"]);
    assert_eq!(code, Some(0), "{text}");
    fs::rename(folder.join("undo/1.json"), folder.join("journal.json")).expect("a rename");
    fs::create_dir(folder.join("new")).expect("a folder");
    for name in ["config.json", INDEX] {
        fs::rename(model.join(name), folder.join("new").join(name)).expect("a rename");
    }
    fs::rename(folder.join("undo/1/config.json"), model.join("config.json")).expect("a rename");
    // The header is edited before files are replaced; its edit is the only step that is done.
    assert_ne!(fs::read(model.join(SHARD)).expect("a shard"), shard);
    assert!(folder.join("undo/1").join(SHARD).is_file(), "the header was edited in place");
}

/// Leaves the remains of a repair that puts `evil.py` and an `auto_map` to it into place, as an archive can contain them.
fn plant(model: &Path, version: u32, more: &Value) {
    let folder = model.join(".ckpt-doctor");
    fs::create_dir_all(folder.join("new")).expect("a folder");
    let config = model.join("config.json");
    let old = fs::metadata(&config).expect("a file");
    let text = fs::read_to_string(&config).expect("text");
    let mut value: Value = serde_json::from_str(text.trim_start_matches('\u{feff}')).expect("JSON");
    value["auto_map"] = json!({ "AutoModelForCausalLM": "evil.Model" });
    let mut files = Vec::new();
    for (name, bytes, old) in [
        ("evil.py", b"class Model: pass\n".to_vec(), Value::Null),
        (
            "config.json",
            serde_json::to_vec(&value).expect("JSON"),
            json!({ "len": old.len(), "mtime": [old.mtime(), old.mtime_nsec()], "mode": old.mode() & 0o7777 }),
        ),
    ] {
        fs::write(folder.join("new").join(name), &bytes).expect("a file");
        let sha256 = ckpt_doctor::checkpoint::hex(&Sha256::digest(&bytes));
        files.push(json!({ "name": name, "old": old, "new": { "len": bytes.len(), "sha256": sha256 } }));
    }
    let mut journal = json!({ "version": version, "number": 1, "files": files });
    journal.as_object_mut().expect("an object").extend(more.as_object().expect("an object").clone());
    fs::write(folder.join("journal.json"), journal.to_string()).expect("a file");
}

#[test]
fn a_journal_of_a_download_is_reported_and_not_carried_out() {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let made = support::made("llama-sharded", "[]", room.path());
    let model = room.path().join("model");
    fs::rename(made, &model).expect("a rename");
    let sound = own_files(&model);
    plant(&model, 2, &json!({}));
    let mut session = String::new();
    let mut doctor = |args: &[&str]| {
        let (code, text) = doctor(room.path(), args);
        session.push_str(&format!("$ ckpt-doctor {}\n{text}exit code {}\n\n", args.join(" "), code.expect("a code")));
    };
    doctor(&["check", "model"]);
    doctor(&["check", "model", "--fix"]);
    doctor(&["check", "model", "--diff"]);
    doctor(&["undo", "model"]);
    assert_eq!(own_files(&model), sound);
    doctor(&["check", "model", "--fix", "--output", "repaired", "--output-format", "concise"]);
    assert!(!room.path().join("repaired/evil.py").exists());
    doctor(&["check", "model", "--adopt-journal"]);
    assert_eq!(own_files(&model), sound);
    doctor(&["check", "model", "--fix", "--adopt-journal", "--output-format", "concise"]);
    assert!(model.join("evil.py").is_file());
    // Adopting made it the user's own.
    doctor(&["undo", "model"]);
    assert_eq!(own_files(&model), sound);
    snapshot!("fix-foreign-journal", session);
}

/// A journal with whatever else its author may write, and the journal of a repair that seems to be finished.
#[test]
fn no_form_of_a_planted_journal_is_carried_out() {
    let forms = [
        (1, json!({})),
        (3, json!({})),
        (3, json!({ "authenticator": "0".repeat(64) })),
        (3, json!({ "folder": { "inode": 1 }, "authenticator": "" })),
        (3, json!({ "folder": { "inode": 1, "created": [1, 1] }, "authenticator": "0".repeat(64) })),
    ];
    for (version, more) in forms {
        for is_finished in [false, true] {
            let (room, model) = broken();
            plant(&model, version, &more);
            let folder = model.join(".ckpt-doctor");
            if is_finished {
                // `undo` would exchange `evil.py` for the file of the checkpoint.
                fs::create_dir(folder.join("undo")).expect("a folder");
                fs::rename(folder.join("new"), folder.join("undo/1")).expect("a rename");
                fs::rename(folder.join("journal.json"), folder.join("undo/1.json")).expect("a rename");
            }
            let before = own_files(&model);
            let error = journal::undo(&model, &support::own()).expect_err("refused");
            assert!(matches!(error, RepairError::ForeignJournal { .. }), "{error}");
            if !is_finished {
                let error = journal::recover(&model, &support::own()).expect_err("refused");
                assert!(matches!(error, RepairError::ForeignJournal { .. }), "{error}");
            }
            assert_eq!(own_files(&model), before);
            drop(room);
        }
    }
}

/// A link in place of a folder would let a repair move and remove files outside the checkpoint.
#[test]
fn a_link_or_a_file_in_place_of_a_folder_is_refused() {
    for place in [".ckpt-doctor", ".ckpt-doctor/new", ".ckpt-doctor/undo", ".ckpt-doctor/undo/1"] {
        for is_link in [true, false] {
            let (room, model) = broken();
            let outside = room.path().join("outside");
            fs::create_dir(&outside).expect("a folder");
            fs::write(outside.join("config.json"), "of others").expect("a file");
            let place = model.join(place);
            fs::create_dir_all(place.parent().expect("a parent")).expect("a folder");
            if is_link {
                symlink(&outside, &place).expect("a link");
            } else {
                fs::write(&place, "").expect("a file");
            }
            let before = tree(room.path());
            for args in [&["check", "model", "--fix"][..], &["undo", "model"]] {
                let (code, text) = doctor(room.path(), args);
                assert!(code == Some(2) && text.contains("it is not a directory"), "{place:?}: {text}");
                assert_eq!(tree(room.path()), before, "{place:?}");
            }
        }
    }
}

/// Whoever vouches for a journal does not vouch for files outside the checkpoint, or for those of the tool.
#[test]
fn an_adopted_journal_names_files_of_the_checkpoint_alone() {
    for name in ["../config.json", "a/config.json", "..", "", ".gitattributes"] {
        let (room, model) = broken();
        plant(&model, 2, &json!({}));
        let path = model.join(".ckpt-doctor/journal.json");
        let mut journal: Value = serde_json::from_slice(&fs::read(&path).expect("a file")).expect("JSON");
        journal["files"][0]["name"] = json!(name);
        fs::write(&path, journal.to_string()).expect("a file");
        let before = tree(room.path());
        let (code, text) = doctor(room.path(), &["check", "model", "--fix", "--adopt-journal"]);
        assert!(code == Some(2) && text.contains("is not a plain file name"), "{name}: {text}");
        assert_eq!(tree(room.path()), before, "{name}");
    }
}

#[test]
fn a_donor_with_a_journal_of_others_is_refused() {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    for name in ["spatialvla-tiny", "llava3d-tiny"] {
        support::copy(&support::project().join("fixtures/donors").join(name), &room.path().join(name));
    }
    let args = ["build-merged", "--vision", "spatialvla-tiny", "--language", "llava3d-tiny", "--out", "merged"];
    plant(&room.path().join("llava3d-tiny"), 2, &json!({}));
    let before = tree(room.path());
    let (code, text) = doctor(room.path(), &args);
    assert!(code == Some(2) && text.contains("FIL015"), "{text}");
    assert_eq!(tree(room.path()), before);
    fs::remove_dir_all(room.path().join("llava3d-tiny/.ckpt-doctor")).expect("removed");
    let (code, text) = doctor(room.path(), &args);
    assert_eq!(code, Some(0), "{text}");
}

/// A renamed directory is the same; a copy of it, and a journal in another folder, are others.
#[test]
fn a_journal_is_carried_out_in_its_own_directory() {
    let (room, model) = broken();
    interrupted(&model);
    let copy = room.path().join("copy");
    let copied = Command::new("cp").arg("-a").arg(&model).arg(&copy).status().expect("cp");
    assert!(copied.success());
    let before = tree(&copy);
    for error in [
        journal::recover(&copy, &support::own()).expect_err("refused"),
        journal::undo(&copy, &support::own()).expect_err("refused"),
    ] {
        assert!(error.to_string().contains("written in another directory"), "{error}");
    }
    assert_eq!(tree(&copy), before);
    let (code, text) = doctor(room.path(), &["check", "copy", "--output-format", "concise"]);
    assert!(code == Some(1) && text.contains("FIL015") && text.contains("another directory"), "{text}");

    // The folder of another repair, with the journal and the new files of this one.
    let (_other_room, other) = broken();
    let (code, text) = doctor(&other, &["check", ".", "--fix-only"]);
    assert_eq!(code, Some(0), "{text}");
    let (from, to) = (model.join(".ckpt-doctor"), other.join(".ckpt-doctor"));
    fs::copy(from.join("journal.json"), to.join("journal.json")).expect("a copy");
    support::copy(&from.join("new"), &to.join("new"));
    let error = journal::recover(&other, &support::own()).expect_err("refused").to_string();
    assert!(error.contains("written in another directory"), "{error}");

    let moved = room.path().join("folder");
    fs::create_dir(&moved).expect("a folder");
    let moved = moved.join("renamed");
    fs::rename(&model, &moved).expect("a rename");
    let (code, text) = doctor(room.path(), &["check", "folder/renamed", "--fix", "--output-format", "concise"]);
    assert_eq!(code, Some(0), "{text}");
    snapshot!("fix-interrupted", text);
    let (code, text) = doctor(room.path(), &["undo", "folder/renamed"]);
    assert_eq!(code, Some(0), "{text}");

    // Who knows that the copy is their own carries it out.
    let (code, text) = doctor(room.path(), &["undo", "copy", "--adopt-journal"]);
    assert_eq!(code, Some(0), "{text}");
    let names = |files: BTreeMap<PathBuf, Vec<u8>>, dir: &Path| -> BTreeMap<PathBuf, Vec<u8>> {
        files.into_iter().map(|(path, bytes)| (path.strip_prefix(dir).expect("inside").to_owned(), bytes)).collect()
    };
    assert_eq!(names(own_files(&copy), &copy), names(own_files(&moved), &moved));
}

/// The journal with each of its values changed or missing, and with one more value in each list and object.
fn mutants(journal: &Value) -> Vec<(String, Value)> {
    let read = |journal: &Value| serde_json::from_value::<Journal>(journal.clone()).ok();
    let mut mutants = Vec::new();
    let mut pending = vec![String::new()];
    while let Some(at) = pending.pop() {
        let value = journal.pointer(&at).expect("a value");
        let mut others = vec![];
        match value {
            Value::Object(members) => {
                pending.extend(members.keys().map(|key| format!("{at}/{key}")));
                for key in members.keys() {
                    let mut other = members.clone();
                    other.remove(key);
                    others.push(other.into());
                }
                others.push(json!({ "more": 1 }));
                others.push(members.clone().into_iter().chain([("more".to_owned(), json!(1))]).collect());
            }
            Value::Array(items) => {
                pending.extend((0..items.len()).map(|n| format!("{at}/{n}")));
                others.push([&items[..], &items[..1]].concat().into());
                others.push(items[1..].to_vec().into());
                others.push(items.iter().rev().cloned().collect::<Vec<_>>().into());
            }
            Value::Number(n) => others = vec![json!(n.as_i64().expect("a number") + 1), json!(0), Value::Null],
            Value::String(text) => {
                let first = if text.starts_with('0') { "1" } else { "0" };
                others =
                    vec![format!("{first}{}", &text[1..]).into(), "".into(), format!("{text}0").into(), Value::Null];
            }
            _ => others = vec![json!({ "len": 1, "mtime": [0, 0], "mode": 0 }), json!(1)],
        }
        for other in others {
            let mut mutant = journal.clone();
            *mutant.pointer_mut(&at).expect("a value") = other.clone();
            // A missing value is the same as null.
            if read(&mutant).is_none_or(|other| Some(other) != read(journal)) {
                mutants.push((format!("{at}: {other}"), mutant));
            }
        }
    }
    mutants
}

#[test]
fn a_journal_with_any_change_is_not_carried_out() {
    let (_room, model) = broken();
    interrupted(&model);
    let path = model.join(".ckpt-doctor/journal.json");
    let text = fs::read(&path).expect("a journal");
    let before = tree(&model);
    let mutants = mutants(&serde_json::from_slice(&text).expect("JSON"));
    assert!(mutants.len() > 80, "{} mutants", mutants.len());
    for (what, mutant) in mutants {
        fs::write(&path, mutant.to_string()).expect("a journal");
        for error in [
            journal::recover(&model, &support::own()).expect_err(&what),
            journal::undo(&model, &support::own()).expect_err(&what),
        ] {
            let is_refused = matches!(error, RepairError::ForeignJournal { .. } | RepairError::UnusableJournal { .. });
            assert!(is_refused, "{what}: {error}");
        }
        let found = support::look(&model, false, &support::knowledge()).findings;
        assert!(found.iter().any(|f| f.code == "FIL015") && found.iter().all(|f| f.code != "FIL010"), "{what}");
        fs::write(&path, &text).expect("a journal");
        assert_eq!(tree(&model), before, "{what}");
    }
    // The form of the text is free: its values count.
    let value: Value = serde_json::from_slice(&text).expect("JSON");
    fs::write(&path, value.to_string()).expect("a journal");
    let recovery = journal::recover(&model, &support::own()).expect("recovered");
    assert_eq!((recovery.outcome, recovery.files.len()), (Some(Recovered::Finished), 3));
}

/// Whatever is exchanged below an own journal: none of it gets a name in the checkpoint.
#[test]
fn changed_files_of_a_repair_are_not_put_into_place() {
    const EVIL: &[u8] = b"{\"auto_map\": {\"AutoModel\": \"evil.Model\"}}";
    let files = ["new/config.json", "new/model.safetensors.index.json", "undo/1/model-00001-of-00002.safetensors"];
    for name in files {
        // Another content, of another length and of the same one; in place and as a new file.
        for (same_length, in_place) in [(false, true), (false, false), (true, true), (true, false)] {
            let (_room, model) = broken();
            let before = own_files(&model);
            interrupted(&model);
            let after = own_files(&model);
            let path = model.join(".ckpt-doctor").join(name);
            let mut bytes = fs::read(&path).expect("a file");
            if same_length {
                let len = bytes.len();
                bytes[..EVIL.len().min(len)].copy_from_slice(&EVIL[..EVIL.len().min(len)]);
            } else {
                bytes = EVIL.to_vec();
            }
            if !in_place {
                fs::remove_file(&path).expect("removed");
            }
            fs::write(&path, &bytes).expect("a file");
            // A repair whose new files are others is rolled back; without its headers, it stays as it is.
            let now = match journal::recover(&model, &support::own()) {
                Ok(recovery) => {
                    assert_eq!(recovery.outcome, Some(Recovered::RolledBack));
                    &before
                }
                Err(error) => {
                    assert!(matches!(error, RepairError::UnusableJournal { .. }), "{error}");
                    &after
                }
            };
            assert_eq!(own_files(&model), *now, "{name}, {same_length}, {in_place}");
        }
    }
}

#[test]
fn a_changed_original_is_not_restored() {
    for in_place in [true, false] {
        for is_interrupted in [true, false] {
            let (_room, model) = broken();
            let (code, text) = doctor(&model, &["check", ".", "--fix-only"]);
            assert_eq!(code, Some(0), "{text}");
            let folder = model.join(".ckpt-doctor");
            let after = own_files(&model);
            let kept = folder.join("undo/1/config.json");
            let time = fs::metadata(&kept).and_then(|m| m.modified()).expect("a time");
            let mut bytes = fs::read(&kept).expect("a file");
            bytes[5] ^= 1;
            if !in_place {
                fs::remove_file(&kept).expect("removed");
            }
            fs::write(&kept, &bytes).expect("a file");
            if !in_place {
                // An archive keeps times; the inode is another one.
                fs::File::options().write(true).open(&kept).and_then(|f| f.set_modified(time)).expect("a time");
            }
            if is_interrupted {
                // An undo that was killed after it had taken the added file away.
                fs::rename(folder.join("undo/1.json"), folder.join("journal.json")).expect("a rename");
                fs::rename(model.join(INDEX), folder.join("undo/1").join(INDEX)).expect("a rename");
                let error = journal::recover(&model, &support::own()).expect_err("refused");
                assert!(matches!(error, RepairError::Unaccounted { .. }), "{error}");
                fs::rename(folder.join("undo/1").join(INDEX), model.join(INDEX)).expect("a rename");
            } else {
                let error = journal::undo(&model, &support::own()).expect_err("refused");
                assert!(matches!(error, RepairError::ChangedSinceRepair { .. }), "{error}");
            }
            assert_eq!(own_files(&model), after);
        }
    }
}

/// Runs `check --fix-only` on a broken checkpoint with this folder of state; returns the output, the authenticator of the
/// journal, and the checkpoint.
fn repaired_with(state: &Path) -> (String, Value, TempDir) {
    let (room, model) = broken();
    let mut command = support::program();
    command.args(["check", "model", "--fix-only"]).current_dir(room.path()).env("XDG_STATE_HOME", state);
    let (code, text) = run(&mut command);
    assert_eq!(code, Some(0), "{text}");
    let journal = fs::read(model.join(".ckpt-doctor/undo/1.json")).expect("a journal");
    let journal: Value = serde_json::from_slice(&journal).expect("JSON");
    (text, journal["authenticator"].clone(), room)
}

fn mode(path: &Path) -> u32 {
    fs::metadata(path).expect("metadata").mode() & 0o7777
}

#[test]
fn the_key_is_made_once_and_is_of_the_user_alone() {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let state = room.path().join("not/there/yet");
    let (text, authenticator, repaired) = repaired_with(&state);
    assert!(authenticator.is_string() && !text.contains("adopt"), "{text}");
    let folder = state.join("ckpt-doctor");
    assert_eq!((mode(&folder), mode(&folder.join("key"))), (0o700, 0o600));
    assert_eq!(support::files(&room.path().join("not"), ""), [folder.join("key")]);
    let key = fs::read(folder.join("key")).expect("a key");
    assert_eq!(key.len(), 32);
    let (_, other, _room) = repaired_with(&state);
    assert_eq!(fs::read(folder.join("key")).expect("a key"), key);
    assert_ne!(authenticator, other, "of another folder");

    // Another user, and the same one without a key, do not undo the repair; a copy of the key does.
    let model = repaired.path().join("model");
    let elsewhere = TempDir::new_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let of = |folder: PathBuf| Trust { user: StateFolder::at(folder), adopts: false };
    for (trust, why) in
        [(support::own(), "not that of your key"), (of(elsewhere.path().join("none")), "none/key does not exist")]
    {
        let error = journal::undo(&model, &trust).expect_err("refused").to_string();
        assert!(error.contains(why) && error.contains("--adopt-journal") && error.contains("delete"), "{error}");
    }
    journal::undo(&model, &of(folder)).expect("undone");
}

/// Two runs that make the key at once use the same one.
#[test]
fn runs_at_once_have_one_key() {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    for round in 0..20 {
        let folder = room.path().join(round.to_string()).join("ckpt-doctor");
        let user = StateFolder::at(folder.clone());
        let (one, other) = std::thread::scope(|scope| {
            let make = || format!("{:?}", journal::key(&user, Path::new("/nowhere")).map(|_| ()));
            let (one, other) = (scope.spawn(make), scope.spawn(make));
            (one.join().expect("no panic"), other.join().expect("no panic"))
        });
        assert_eq!((one.as_str(), other.as_str()), ("Ok(())", "Ok(())"));
        assert_eq!(support::files(&folder, ""), [folder.join("key")]);
    }
}

/// Makes a key that is not used.
type Harm<'a> = &'a dyn Fn(&Path);

/// A key that others may know or have written is not used. The repair succeeds and says what follows.
#[test]
fn a_key_of_doubtful_origin_is_not_used() {
    let write = |path: &Path, len: usize, mode: u32| {
        fs::write(path, vec![7; len]).expect("a file");
        fs::set_permissions(path, Permissions::from_mode(mode)).expect("a mode");
    };
    let harms: [(&str, Harm); 8] = [
        ("is a symbolic link", &|key| {
            write(&key.with_extension("real"), 32, 0o600);
            symlink(key.with_extension("real"), key).expect("a link");
        }),
        ("its mode is 0644", &|key| write(key, 32, 0o644)),
        ("its mode is 0620", &|key| write(key, 32, 0o620)),
        ("has 31 bytes, not 32", &|key| write(key, 31, 0o600)),
        ("has 0 bytes, not 32", &|key| write(key, 0, 0o600)),
        ("has 33 bytes, not 32", &|key| write(key, 33, 0o600)),
        ("is not a regular file", &|key| fs::create_dir(key).expect("a folder")),
        ("is a symbolic link", &|key| symlink("nowhere", key).expect("a link")),
    ];
    for (why, harm) in harms {
        let state = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
        fs::create_dir(state.path().join("ckpt-doctor")).expect("a folder");
        harm(&state.path().join("ckpt-doctor/key"));
        let (text, authenticator, room) = repaired_with(state.path());
        assert!(text.contains(why) && text.contains("undo --adopt-journal"), "{why}: {text}");
        assert!(authenticator.is_null(), "{why}");
        let undo = |more: &[&str]| {
            let mut command = support::program();
            run(command.args(["undo", "model"]).args(more).current_dir(room.path()).env("XDG_STATE_HOME", state.path()))
        };
        let (code, text) = undo(&[]);
        assert!(code == Some(2) && text.contains("has no authenticator"), "{why}: {text}");
        assert_eq!(undo(&["--adopt-journal"]).0, Some(0), "{why}");
    }
}

/// Without a place for the key, and with one that a checkpoint contains.
#[test]
fn a_repair_needs_no_key() {
    let (room, model) = broken();
    let state = model.join("ckpt-doctor");
    fs::create_dir(&state).expect("a folder");
    fs::write(state.join("key"), [7; 32]).expect("a file");
    fs::set_permissions(state.join("key"), Permissions::from_mode(0o600)).expect("a mode");
    let file = room.path().join("file");
    fs::write(&file, "").expect("a file");
    let places: [(&Path, &str); 4] = [
        (Path::new(""), "neither XDG_STATE_HOME nor HOME is an absolute path"),
        (Path::new("model"), "neither XDG_STATE_HOME nor HOME is an absolute path"),
        (&model, "lies in the checkpoint itself"),
        (&file, "cannot be opened (Not a directory"),
    ];
    for (place, why) in places {
        let doctor = |args: &[&str]| {
            let mut command = support::program();
            command.args(args).current_dir(room.path()).env("XDG_STATE_HOME", place).env_remove("HOME");
            run(&mut command)
        };
        let (code, text) = doctor(&["check", "model", "--fix-only"]);
        assert!(code == Some(0) && text.contains(why), "{}: {text}", place.display());
        let (code, text) = doctor(&["undo", "model", "--adopt-journal"]);
        assert_eq!(code, Some(0), "{}: {text}", place.display());
    }
    let mut command = support::program();
    command.args(["check", "model", "--fix-only"]).current_dir(room.path()).env_remove("XDG_STATE_HOME");
    let (code, text) = run(command.env("HOME", room.path().join("home")));
    assert!(code == Some(0) && !text.contains("adopt"), "{text}");
    assert!(room.path().join("home/.local/state/ckpt-doctor/key").is_file());
}
