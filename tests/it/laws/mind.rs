//! Law *one mind*: `expect`, `check`, the planned checks of repairs and of merges know and refuse the same things.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use ckpt_doctor::HashAlgorithm;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::check::verdict::{LoadVerdict, PredictedLoad};
use ckpt_doctor::check::{Outcome, check, check_for};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::rule::Object;
use ckpt_doctor::knowledge::{Expected, Knowledge, Loader};
use ckpt_doctor::merge::{self, MergeRequest};
use ckpt_doctor::surgery::RepairError;
use ckpt_doctor::surgery::repair::plan;
use serde_json::Value;

use super::form::copy_whole;
use super::mutants::{ELEMENTS, Grounds, add_key, change_document, mutate, shrink};
use super::{cases, seed};
use crate::support::weights::{Shard, Weights};
use crate::support::{Draw, knowledge, look, program, project};

/// What `expect --for VERSION` says of each config, and the tensors of the class where it builds one.
fn expected(configs: &[Value], version: &str, room: &Path) -> Vec<Value> {
    let lines: Vec<String> = configs.iter().map(|config| serde_json::json!({ "config": config }).to_string()).collect();
    let file = room.join(format!("{version}.jsonl"));
    fs::write(&file, lines.join("\n")).unwrap();
    let mut command = program();
    command.args(["expect", "--output-format", "jsonl", "--for", version]).arg(format!("@{}", file.display()));
    let output = command.output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Writes a directory with a config and the tensors of its class; another tensor where it has none, or too large ones.
fn write(dir: &Path, config: &Value, version: &str, knowledge: &Knowledge) -> bool {
    fs::create_dir_all(dir).unwrap();
    fs::write(dir.join("config.json"), config.to_string()).unwrap();
    let class = knowledge.library.stands_for(version, config, &[]);
    let class: Option<Expected> = class.and_then(|(_, architecture)| architecture.expect(config).ok());
    let mut shard = Shard::new("model.safetensors");
    let elements = |shape: &[u64]| shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d)).unwrap_or(u64::MAX);
    let mut total = 0_u64;
    for (name, tensor) in class.iter().flat_map(|class| &class.tensors).filter(|(_, tensor)| tensor.tied_to.is_none()) {
        total = total.saturating_add(elements(&tensor.shape));
        if total > ELEMENTS[1] {
            return false;
        }
        shard.add(name, "F32", &tensor.shape);
    }
    if shard.tensors.is_empty() {
        shard.add("x", "F32", &[1]);
    }
    Weights { shards: vec![shard] }.write(dir);
    true
}

/// A published config made small, changed in one or two places.
fn drawn(grounds: &Grounds, draw: &mut Draw, room: &Path) -> Value {
    let (_, config) = &grounds.configs[draw.below(grounds.configs.len())];
    let mut config = config.clone();
    shrink(&mut config, "");
    // Quantised weights have other tensors than the class.
    if let Some(config) = config.as_object_mut() {
        config.shift_remove("quantization_config");
    }
    let dir = room.join("drawn");
    fs::create_dir_all(&dir).unwrap();
    fs::write(dir.join("config.json"), config.to_string()).unwrap();
    for _ in 0..=draw.below(2) {
        if draw.once_in(5) {
            add_key(&dir, grounds, draw);
        } else {
            change_document(&dir, "config.json", draw);
        }
    }
    serde_json::from_slice(&fs::read(dir.join("config.json")).unwrap()).unwrap()
}

/// Where `expect` and the verdict of `check` on a directory with these tensors disagree.
fn disagreement(answer: &Value, verdict: LoadVerdict) -> bool {
    let (fails, open) =
        (answer.get("error").is_some(), answer["not_predicted"].as_array().is_some_and(|list| !list.is_empty()));
    match verdict {
        LoadVerdict::Raises => !fails,
        LoadVerdict::NotPredicted => !fails && !open,
        LoadVerdict::Loads => fails,
        // A class without a layer is built, and is no answer of `expect`.
        LoadVerdict::LoadsWrong => false,
    }
}

