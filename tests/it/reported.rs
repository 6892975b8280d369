//! Problems that users reported in public, rebuilt: `fixtures/reported/AREA/NAME.json5`.
//!
//! Each case is a sound control and the same directory with the defect. `check` must name the cause and its place in the
//! second, say nothing above info of the first, and leave nothing above info after a repair of the promised safety.
//! `CKPT_DOCTOR_REPORTED=DIR cargo test --test it reported::` also copies the directories to DIR, for
//! `tests/peer/reported.py`, which opens them with the real loaders.

mod page;
mod search;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock};

use ckpt_doctor::check::Safety;
use ckpt_doctor::knowledge::source;
use serde::Deserialize;
use serde_json::{Map, Value, json};

use crate::support::change::{Change, apply_all};
use crate::support::{Case, files, knowledge, project, texts};

/// How many threads report the problem.
#[derive(Debug, Clone, Copy, Deserialize, PartialEq, Eq, PartialOrd, Ord)]
#[serde(rename_all = "lowercase")]
enum Seen {
    High,
    Medium,
    Low,
}

/// One reported problem.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Problem {
    /// `AREA/NAME`.
    #[serde(skip)]
    name: String,
    /// What is wrong with the directory, in one sentence.
    problem: String,
    /// Threads, as `owner/repository#number`.
    threads: Vec<String>,
    seen: Seen,
    /// What the user sees, in the words of the program that fails.
    symptom: String,
    /// Why it fails.
    cause: String,
    /// Why the files of the directory do not show the problem; there is no case then.
    #[serde(default)]
    unseen: Option<String>,
    /// The rebuilt directories: all other keys of the file.
    #[serde(skip)]
    case: Option<Rebuilt>,
}

/// Keys that describe a problem in words.
const TEXTS: [&str; 6] = ["problem", "threads", "seen", "symptom", "cause", "unseen"];

/// The directories of a problem, and what must be found.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Rebuilt {
    /// A base of `support::base`, a folder of `fixtures/bases`, or `empty`.
    base: String,
    /// Changes that make the control.
    #[serde(default)]
    sound: Vec<Change>,
    /// Changes of the control that make the defect.
    changes: Vec<Change>,
    /// Values of `--for`.
    #[serde(default)]
    loaders: Vec<String>,
    #[serde(default)]
    deep: bool,
    expect: Named,
    /// Further codes above info on the defect: consequences.
    #[serde(default)]
    also: BTreeSet<String>,
    /// Codes above info that are right on the control as well.
    #[serde(default)]
    tolerates: BTreeSet<String>,
    /// Safety of the repair after which nothing above info is left.
    #[serde(default)]
    fixed: Option<Safety>,
    /// What the real loaders do with the defect and not with the control, by version; `tests/peer/reported.py` compares.
    #[serde(default)]
    confirmed: BTreeMap<String, String>,
}

/// The finding that names the cause; missing fields may have any value.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Named {
    code: String,
    severity: String,
    #[serde(default)]
    file: Option<String>,
    #[serde(default)]
    pointer: Option<String>,
    #[serde(default)]
    tensor: Option<String>,
    /// Part of the message.
    #[serde(default)]
    says: Option<String>,
}

/// The findings on the directories of a case.
#[derive(Debug, Clone)]
struct Found {
    control: Vec<Value>,
    defect: Vec<Value>,
    /// After the repair, if one is promised.
    repaired: Option<Vec<Value>>,
}

