//! The verdict on a loader depends on the files and that loader alone: neither on the other loaders of a run, nor on the rules
//! that are selected, nor on severities. What is not read never makes it better.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use ckpt_doctor::check::Severity;
use ckpt_doctor::check::verdict::{LoadVerdict, PredictedLoad};
use ckpt_doctor::knowledge::rule::Object;
use ckpt_doctor::knowledge::selection::Choice;
use ckpt_doctor::knowledge::{Knowledge, Loader};

use crate::support::{Case, Draw, knowledge, on_cases, open};

/// Answers for one loader that the laws compared, in this process.
pub(super) static COMPARED: AtomicUsize = AtomicUsize::new(0);

/// The verdicts of a run.
fn verdicts(made: &Path, case: &Case, named: &[&str], knowledge: &Knowledge) -> Vec<PredictedLoad> {
    let named: Vec<String> = named.iter().map(|version| (*version).to_owned()).collect();
    let verdicts = open(made, case.deep, &named, knowledge).1.verdicts;
    COMPARED.fetch_add(verdicts.len(), Ordering::Relaxed);
    verdicts
}

/// What differs between two answers for one loader.
fn differences(one: &PredictedLoad, other: &PredictedLoad) -> Vec<String> {
    let mut found = Vec::new();
    if one.verdict != other.verdict {
        found.push(format!("{:?}, {:?}", one.verdict, other.verdict));
    }
    let objects = |load: &PredictedLoad| {
        let mut objects: Vec<_> = load.objects.iter().map(|o| (o.object, o.verdict, o.why.clone())).collect();
        objects.sort_by_key(|(object, ..)| *object);
        objects
    };
    let (of_one, of_other) = (objects(one), objects(other));
    found.extend(of_one.iter().filter(|o| !of_other.contains(o)).map(|o| format!("- {o:?}")));
    found.extend(of_other.iter().filter(|o| !of_one.contains(o)).map(|o| format!("+ {o:?}")));
    if one.tensors != other.tensors {
        found.push(format!("{:?}, {:?}", one.tensors, other.tensors));
    }
    found
}

/// Tries a law on one case of `part`, or with `CKPT_DOCTOR_LAWS` on every one, and fails with the exceptions.
pub(super) fn holds(part: usize, look: impl Fn(&Case, &Path) -> Vec<String> + Sync, knowledge: &Knowledge) {
    let wanted = |name: &str| super::cases(0) > 0 || name.bytes().map(usize::from).sum::<usize>().is_multiple_of(part);
    let before = COMPARED.load(Ordering::Relaxed);
    let tried = on_cases(knowledge, wanted, |_, case, made| look(case, made));
    let compared = COMPARED.load(Ordering::Relaxed) - before;
    println!("{} cases, at least {compared} answers of this and other laws", tried.len());
    assert!(tried.len() * part > 400, "{} cases", tried.len());
    let broken: Vec<String> = tried.into_iter().flat_map(|(_, broken)| broken).collect();
    assert!(broken.is_empty(), "{} broken:\n{}", broken.len(), broken.join("\n"));
}

/// Law *company*: what differs between the verdicts by default, with all loaders, and with each alone.
pub(super) fn company(case: &Case, made: &Path, knowledge: &Knowledge) -> Vec<String> {
    let mut found = Vec::new();
    let known = Loader::ALL.map(Loader::version);
    let between = ["4.49", "4.55", "5.1"];
    let all = [&known[..], &between].concat();
    for (named, words) in [(&[] as &[&str], "by default"), (&all, "with others")] {
        for among in verdicts(made, case, named, knowledge) {
            let judged = among.stands_for.as_ref().unwrap_or(&among.loader);
            let alone = verdicts(made, case, &[judged], knowledge);
            let [alone] = &alone[..] else { panic!("{}: {judged}", case.name) };
            let version = among.version();
            let differing = differences(alone, &among).into_iter();
            found.extend(differing.map(|why| format!("{} {version} {words}: {why}", case.name)));
        }
    }
    found
}

#[test]
fn a_verdict_does_not_depend_on_the_other_loaders_of_the_run() {
    let knowledge = knowledge();
    holds(8, |case, made| company(case, made, &knowledge), &knowledge);
}

/// A loader that stands for several versions gives each its own verdict, where a rule tells them apart.
#[test]
fn versions_that_one_loader_stands_for_are_told_apart() {
    let knowledge = knowledge();
    let room = tempfile::tempdir().unwrap();
    crate::support::make_base("gemma3", room.path());
    let path = room.path().join("config.json");
    let mut config: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    config["transformers_version"] = "4.55.0".into();
    config["text_config"]["layer_types"] = vec!["full_attention"; 9].into();
    std::fs::write(&path, config.to_string()).unwrap();
    let told = |named: &[&str]| {
        let named: Vec<String> = named.iter().map(|version| (*version).to_owned()).collect();
        let (_, outcome) = open(room.path(), false, &named, &knowledge);
        let loads = outcome.verdicts.iter().map(|load| (load.version(), load.verdict, load.leads));
        loads.collect::<Vec<_>>()
    };
    let stands_for = |version: &str| format!("{version} (judged as 4.57.6)");
    let newest = |leads| ("5.23.0".to_owned(), LoadVerdict::Raises, leads);
    let (loads, raises) = (LoadVerdict::Loads, LoadVerdict::Raises);
    let by_default = [(stands_for("4.55.0"), loads, true), ("4.57.6".to_owned(), raises, false), newest(false)];
    assert_eq!(told(&[]), by_default);
    let named = [(stands_for("4.55"), loads, true), (stands_for("4.57.2"), raises, true), newest(true)];
    assert_eq!(told(&["4.55", "4.57.2", "5.23.0"]), named);
}