#[test]
fn expect_fails_where_check_says_that_the_model_raises_or_is_unknown() {
    let (knowledge, grounds) = (knowledge(), Grounds::new());
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let mut draw = Draw::new(seed(20_261_126));
    let configs: Vec<Value> = (0..cases(40)).map(|_| drawn(&grounds, &mut draw, room.path())).collect();
    let (mut broken, mut compared) = (Vec::new(), 0);
    for loader in Loader::ALL {
        let version = loader.version();
        let answers = expected(&configs, version, room.path());
        assert_eq!(answers.len(), configs.len());
        for (config, answer) in configs.iter().zip(&answers) {
            let dir = room.path().join("checkpoint");
            // Code of the directory is no part of the config that `expect` is asked for.
            let goes_beyond = ["quantization_config", "auto_map"].iter().any(|key| config.get(key).is_some());
            if goes_beyond || !write(&dir, config, version, &knowledge) {
                continue;
            }
            let checkpoint = Arc::new(Checkpoint::open(&dir).unwrap());
            let outcome = check_for(&checkpoint, &knowledge, &RunOptions::for_versions(&[version.to_owned()]));
            let objects = outcome.verdicts.iter().flat_map(|load| &load.objects);
            let model = objects.into_iter().find(|object| object.object == Object::Model).unwrap();
            compared += 1;
            if disagreement(answer, model.verdict) {
                let said = answer
                    .get("error")
                    .map_or_else(|| format!("not predicted {}", answer["not_predicted"]), Value::to_string);
                broken.push(format!("{version} {:?} {:?}; expect: {said}; {config}", model.verdict, model.why));
            }
        }
    }
    assert!(compared > configs.len(), "{compared} were compared");
    println!("{compared} configs were compared");
    assert!(broken.is_empty(), "{} of {compared} broken:\n{}", broken.len(), broken.join("\n"));
}

/// Findings and verdicts, as text: what a plan and its result must have in common.
fn answer(outcome: &Outcome) -> Vec<String> {
    let finding =
        |finding: &ckpt_doctor::check::Finding| format!("{} {:?} {}", finding.code, finding.severity, finding.message);
    let objects = |load: &PredictedLoad| {
        load.objects
            .iter()
            .map(|o| format!("{} {:?} {:?} {:?}", o.object.name(), o.verdict, o.why, o.findings))
            .collect::<Vec<_>>()
            .join(", ")
    };
    let verdict = |load: &PredictedLoad| format!("{}: {:?} {}", load.version(), load.verdict, objects(load));
    let mut all: Vec<String> =
        outcome.findings.iter().map(finding).chain(outcome.verdicts.iter().map(verdict)).collect();
    all.sort();
    all
}

fn differences(planned: &Outcome, written: &Outcome) -> Vec<String> {
    let (planned, written) = (answer(planned), answer(written));
    let lost = planned.iter().filter(|line| !written.contains(line)).map(|line| format!("planned {line}"));
    let new = written.iter().filter(|line| !planned.contains(line)).map(|line| format!("written {line}"));
    lost.chain(new).collect()
}

/// What differs between a planned repair of a mutant and the directory that it wrote; `None` without a fix.
fn repaired(number: u64, grounds: &Grounds, knowledge: &Knowledge) -> Option<Vec<String>> {
    let mut draw = Draw::new(number);
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let (case, made) = grounds.make(&mut draw, room.path(), knowledge)?;
    let changes = mutate(&made, false, grounds, &mut draw);
    let judge = |checkpoint: &Arc<Checkpoint>| check(checkpoint, knowledge);
    // As the directory is read below.
    let mut checkpoint = Checkpoint::open(&made).unwrap();
    checkpoint.expect_lfs_pointers(&|top| Some(top) == made.parent());
    let checkpoint = Arc::new(checkpoint);
    let repair = plan(&checkpoint, judge(&checkpoint), draw.once_in(2), &judge);
    if repair.changes.is_empty() {
        return None;
    }
    match ckpt_doctor::surgery::journal::write(&repair, &crate::support::user(), &|_| {}) {
        // What an interrupted run left is not touched.
        Err(RepairError::Linked { .. } | RepairError::ForeignJournal { .. } | RepairError::Busy { .. }) => return None,
        other => drop(other.unwrap()),
    }
    let written = look(&made, false, knowledge);
    let name = format!("{number} {} {}", case.name, changes.join("; "));
    let codes: Vec<&str> = repair.fixed.iter().map(|fixed| fixed.code.as_str()).collect();
    Some(differences(&repair.outcome, &written).into_iter().map(|why| format!("{name}: {codes:?}: {why}")).collect())
}