/// All problems, by name.
fn problems() -> Vec<Problem> {
    let parse = |(path, text): (String, String)| {
        let all: Map<String, Value> = source::parse(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        let (words, case): (Map<_, _>, Map<_, _>) = all.into_iter().partition(|(key, _)| TEXTS.contains(&key.as_str()));
        let mut problem: Problem = serde_json::from_value(words.into()).unwrap_or_else(|e| panic!("{path}: {e}"));
        if !case.is_empty() {
            problem.case = Some(serde_json::from_value(case.into()).unwrap_or_else(|e| panic!("{path}: {e}")));
        }
        let name = path.strip_prefix("fixtures/reported/").and_then(|p| p.strip_suffix(".json5")).expect("its folder");
        name.clone_into(&mut problem.name);
        problem
    };
    texts("fixtures/reported").into_iter().map(parse).collect()
}

/// The control and the defect of every problem, as cases: inputs of the laws.
pub(crate) fn directories() -> Vec<Case> {
    let of_problem = |problem: Problem| {
        let Rebuilt { base, sound, changes, loaders, deep, .. } = problem.case?;
        let both = [("control", sound.clone()), ("defect", [sound, changes].concat())];
        let case = move |(kind, changes)| Case {
            name: format!("reported/{} {kind}", problem.name),
            code: None,
            base: base.clone(),
            changes,
            deep,
            loaders: loaders.clone(),
            settings: None,
            expect: None,
        };
        Some(both.map(case))
    };
    problems().into_iter().filter_map(of_problem).flatten().collect()
}

/// Runs `check` on a directory; returns its findings.
fn check(dir: &Path, case: &Rebuilt, more: &[&str]) -> Vec<Value> {
    let mut command = crate::support::program();
    command.args(["check", "--isolated", "--output-format", "json"]).args(more).arg(dir);
    command.args(case.loaders.iter().flat_map(|loader| ["--for", loader]));
    if case.deep {
        command.arg("--deep");
    }
    let output = command.output().expect("check runs");
    let report: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)));
    let checkpoints = report["checkpoints"].as_array().expect("checkpoints");
    let named = |checkpoint: &Value| {
        let path = PathBuf::from(checkpoint["path"].as_str().expect("a path"));
        let below = path.strip_prefix(dir).map(|p| p.display().to_string()).unwrap_or_default();
        let findings = checkpoint["findings"].as_array().expect("findings").clone();
        findings.into_iter().map(move |mut finding| {
            finding["checkpoint"] = json!(below);
            finding
        })
    };
    checkpoints.iter().flat_map(named).collect()
}

/// Builds the directories of a case in `room`, and checks them.
fn look(problem: &Problem, case: &Rebuilt, base: &Path, room: &Path) -> Found {
    let [control, defect, repaired] = ["control", "defect", "repaired"].map(|name| room.join(name));
    copy_tree(base, &control);
    apply_all(&problem.name, &case.sound, &control);
    copy_tree(&control, &defect);
    apply_all(&problem.name, &case.changes, &defect);
    let facts = json!({ "confirmed": case.confirmed, "repaired": case.fixed.is_some() });
    fs::write(room.join("case.json"), facts.to_string()).expect("write");
    let found = |dir: &Path| check(dir, case, &[]);
    let mut all = Found { control: found(&control), defect: found(&defect), repaired: None };
    if let Some(safety) = case.fixed {
        copy_tree(&defect, &repaired);
        let unsafe_fixes: &[&str] = if safety == Safety::Safe { &[] } else { &["--unsafe-fixes"] };
        check(&repaired, case, &[&["--fix"], unsafe_fixes].concat());
        all.repaired = Some(found(&repaired));
    }
    all
}

/// Copies a directory with its folders; links are copied as links.
fn copy_tree(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a directory");
    for entry in fs::read_dir(from).expect("a directory") {
        let entry = entry.expect("an entry");
        let (path, target) = (entry.path(), to.join(entry.file_name()));
        let kind = entry.file_type().expect("a kind");
        if kind.is_dir() {
            copy_tree(&path, &target);
        } else if kind.is_symlink() {
            std::os::unix::fs::symlink(fs::read_link(&path).expect("a link"), &target).expect("a link");
        } else {
            fs::copy(&path, &target).expect("copy");
        }
    }
}

/// Every problem with what was found; built and checked once.
fn found() -> &'static [(Problem, Option<Found>)] {
    static FOUND: OnceLock<Vec<(Problem, Option<Found>)>> = OnceLock::new();
    FOUND.get_or_init(|| {
        let temporary = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
        let kept = std::env::var_os("CKPT_DOCTOR_REPORTED").map(PathBuf::from);
        let room = kept.unwrap_or_else(|| temporary.path().join("reported"));
        let problems = problems();
        let bases = temporary.path().join("bases");
        let wanted: BTreeSet<&str> = problems.iter().filter_map(|p| p.case.as_ref().map(|c| c.base.as_str())).collect();
        let knowledge = knowledge();
        for base in wanted {
            crate::support::base::make(base, &bases.join(base), &knowledge);
        }
        let pending = Mutex::new(problems.iter().enumerate());
        let done = Mutex::new(BTreeMap::new());
        let next = || pending.lock().expect("no panic").next();
        let work = || {
            while let Some((number, problem)) = next() {
                let room = room.join(&problem.name);
                let found = problem.case.as_ref().map(|case| look(problem, case, &bases.join(&case.base), &room));
                done.lock().expect("no panic").insert(number, found);
            }
        };
        std::thread::scope(|scope| {
            for _ in 0..std::thread::available_parallelism().map_or(1, usize::from).min(8) {
                scope.spawn(work);
            }
        });
        let done = done.into_inner().expect("no panic").into_values();
        problems.iter().cloned().zip(done).collect()
    })
}

fn is_above_info(finding: &Value) -> bool {
    finding["severity"] != "info"
}

