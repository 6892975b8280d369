//! Fixtures: a sound base, changes, and the expected findings.
//!
//! A case is one small JSON5 file. The rule must report `fixtures/rules/<CODE>/<case>.json5`;
//! `fixtures/sound/<case>.json5` is unusual but valid. The checkpoint itself is created in a temporary directory, so
//! that the repository contains no broken weights.

pub mod base;
pub mod change;
pub mod data;
mod draw;
pub mod invariants;
pub mod pickle;
pub mod repairs;
pub mod weights;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, OnceLock};

use ckpt_doctor::check::finding::{Finding, Severity};
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::check::{Outcome, Safety, check_for, suppression_uses, unused_suppressions};
use ckpt_doctor::checkpoint::journal::StateFolder;
use ckpt_doctor::checkpoint::{Checkpoint, FaultKind, ReadOptions, telling_all};
use ckpt_doctor::knowledge::rule::RuleSet;
use ckpt_doctor::knowledge::selection::Choice;
use ckpt_doctor::knowledge::settings::{Chain, SettingsSource};
use ckpt_doctor::knowledge::{Knowledge, Library, source};
use ckpt_doctor::report::model::CheckpointReport;
use ckpt_doctor::report::{self, Style};
use ckpt_doctor::surgery::Trust;
use serde::Deserialize;

pub use base::{BASES, copy};
use change::Change;
pub use draw::Draw;

/// Compares a text with `tests/snapshots/NAME.snap`.
macro_rules! snapshot {
    ($name:expr, $text:expr) => {
        insta::with_settings!({
            snapshot_path => concat!(env!("CARGO_MANIFEST_DIR"), "/tests/snapshots"),
            prepend_module_to_snapshot => false,
            omit_expression => true,
        }, { insta::assert_snapshot!($name, $text) })
    };
}

/// One case.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Case {
    /// `JSN001/infinity`, or `sound/padded-header`.
    #[serde(skip)]
    pub name: String,
    /// The rule that must report the case; `None` for a sound case.
    #[serde(skip)]
    pub code: Option<String>,
    /// One of [`BASES`].
    pub base: String,
    /// Changes, in order.
    #[serde(default)]
    pub changes: Vec<Change>,
    /// Whether to read the bytes of tensors and files, as `check --deep --hash` does; always for sound cases.
    #[serde(default)]
    pub deep: bool,
    /// Values of `--for`.
    #[serde(default)]
    pub loaders: Vec<String>,
    /// Settings for the check.
    #[serde(default)]
    pub settings: Option<serde_json::Value>,
    /// The expected finding; `None` for a sound case.
    #[serde(default)]
    pub expect: Option<Expect>,
}

/// The expected finding; missing fields may have any value.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Expect {
    pub severity: Severity,
    #[serde(default)]
    pub file: Option<String>,
    #[serde(default)]
    pub tensor: Option<String>,
    #[serde(default)]
    pub pointer: Option<String>,
    #[serde(default)]
    pub line: Option<usize>,
    /// Part of the message.
    #[serde(default)]
    pub says: Option<String>,
    /// Number of findings of the rule; one when missing.
    #[serde(default)]
    pub count: Option<usize>,
    /// Safety of the fix.
    #[serde(default)]
    pub fix: Option<Safety>,
}

/// A case and the result of checking it.
pub struct Tried {
    pub case: Case,
    pub outcome: Outcome,
    /// Codes of findings on the unchanged base.
    pub before: BTreeSet<String>,
    /// Kinds of the faults that readers and comparisons produced.
    pub kinds: BTreeSet<FaultKind>,
    /// The first finding of the case's own rule, as `check` prints it.
    pub example: String,
    /// Where the report differs from what a worker would send of it.
    pub lost: Option<String>,
}

impl Tried {
    /// Findings of the case's own rule.
    pub fn own(&self) -> Vec<&Finding> {
        self.outcome.findings.iter().filter(|f| Some(&f.code) == self.case.code.as_ref()).collect()
    }

    /// Every code found, with a count if more than one.
    pub fn codes(&self) -> String {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for finding in &self.outcome.findings {
            *counts.entry(&finding.code).or_default() += 1;
        }
        let words = counts.into_iter().map(|(code, n)| if n == 1 { code.to_owned() } else { format!("{code}×{n}") });
        words.collect::<Vec<_>>().join(" ")
    }
}

/// The project's directory.
pub fn project() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The value of `XDG_STATE_HOME` for every run of the program in a test: no test reads or writes the state of whoever runs it.
pub fn state() -> &'static Path {
    static STATE: OnceLock<PathBuf> = OnceLock::new();
    STATE.get_or_init(|| {
        let state = Path::new(env!("CARGO_TARGET_TMPDIR")).join("state");
        fs::create_dir_all(&state).expect("a folder");
        state
    })
}