#[test]
fn the_check_of_a_planned_repair_is_that_of_the_written_directory() {
    let (knowledge, grounds, first) = (knowledge(), Grounds::new(), seed(20_261_126));
    let each = (0..cases(120))
        .map(|number| repaired(first.wrapping_mul(1_000_003).wrapping_add(number), &grounds, &knowledge));
    let repairs: Vec<Vec<String>> = each.flatten().collect();
    let broken: Vec<String> = repairs.iter().flatten().cloned().collect();
    println!("{} repairs were compared", repairs.len());
    assert!(!repairs.is_empty());
    assert!(broken.is_empty(), "{} broken:\n{}", broken.len(), broken.join("\n"));
}

/// What differs between the check of a planned merge and that of the written one; `None` when it stops before.
fn merged(draw: &mut Draw, grounds: &Grounds, knowledge: &Knowledge) -> Option<Vec<String>> {
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let donors = [("vision", "spatialvla-tiny"), ("language", "llava3d-tiny")];
    for (role, name) in donors {
        assert!(copy_whole(&project().join("fixtures/donors").join(name), &room.path().join(role)));
    }
    let dir = room.path().join(draw.one(&["vision", "language"]));
    let documents = ["config.json", "tokenizer_config.json", "generation_config.json", "preprocessor_config.json"];
    let change =
        if draw.once_in(3) { add_key(&dir, grounds, draw) } else { change_document(&dir, draw.one(&documents), draw) }?;
    let out = room.path().join("merged");
    let options: [&[(&str, &str)]; 3] =
        [&[], &[("tokenizer", "baked")], &[("layout", "wrapped"), ("spatial", "off"), ("zoe", "off")]];
    let options = draw.one(&options).iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
    let donors = donors.map(|(role, _)| (role.to_owned(), room.path().join(role))).into();
    let request = MergeRequest {
        recipe: None,
        donors,
        options,
        versions: Vec::new(),
        tolerate: Vec::new(),
        out: out.clone(),
        dry_run: false,
        hash: HashAlgorithm::default(),
        hash_donors: false,
    };
    let run = merge::run(&request, knowledge, &|_, _| {}).ok()?;
    if !out.is_dir() {
        return None;
    }
    let [.., planned, written] = &run.checked[..] else { return None };
    let again = look(&out, false, knowledge);
    let of_plan = differences(&planned.outcome, &written.outcome);
    let of_check = differences(&written.outcome, &again).into_iter().map(|why| format!("again {why}"));
    Some(of_plan.into_iter().chain(of_check).map(|why| format!("{change}: {why}")).collect())
}

#[test]
fn the_check_of_a_planned_merge_is_that_of_the_written_directory() {
    let (knowledge, grounds) = (knowledge(), Grounds::new());
    let mut draw = Draw::new(seed(20_261_126));
    let merges: Vec<Vec<String>> = (0..cases(12)).filter_map(|_| merged(&mut draw, &grounds, &knowledge)).collect();
    let broken: Vec<String> = merges.iter().flatten().cloned().collect();
    println!("{} merges were compared", merges.len());
    assert!(!merges.is_empty());
    assert!(broken.is_empty(), "{} broken:\n{}", broken.len(), broken.join("\n"));
}