fn shown(findings: &[&Value]) -> String {
    let line = |f: &&Value| format!("    {} {} {} {}", f["code"], f["severity"], f["message"], f["locations"]);
    findings.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// Findings above info whose codes are not among the allowed ones.
fn loud(findings: &[Value], allowed: impl Fn(&str) -> bool) -> Vec<&Value> {
    findings.iter().filter(|f| is_above_info(f) && !allowed(f["code"].as_str().expect("a code"))).collect()
}

/// Fails with the cases of which `wrong` says something.
#[track_caller]
fn none(wrong: impl Fn(&Problem, &Rebuilt, &Found) -> Option<String>) {
    let each = found().iter().filter_map(|(problem, found)| {
        let why = wrong(problem, problem.case.as_ref()?, found.as_ref()?)?;
        Some(format!("{}: {why}", problem.name))
    });
    let all: Vec<String> = each.collect();
    assert!(all.is_empty(), "{} cases:\n{}", all.len(), all.join("\n"));
}

#[test]
fn the_cause_is_named_with_its_place() {
    none(|_, case, found| {
        let Named { code, severity, file, pointer, tensor, says } = &case.expect;
        let is = |wanted: &Option<String>, value: &Value| wanted.as_ref().is_none_or(|w| value == w.as_str());
        let at =
            |place: &Value| is(file, &place["file"]) && is(pointer, &place["pointer"]) && is(tensor, &place["tensor"]);
        let named = |f: &&Value| {
            let message = f["message"].as_str().unwrap_or_default();
            let places = f["locations"].as_array().expect("places");
            let placed = places.iter().any(at) || (file.is_none() && pointer.is_none() && tensor.is_none());
            f["severity"] == severity.as_str()
                && placed
                && says.as_ref().is_none_or(|says| message.contains(says.as_str()))
        };
        let own: Vec<&Value> = found.defect.iter().filter(|f| f["code"] == code.as_str()).collect();
        let all: Vec<&Value> = found.defect.iter().collect();
        match own.iter().find(|f| named(f)) {
            Some(_) => None,
            None if own.is_empty() => Some(format!("{code} is silent; found\n{}", shown(&all))),
            None => Some(format!("{code} has another severity, place or message\n{}", shown(&own))),
        }
    });
}

#[test]
fn nothing_else_is_said_of_the_defect() {
    none(|_, case, found| {
        let allowed =
            |code: &str| code == case.expect.code || case.also.contains(code) || case.tolerates.contains(code);
        let loud = loud(&found.defect, allowed);
        (!loud.is_empty()).then(|| format!("also found\n{}", shown(&loud)))
    });
}

#[test]
fn controls_are_silent() {
    none(|_, case, found| {
        let loud = loud(&found.control, |code| case.tolerates.contains(code));
        let own = found.control.iter().filter(|f| f["code"] == case.expect.code.as_str());
        let all: Vec<&Value> = loud.into_iter().chain(own).collect();
        (!all.is_empty()).then(|| format!("the control has findings\n{}", shown(&all)))
    });
}

#[test]
fn repairs_leave_nothing() {
    none(|_, case, found| {
        let repaired = found.repaired.as_ref()?;
        let own = repaired.iter().filter(|f| f["code"] == case.expect.code.as_str());
        let all: Vec<&Value> = loud(repaired, |code| case.tolerates.contains(code)).into_iter().chain(own).collect();
        (!all.is_empty()).then(|| format!("after the repair\n{}", shown(&all)))
    });
}

/// Each problem has threads and either directories or the reason why there are none; no thread is listed for two problems of
/// one area.
#[test]
fn problems_are_complete() {
    let thread = |t: &str| {
        let (repository, number) = t.split_once('#').unwrap_or_default();
        repository.split('/').count() == 2 && number.parse::<u32>().is_ok()
    };
    for problem in problems() {
        assert!(!problem.threads.is_empty(), "{}: no thread", problem.name);
        assert!(problem.threads.iter().all(|t| thread(t)), "{}: threads are owner/repository#number", problem.name);
        assert_eq!(problem.case.is_some(), problem.unseen.is_none(), "{}: a base or `unseen`", problem.name);
        let sentences = [&problem.problem, &problem.symptom, &problem.cause];
        assert!(sentences.iter().all(|text| !text.trim().is_empty()), "{}: an empty text", problem.name);
    }
    let folder = project().join("fixtures/reported");
    let stray: Vec<PathBuf> =
        files(&folder, "").into_iter().filter(|f| f.extension().is_none_or(|e| e != "json5")).collect();
    assert!(stray.is_empty(), "not a problem: {stray:?}");
}
