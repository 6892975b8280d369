//! The verdict on a loader depends on the files and that loader alone: neither on the other loaders of a run, nor on the rules
//! that are selected, nor on severities.

use std::collections::BTreeSet;
use std::path::Path;

use ckpt_doctor::check::Severity;
use ckpt_doctor::check::verdict::PredictedLoad;
use ckpt_doctor::knowledge::selection::Choice;
use ckpt_doctor::knowledge::{Knowledge, Loader};

use crate::support::{Case, Draw, knowledge, on_cases, open};

/// The verdicts of a run.
fn verdicts(made: &Path, case: &Case, named: &[&str], knowledge: &Knowledge) -> Vec<PredictedLoad> {
    let named: Vec<String> = named.iter().map(|version| (*version).to_owned()).collect();
    open(made, case.deep, &named, knowledge).1.verdicts
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

/// Tries a law on every fourth case, or with `CKPT_DOCTOR_LAWS` on every one, and fails with the exceptions.
fn holds(look: impl Fn(&Case, &Path) -> Vec<String> + Sync, knowledge: &Knowledge) {
    let wanted = |name: &str| super::cases(0) > 0 || name.bytes().map(usize::from).sum::<usize>() % 4 == 0;
    let tried = on_cases(knowledge, wanted, |_, case, made| look(case, made));
    assert!(tried.len() > 100, "{} cases", tried.len());
    let broken: Vec<String> = tried.into_iter().flat_map(|(_, broken)| broken).collect();
    assert!(broken.is_empty(), "{} broken:\n{}", broken.len(), broken.join("\n"));
}

#[test]
fn a_verdict_does_not_depend_on_the_other_loaders_of_the_run() {
    let knowledge = knowledge();
    let newest = ["4.57.6", "5.23.0"];
    let look = |case: &Case, made: &Path| -> Vec<String> {
        let mut found = Vec::new();
        for (named, words) in [(&[] as &[&str], "by default"), (&Loader::ALL.map(Loader::version), "with all")] {
            for among in verdicts(made, case, named, &knowledge) {
                // A loader may stand for the version that wrote the checkpoint, and be judged for its own as well.
                let own = [among.loader.as_str()].into_iter().filter(|own| newest.contains(own));
                let judged: Vec<&str> = match &among.stands_for {
                    Some(version) => std::iter::once(version.as_str()).chain(own).collect(),
                    None => vec![&among.loader],
                };
                let alone = verdicts(made, case, &judged, &knowledge);
                assert_eq!(alone.len(), 1, "{}: {judged:?}", case.name);
                let differing = differences(&alone[0], &among);
                let version = among.version();
                found.extend(differing.into_iter().map(|why| format!("{} {version} {words}: {why}", case.name)));
            }
        }
        found
    };
    holds(look, &knowledge);
}

#[test]
fn a_verdict_does_not_depend_on_the_selected_rules_and_their_severities() {
    let whole = knowledge();
    let codes: Vec<String> = whole.rules.rules.iter().map(|rule| rule.code.clone()).collect();
    let letters: BTreeSet<&str> = codes.iter().map(|code| &code[..1]).collect();
    let severities: Vec<(&str, Severity)> = letters.into_iter().map(|letter| (letter, Severity::Info)).collect();
    let mut draw = Draw::new(20_261_125);
    let mut half = || codes.iter().filter(|_| draw.once_in(2)).cloned().collect::<Vec<String>>();
    let mut drawn: Vec<(String, Knowledge)> = Vec::new();
    for _ in 0..3 {
        let ignore = half();
        let mut knowledge = knowledge();
        knowledge.rules.regrade(&severities).unwrap();
        knowledge.rules.choose(&[Choice { ignore: ignore.clone(), ..Choice::default() }]).unwrap();
        drawn.push((ignore.join(","), knowledge));
    }
    let look = |case: &Case, made: &Path| -> Vec<String> {
        let by_all = verdicts(made, case, &[], &whole);
        let differing = |(words, knowledge): &(String, Knowledge)| {
            let selected = verdicts(made, case, &[], knowledge);
            let pairs = by_all.iter().zip(&selected).flat_map(|(one, other)| differences(one, other));
            pairs.map(|why| format!("{} {words}: {why}", case.name)).collect::<Vec<_>>()
        };
        drawn.iter().flat_map(differing).collect()
    };
    holds(look, &whole);
}
