//! Writing a merged checkpoint: refused targets, modes, locks, signals.
//!
//! Failing calls, full disks and kills at each system call are tested in `tests/peer/crash.py`.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

use super::{copy, donor, json, names, text, tiny};

/// A merge of the donors in `work`; the fixtures replace missing ones.
fn merge(work: &Path, out: &Path) -> Command {
    let place = |name: &str| if work.join(name).exists() { work.join(name) } else { donor(name) };
    let mut command = crate::support::program();
    command.arg("build-merged").arg("--vision").arg(place("spatialvla-tiny"));
    command.arg("--language").arg(place("llava3d-tiny")).arg("--out").arg(out).current_dir(work);
    command
}

#[test]
fn the_current_directory_is_a_target_when_it_is_empty() {
    let work = TempDir::new().unwrap();
    let here = work.path().join("here");
    fs::create_dir(&here).unwrap();
    let run = merge(&here, Path::new(".")).output().unwrap();
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    assert!(here.join("config.json").is_file());
    assert_eq!(names(work.path()), ["here"]);
}

/// Numbers that no 64 bits hold as they are written, in a document that a merge edits and in one that it grafts.
#[test]
fn numbers_are_written_as_the_donors_spell_them() {
    let work = TempDir::new().unwrap();
    let mut numbers = Vec::new();
    for (name, value) in [("spatialvla-tiny", "1000000000000000019884624838656"), ("llava3d-tiny", "1.50E-07")] {
        let place = work.path().join(name);
        copy(&donor(name), &place);
        let config = fs::read_to_string(place.join("config.json")).unwrap();
        let key = name.replace('-', "_");
        fs::write(place.join("config.json"), config.replacen('{', &format!("{{\"{key}\": {value},"), 1)).unwrap();
        numbers.push(format!("\"{key}\": {value},"));
    }
    let run = merge(work.path(), Path::new("out")).output().unwrap();
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let config = fs::read_to_string(work.path().join("out/config.json")).unwrap();
    for number in numbers.iter().chain([&"\"rms_norm_eps\": 1e-05".to_owned(), &"\"batch_norm_eps\": 1e-05".to_owned()])
    {
        assert!(config.contains(number), "{number} in {config}");
    }
}

#[test]
fn a_merge_with_few_descriptors_leaves_nothing_behind() {
    let mut ends = std::collections::BTreeSet::new();
    for descriptors in 4..16 {
        let work = TempDir::new().unwrap();
        let plain = merge(work.path(), Path::new("out"));
        let mut command = Command::new("/bin/sh");
        command.arg("-c").arg(format!("ulimit -n {descriptors}; exec \"$0\" \"$@\""));
        command.arg(plain.get_program()).args(plain.get_args()).env("XDG_STATE_HOME", crate::support::state());
        let run = command.current_dir(work.path()).output().unwrap();
        let expected: &[&str] = if run.status.code() == Some(0) { &["out"] } else { &[] };
        assert_eq!(names(work.path()), expected, "{descriptors}: {}", text(&run));
        ends.insert(run.status.code());
    }
    assert_eq!(ends.into_iter().collect::<Vec<_>>(), [Some(0), Some(2)]);
}

#[test]
fn a_link_to_a_donor_is_detected() {
    let work = TempDir::new().unwrap();
    copy(&donor("spatialvla-tiny"), &work.path().join("spatialvla-tiny"));
    symlink(work.path(), work.path().join("around")).unwrap();
    fs::create_dir(work.path().join("empty")).unwrap();
    let cases = [
        ("around/spatialvla-tiny", "is the donor"),
        ("around/spatialvla-tiny/new", "lies inside the donor"),
        ("empty/../spatialvla-tiny/new", "lies inside the donor"),
        ("around/around/spatialvla-tiny/../spatialvla-tiny", "is the donor"),
        ("no/such/..", "does not exist"),
    ];
    for (out, reason) in cases {
        let run = merge(work.path(), Path::new(out)).output().unwrap();
        assert_eq!(run.status.code(), Some(2), "{out}: {}", text(&run));
        assert!(text(&run).contains(reason), "{out}: {}", text(&run));
    }
    assert_eq!(names(work.path()), ["around", "empty", "spatialvla-tiny"]);
    assert_eq!(names(&work.path().join("spatialvla-tiny")), names(&donor("spatialvla-tiny")));
}

/// Clearing the staging directory would remove the donor.
#[test]
fn a_donor_inside_the_staging_directory_is_refused() {
    let work = TempDir::new().unwrap();
    let staging = work.path().join(".out.partial");
    fs::create_dir(&staging).unwrap();
    fs::write(staging.join("ckpt-doctor-owner"), "process 1").unwrap();
    copy(&donor("spatialvla-tiny"), &staging.join("content"));
    let mut command = crate::support::program();
    command.arg("build-merged").arg("--vision").arg(staging.join("content"));
    command.arg("--language").arg(donor("llava3d-tiny")).arg("--out").arg(work.path().join("out"));
    let run = command.output().unwrap();
    assert_eq!(run.status.code(), Some(2), "{}", text(&run));
    assert!(text(&run).contains("contains a donor"), "{}", text(&run));
    assert_eq!(names(&staging.join("content")), names(&donor("spatialvla-tiny")));
}