/// Law *ignorance*: what becomes better where a drawn file is not read, because it leads out of the directory.
#[cfg(unix)]
pub(super) fn ignorance(case: &Case, made: &Path, knowledge: &Knowledge) -> Vec<String> {
    let names = std::fs::read_dir(made).unwrap().map(|entry| entry.unwrap());
    let mut names: Vec<_> = names.filter(|e| e.file_type().unwrap().is_file()).map(|e| e.file_name()).collect();
    names.sort();
    let mut draw = Draw::new(case.name.bytes().map(u64::from).sum());
    let Some(name) = (!names.is_empty()).then(|| names[draw.below(names.len())].to_string_lossy().into_owned()) else {
        return Vec::new();
    };
    let (checkpoint, outcome) = open(made, case.deep, &[], knowledge);
    // A file that is not read leaves more of the budget to the others.
    if checkpoint.is_partial() {
        return Vec::new();
    }
    let before = outcome.verdicts;
    let outside = tempfile::tempdir().unwrap();
    let note = outside.path().join("note.txt");
    std::fs::write(&note, "no checkpoint").unwrap();
    std::fs::remove_file(made.join(&name)).unwrap();
    std::os::unix::fs::symlink(&note, made.join(&name)).unwrap();
    let after = verdicts(made, case, &[], knowledge);
    let is_needed = ["config.json", "model.safetensors", "model.safetensors.index.json"].contains(&name.as_str());
    let mut found = Vec::new();
    for (was, is) in before.iter().filter_map(|was| Some((was, after.iter().find(|is| is.loader == was.loader)?))) {
        for object in &is.objects {
            let before = was.objects.iter().find(|one| one.object == object.object);
            let old = before.map_or(LoadVerdict::NotPredicted, |object| object.verdict);
            let is_better = match object.verdict {
                LoadVerdict::Loads => old != LoadVerdict::Loads || is_needed && object.object == Object::Model,
                LoadVerdict::LoadsWrong => old == LoadVerdict::Raises,
                LoadVerdict::NotPredicted | LoadVerdict::Raises => false,
            };
            if is_better {
                let object = (object.object, object.verdict, &object.why);
                found.push(format!("{} without {name}, {}: {old:?} becomes {object:?}", case.name, is.version()));
            }
        }
    }
    found
}

/// A file that leads out of the directory is not read. Then nothing is said to load that did not load with it, what raised is
/// not said to load wrong, and a model does not load without the files that it is opened from.
#[cfg(unix)]
#[test]
fn what_is_not_read_makes_no_verdict_better() {
    let knowledge = knowledge();
    holds(4, |case, made| ignorance(case, made, &knowledge), &knowledge);
}

/// All rules as they are, and three drawn selections of half of them with other severities.
pub(super) struct Selections {
    whole: Knowledge,
    /// The codes that are left out, and the knowledge.
    drawn: Vec<(String, Knowledge)>,
}

impl Selections {
    pub(super) fn new(seed: u64) -> Self {
        let whole = knowledge();
        let codes: Vec<String> = whole.rules.rules.iter().map(|rule| rule.code.clone()).collect();
        let letters: BTreeSet<&str> = codes.iter().map(|code| &code[..1]).collect();
        let severities: Vec<(&str, Severity)> = letters.into_iter().map(|letter| (letter, Severity::Info)).collect();
        let mut draw = Draw::new(seed);
        let mut half = || codes.iter().filter(|_| draw.once_in(2)).cloned().collect::<Vec<String>>();
        let mut drawn: Vec<(String, Knowledge)> = Vec::new();
        for _ in 0..3 {
            let ignore = half();
            let mut knowledge = knowledge();
            knowledge.rules.regrade(&severities).unwrap();
            knowledge.rules.choose(&[Choice { ignore: ignore.clone(), ..Choice::default() }]).unwrap();
            drawn.push((ignore.join(","), knowledge));
        }
        Self { whole, drawn }
    }

    /// Law *selection*: what differs between the verdicts by all rules and by each selection.
    pub(super) fn differing(&self, case: &Case, made: &Path) -> Vec<String> {
        let by_all = verdicts(made, case, &[], &self.whole);
        let differing = |(words, knowledge): &(String, Knowledge)| {
            let selected = verdicts(made, case, &[], knowledge);
            let pairs = by_all.iter().zip(&selected).flat_map(|(one, other)| differences(one, other));
            pairs.map(|why| format!("{} {words}: {why}", case.name)).collect::<Vec<_>>()
        };
        self.drawn.iter().flat_map(differing).collect()
    }
}

#[test]
fn a_verdict_does_not_depend_on_the_selected_rules_and_their_severities() {
    let selections = Selections::new(20_261_125);
    holds(8, |case, made| selections.differing(case, made), &selections.whole);
}