/// The program of this build, with [`state`], and with a cache of the Hub that is not there.
pub fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ckpt-doctor"));
    command.env("HF_HUB_CACHE", state().join("no-hub"));
    command.env("XDG_STATE_HOME", state()).env_remove("FORCE_COLOR").env_remove("CLICOLOR_FORCE");
    command
}

/// The user of [`program`], for tests that call the library.
pub fn user() -> StateFolder {
    StateFolder::at(state().join("ckpt-doctor"))
}

/// The journals of this user alone are carried out.
pub fn own() -> Trust {
    Trust { user: user(), adopts: false }
}

/// Files with this ending below a folder, sorted.
pub fn files(folder: &Path, ending: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut pending = vec![folder.to_owned()];
    while let Some(folder) = pending.pop() {
        for entry in fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                pending.push(path);
            } else if path.to_string_lossy().ends_with(ending) {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

/// The rules on disk, so that a change needs no compilation.
pub fn rules() -> RuleSet {
    let texts = texts("rules/checks");
    RuleSet::default()
        .and_files(texts.iter().map(|(path, text)| (path.clone(), text.as_str())))
        .unwrap_or_else(|e| panic!("{e}"))
}

/// Path below the project and text of every JSON5 file in a folder.
pub fn texts(folder: &str) -> Vec<(String, String)> {
    let read = |path: PathBuf| {
        let name = path.strip_prefix(project()).expect("inside").to_string_lossy().into_owned();
        (name, fs::read_to_string(path).expect("text"))
    };
    files(&project().join(folder), ".json5").into_iter().map(read).collect()
}

/// All knowledge of a checker.
pub fn knowledge() -> Knowledge {
    Knowledge::with(rules(), Library::embedded())
}

/// Reads a directory; a git work tree around it is trusted.
fn read(dir: &Path) -> Checkpoint {
    let mut checkpoint = Checkpoint::open(dir).expect("a directory");
    checkpoint.recognise_journal(&user());
    checkpoint.expect_lfs_pointers(&|top| Some(top) == dir.parent());
    checkpoint
}

/// Checks a directory under settings in the folder above it.
fn under(settings: &serde_json::Value, dir: &Path, mut knowledge: Knowledge) -> (Arc<Checkpoint>, Outcome) {
    let above = dir.parent().expect("a folder above");
    let source =
        SettingsSource::parse("ckpt-doctor.json5", above, &settings.to_string()).unwrap_or_else(|e| panic!("{e}"));
    let policy = Chain(vec![source]).govern(&mut knowledge.rules, Choice::default()).unwrap_or_else(|e| panic!("{e}"));
    let checkpoint = Arc::new(read(dir));
    let options = RunOptions { policy, ..RunOptions::default() };
    let mut outcome = check_for(&checkpoint, &knowledge, &options);
    let uses = suppression_uses(&knowledge, &options.policy, &checkpoint, &outcome);
    let unused =
        unused_suppressions(&knowledge, &options.policy, &[(checkpoint.source.path(), &uses)], &[above.to_owned()]);
    outcome.findings.extend(unused.into_iter().map(|(_, finding)| finding));
    (checkpoint, outcome)
}

/// Makes one of [`BASES`].
pub fn make_base(name: &str, dir: &Path) {
    base::make(name, dir, &knowledge());
}

/// All cases, by name.
pub fn cases() -> Vec<Case> {
    let parse = |(path, text): (String, String), folder: &str| {
        let mut case: Case = source::parse(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        let name = path.strip_prefix(folder).and_then(|p| p.strip_suffix(".json5")).expect("its folder");
        name.clone_into(&mut case.name);
        case
    };
    let mut cases = Vec::new();
    for file in texts("fixtures/rules") {
        let mut case = parse(file, "fixtures/rules/");
        let code = case.name.split_once('/').unwrap_or_else(|| panic!("{} lies in no rule's folder", case.name)).0;
        case.code = Some(code.to_owned());
        assert!(case.expect.is_some(), "{} expects nothing", case.name);
        cases.push(case);
    }
    for file in texts("fixtures/sound") {
        let case = Case { deep: true, ..parse(file, "fixtures/") };
        assert!(case.expect.is_none(), "{} is sound and expects a finding", case.name);
        cases.push(case);
    }
    let plain = BASES.iter().map(|base| Case {
        name: format!("base/{base}"),
        code: None,
        base: (*base).to_owned(),
        changes: Vec::new(),
        deep: true,
        loaders: Vec::new(),
        settings: None,
        expect: None,
    });
    cases.extend(plain);
    cases
}

/// Every case, built and checked; computed once.
pub fn tried() -> &'static [Tried] {
    static TRIED: OnceLock<Vec<Tried>> = OnceLock::new();
    TRIED.get_or_init(try_all)
}

/// Opens and checks a directory.
pub fn look(dir: &Path, deep: bool, knowledge: &Knowledge) -> Outcome {
    open(dir, deep, &[], knowledge).1
}

/// As [`look`], for the loaders of `--for`.
pub fn open(dir: &Path, deep: bool, loaders: &[String], knowledge: &Knowledge) -> (Arc<Checkpoint>, Outcome) {
    let mut checkpoint = read(dir);
    if deep {
        checkpoint.read_contents(ReadOptions::default(), &|_| {});
        checkpoint.check_hashes(&|_| {});
    }
    let checkpoint = Arc::new(checkpoint);
    let outcome = check_for(&checkpoint, knowledge, &RunOptions::for_versions(loaders));
    (checkpoint, outcome)
}

/// The first finding of the rule as `check` prints it.
fn example(code: &str, checkpoint: &Checkpoint, outcome: &Outcome) -> Option<String> {
    let finding = outcome.findings.iter().find(|f| f.code == code)?;
    let report = CheckpointReport::new("model", None, checkpoint, outcome);
    let text = report::render_finding(finding, &report, Style { width: Some(100), ..Style::default() });
    Some(text.lines().map(str::trim_end).collect::<Vec<_>>().join("\n"))
}

/// The first line in which a report differs once it was sent by a worker.
fn lost(report: &CheckpointReport) -> Option<String> {
    let text = telling_all(|| serde_json::to_string(report)).expect("JSON");
    let received: CheckpointReport = serde_json::from_str(&text).expect("the report");
    let (sent, received) = (format!("{report:#?}"), format!("{received:#?}"));
    let pair = sent.lines().zip(received.lines()).find(|(one, other)| one != other);
    pair.map(|(one, other)| format!("{one} / {other}"))
        .or_else(|| (sent.len() != received.len()).then(|| "length".to_owned()))
}

/// A defect in one of the two models.
pub struct Seeded {
    pub defect: String,
    pub model: &'static str,
    pub code: String,
    pub says: String,
    /// Further rules that report a consequence of the defect.
    pub also: Vec<String>,
    pub count: usize,
}

/// All defects, with their outcomes.
pub struct AllSeeded {
    pub defects: usize,
    pub tried: Vec<(Seeded, Outcome)>,
    /// The models without a defect.
    pub sound: Vec<(&'static str, Outcome)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SeededFile {
    defects: Vec<Planted>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Planted {
    defect: String,
    llama: Option<SeededCase>,
    spatialvla: Option<SeededCase>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SeededCase {
    changes: Vec<Change>,
    #[serde(default)]
    pub deep: bool,
    code: String,
    says: String,
    #[serde(default)]
    also: Vec<String>,
    #[serde(default)]
    count: Option<usize>,
}

/// Builds and checks every defect of `fixtures/seeded.json5`, once.
pub fn seeded() -> &'static AllSeeded {
    static SEEDED: OnceLock<AllSeeded> = OnceLock::new();
    SEEDED.get_or_init(|| {
        let path = "fixtures/seeded.json5";
        let text = fs::read_to_string(project().join(path)).expect("text");
        let file: SeededFile = source::parse(path, &text).unwrap_or_else(|e| panic!("{e}"));
        let knowledge = knowledge();
        let temporary = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
        let bases = base::make_all(&temporary.path().join("bases"), &["llama-sharded", "spatialvla"], &knowledge);
        let sound = bases.iter().map(|(name, dir)| (*name, look(dir, true, &knowledge))).collect();
        let mut all = AllSeeded { defects: file.defects.len(), tried: Vec::new(), sound };
        for Planted { defect, llama, spatialvla } in file.defects {
            for (model, case) in [("llama-sharded", llama), ("spatialvla", spatialvla)] {
                let Some(case) = case else { continue };
                let room = temporary.path().join("room");
                let made = change::make(&defect, &bases[model], &case.changes, &room);
                let outcome = look(&made, case.deep, &knowledge);
                fs::remove_dir_all(&room).expect("removing a fixture");
                let SeededCase { code, says, also, count, .. } = case;
                let seeded = Seeded { defect: defect.clone(), model, code, says, also, count: count.unwrap_or(1) };
                all.tried.push((seeded, outcome));
            }
        }
        all
    })
}

/// Code of the rules that [`with_kinds`] adds.
const KIND: &str = "KIND";

/// Knowledge with one more rule for each kind of fault, which reports that the kind was produced.
fn with_kinds() -> Knowledge {
    let mut knowledge = knowledge();
    let rule = |(number, kind): (usize, &FaultKind)| {
        let text = format!(
            "{{ code: '{KIND}{number}', name: 'produces-{kind}', severity: 'info', summary: '', why: '', \
               check: {{ fault: {{ kinds: ['{kind}'], group: true }} }}, message: '{kind}' }}"
        );
        (format!("{kind}.json5"), text)
    };
    let texts: Vec<(String, String)> = FaultKind::ALL.iter().enumerate().map(rule).collect();
    let texts = texts.iter().map(|(path, text)| (path.clone(), text.as_str()));
    knowledge.rules = knowledge.rules.and_files(texts).unwrap_or_else(|e| panic!("{e}"));
    knowledge
}

/// Removes the findings of the rules of [`with_kinds`] from an outcome.
fn take_kinds(outcome: &mut Outcome) -> BTreeSet<FaultKind> {
    let (kinds, findings) = outcome.findings.drain(..).partition(|f| f.code.starts_with(KIND));
    outcome.findings = findings;
    let kind = |f: Finding| {
        FaultKind::ALL
            .iter()
            .copied()
            .find(|kind| kind.name() == f.message)
            .unwrap_or_else(|| panic!("{} is a kind", f.message))
    };
    Vec::into_iter(kinds).map(kind).collect()
}

fn try_all() -> Vec<Tried> {
    let (knowledge, observing) = (knowledge(), with_kinds());
    let before: OnceLock<BTreeMap<&str, BTreeSet<String>>> = OnceLock::new();
    let tried = on_every_case(&knowledge, |bases, case, made| {
        let codes = |dir: &PathBuf| look(dir, true, &knowledge).findings.into_iter().map(|f| f.code).collect();
        let before = before.get_or_init(|| bases.iter().map(|(name, dir)| (*name, codes(dir))).collect());
        let (checkpoint, mut outcome) = match &case.settings {
            Some(settings) => under(settings, made, with_kinds()),
            None => open(made, case.deep, &case.loaders, &observing),
        };
        let kinds = take_kinds(&mut outcome);
        let example = case.code.as_ref().and_then(|code| example(code, &checkpoint, &outcome)).unwrap_or_default();
        let lost = lost(&CheckpointReport::new("model", None, &checkpoint, &outcome));
        Tried { case: case.clone(), outcome, before: before[case.base.as_str()].clone(), kinds, example, lost }
    });
    tried.into_iter().map(|(_, tried)| tried).collect()
}

/// Builds every case in a temporary directory and calls `look` on it, on several threads; results are in case order.
pub fn on_every_case<T: Send>(
    knowledge: &Knowledge,
    look: impl Fn(&BTreeMap<&'static str, PathBuf>, &Case, &Path) -> T + Sync,
) -> Vec<(Case, T)> {
    on_cases(knowledge, |_| true, look)
}

/// As [`on_every_case`], for the wanted case names. The directories stay below `CKPT_DOCTOR_CASES`, if it is set.
pub fn on_cases<T: Send>(
    knowledge: &Knowledge,
    wanted: impl Fn(&str) -> bool,
    look: impl Fn(&BTreeMap<&'static str, PathBuf>, &Case, &Path) -> T + Sync,
) -> Vec<(Case, T)> {
    let temporary = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a temporary directory");
    let kept = std::env::var_os("CKPT_DOCTOR_CASES").map(PathBuf::from);
    let bases = base::make_all(&temporary.path().join("bases"), BASES, knowledge);
    let cases: Vec<Case> = cases().into_iter().filter(|case| wanted(&case.name)).collect();
    let pending = Mutex::new(cases.into_iter().enumerate());
    let done = Mutex::new(BTreeMap::new());
    let next = || pending.lock().expect("no panic").next();
    let work = || {
        while let Some((number, case)) = next() {
            let base = bases.get(case.base.as_str()).unwrap_or_else(|| panic!("{}: no base {}", case.name, case.base));
            let room = kept.as_ref().map_or_else(|| temporary.path().join(number.to_string()), |d| d.join(&case.name));
            let made = change::make(&case.name, base, &case.changes, &room);
            let seen = look(&bases, &case, &made);
            if kept.is_none() {
                fs::remove_dir_all(&room).expect("removing a fixture");
            }
            done.lock().expect("no panic").insert(number, (case, seen));
        }
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(8);
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(work);
        }
    });
    done.into_inner().expect("no panic").into_values().collect()
}

/// Builds a checkpoint below `room` from a base and changes in the format of a case.
pub fn made(base: &'static str, changes: &str, room: &Path) -> PathBuf {
    let bases = base::make_all(&room.join("bases"), &[base], &knowledge());
    let changes: Vec<Change> = source::parse("the changes", changes).unwrap_or_else(|e| panic!("{e}"));
    change::make("the changes", &bases[base], &changes, &room.join("room"))
}