#[test]
fn other_files_under_the_staging_name_stay() {
    let work = TempDir::new().unwrap();
    let (staging, elsewhere) = (work.path().join(".out.partial"), work.path().join("elsewhere"));
    fs::create_dir(&elsewhere).unwrap();
    fs::write(elsewhere.join("mine"), "keep me").unwrap();
    for put in [
        (|s, _| fs::write(s, "keep me").unwrap()) as fn(&Path, &Path),
        |s, e| symlink(e, s).unwrap(),
        |s, _| symlink("/no/such/place", s).unwrap(),
    ] {
        put(&staging, &elsewhere);
        let run = merge(work.path(), &work.path().join("out")).output().unwrap();
        assert_eq!(run.status.code(), Some(2), "{}", text(&run));
        assert!(text(&run).contains("is not a directory"), "{}", text(&run));
        assert_eq!(names(work.path()), [".out.partial", "elsewhere"]);
        assert_eq!(names(&elsewhere), ["mine"]);
        fs::remove_file(&staging).unwrap();
    }
}

/// A link in the staging directory of a killed run is removed as a link.
#[test]
fn clearing_does_not_follow_links() {
    let work = TempDir::new().unwrap();
    let (content, elsewhere) = (work.path().join(".out.partial/content"), work.path().join("elsewhere"));
    fs::create_dir_all(&content).unwrap();
    fs::create_dir(&elsewhere).unwrap();
    fs::write(elsewhere.join("mine"), "keep me").unwrap();
    fs::write(work.path().join(".out.partial/ckpt-doctor-owner"), "process 1").unwrap();
    symlink(&elsewhere, content.join("link")).unwrap();
    let run = merge(work.path(), &work.path().join("out")).output().unwrap();
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    assert_eq!(names(work.path()), ["elsewhere", "out"]);
    assert_eq!(names(&elsewhere), ["mine"]);
}

#[test]
fn modes_follow_the_umask() {
    let work = TempDir::new().unwrap();
    for (umask, directory, file) in [("022", 0o755, 0o644), ("077", 0o700, 0o600), ("002", 0o775, 0o664)] {
        let out = work.path().join(umask);
        let program = merge(work.path(), &out);
        let mut shell = Command::new("sh");
        shell.arg("-c").arg(format!("umask {umask}; exec \"$@\"")).arg("sh").arg(program.get_program());
        let run = shell.args(program.get_args()).output().unwrap();
        assert_eq!(run.status.code(), Some(0), "{}", text(&run));
        assert_eq!(fs::metadata(&out).unwrap().permissions().mode() & 0o777, directory, "{umask}");
        for name in names(&out) {
            let metadata = fs::metadata(out.join(&name)).unwrap();
            assert_eq!(metadata.mode() & 0o777, file, "{umask}: {name}");
            assert_eq!(metadata.nlink(), 1, "{name}");
        }
    }
}

/// At any time of the signal, the target is either complete or missing.
#[test]
fn a_signal_leaves_no_target_or_a_complete_one() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    for (signal, number) in [("INT", 2), ("TERM", 15)] {
        for delay in [0, 20, 50, 100, 200, 400, 800] {
            let child = merge(work.path(), &out).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
            std::thread::sleep(Duration::from_millis(delay));
            let _ = Command::new("kill").arg(format!("-{signal}")).arg(child.id().to_string()).status().unwrap();
            let run = child.wait_with_output().unwrap();
            match (run.status.code(), run.status.signal()) {
                (Some(0), None) => {
                    assert_eq!(names(work.path()), ["out"], "after {delay} ms");
                    fs::remove_dir_all(&out).unwrap();
                }
                // Before the handlers are installed, nothing was written.
                (None, Some(ended)) => assert_eq!(ended, number),
                (code, _) => {
                    assert_eq!(code, Some(128 + number), "{}", text(&run));
                    assert!(text(&run).contains("interrupted; nothing was written"), "{}", text(&run));
                }
            }
            assert_eq!(names(work.path()), Vec::<String>::new(), "after {delay} ms");
        }
    }
}

/// A failing standard error must not stop the run.
#[test]
fn a_full_standard_error_does_not_panic() {
    let full = || Stdio::from(fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let run = merge(work.path(), Path::new("no/such/parent")).stderr(full()).output().unwrap();
    assert_eq!(run.status.code(), Some(2));
    // Printing the report fails, but the checkpoint is written, and the error states this.
    let run = merge(work.path(), &out).stdout(full()).output().unwrap();
    assert_eq!(run.status.code(), Some(2));
    assert!(text(&run).contains("is written, but the report could not be"), "{}", text(&run));
    assert!(out.join("config.json").is_file());
}

#[test]
fn only_the_staging_directory_of_a_killed_run_is_cleared() {
    let work = TempDir::new().unwrap();
    let stale = work.path().join(".out.partial");
    fs::create_dir_all(stale.join("content")).unwrap();
    fs::write(stale.join("content/model.safetensors"), "half").unwrap();
    fs::write(stale.join("ckpt-doctor-owner"), "process 1").unwrap();
    let out = work.path().join("out");
    assert_eq!(tiny(&out, &[]).status.code(), Some(0));
    assert_eq!(names(work.path()), ["out"]);
    fs::remove_dir_all(&out).unwrap();

    fs::create_dir_all(&stale).unwrap();
    fs::write(stale.join("thesis.txt"), "years of work").unwrap();
    let run = tiny(&out, &[]);
    assert_eq!(run.status.code(), Some(2), "{}", text(&run));
    assert_eq!(fs::read_to_string(stale.join("thesis.txt")).unwrap(), "years of work");
    assert_eq!(names(&stale), ["thesis.txt"]);
}

/// Every state in which a run can leave its staging directory after the rename, and every reason to refuse the target.
#[test]
fn remains_are_removed_even_if_the_target_is_refused() {
    let work = TempDir::new().unwrap();
    let (stale, out) = (work.path().join(".out.partial"), work.path().join("out"));
    for (marker, content) in [(true, true), (true, false), (false, false)] {
        for kind in ["directory", "file"] {
            fs::create_dir(&stale).unwrap();
            if marker {
                fs::write(stale.join("ckpt-doctor-owner"), "process 1").unwrap();
            }
            if content {
                fs::create_dir(stale.join("content")).unwrap();
                fs::write(stale.join("content/model.safetensors"), "half").unwrap();
            }
            if kind == "file" {
                fs::write(&out, "mine").unwrap();
            } else {
                fs::create_dir(&out).unwrap();
                fs::write(out.join("mine"), "mine").unwrap();
            }
            let dry = tiny(&out, &["--dry-run"]);
            assert_eq!((dry.status.code(), names(work.path()).len()), (Some(2), 2), "{}", text(&dry));
            let run = tiny(&out, &[]);
            assert_eq!(run.status.code(), Some(2), "{}", text(&run));
            assert!(text(&run).contains(".out.partial, which an ended run had left, was removed"), "{}", text(&run));
            assert_eq!(names(work.path()), ["out"]);
            let _ = fs::remove_file(&out);
            let _ = fs::remove_dir_all(&out);
        }
    }
}

#[test]
fn a_merge_states_which_remains_it_removed() {
    let work = TempDir::new().unwrap();
    let (stale, out) = (work.path().join(".out.partial"), work.path().join("out"));
    let place = fs::canonicalize(work.path()).unwrap().display().to_string();
    let mut said = String::new();
    for (target, expected) in [("free", 0), ("taken", 2)] {
        fs::create_dir(&stale).unwrap();
        fs::write(stale.join("ckpt-doctor-owner"), "process 1").unwrap();
        let run = tiny(&out, &["--output-format", "json"]);
        assert_eq!(run.status.code(), Some(expected), "{}", text(&run));
        assert_eq!(names(work.path()), ["out"]);
        let stage = |stage: &Value| format!("stage {}: {}\n", stage["name"], stage["outcome"]);
        let stages = if expected == 0 { json(&run)["merge"]["stages"].clone() } else { Value::Array(Vec::new()) };
        let stages: String = stages.as_array().unwrap().iter().filter(|s| s["name"] == "clean up").map(stage).collect();
        said += &format!("{target}: {}{stages}", String::from_utf8_lossy(&run.stderr)).replace(&place, "ROOM");
    }
    // The report in the result does not depend on what an earlier run left.
    assert!(!fs::read_to_string(out.join("merge-report.md")).unwrap().contains("ended run"));
    snapshot!("merge-remains", said);
}

#[test]
fn a_running_merge_is_not_disturbed() {
    let work = TempDir::new().unwrap();
    let staging = work.path().join(".out.partial");
    fs::create_dir(&staging).unwrap();
    fs::write(staging.join("ckpt-doctor-owner"), "process 4711").unwrap();
    let lock = fs::File::open(staging.join("ckpt-doctor-owner")).unwrap();
    lock.lock().unwrap();
    let run = tiny(&work.path().join("out"), &[]);
    assert_eq!(run.status.code(), Some(2));
    assert!(text(&run).contains("process 4711"), "{}", text(&run));
    assert_eq!(names(&staging), ["ckpt-doctor-owner"]);
    fs::write(work.path().join("out"), "a refused target").unwrap();
    assert_eq!(tiny(&work.path().join("out"), &[]).status.code(), Some(2));
    assert_eq!(names(&staging), ["ckpt-doctor-owner"]);
}
