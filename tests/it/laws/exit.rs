//! The exit code follows the verdict of the loaders that the user named, known or between two known ones, in every format.

use std::path::Path;
use std::sync::atomic::Ordering;

use ckpt_doctor::check::verdict::{LoadVerdict, PredictedLoad};
use ckpt_doctor::check::{Outcome, Severity};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::report::model::CheckpointReport;
use ckpt_doctor::report::{self, Format, Report, Style};
use serde_json::Value;

use super::verdicts::{COMPARED, holds};
use crate::support::{Case, knowledge, on_cases, open};

/// Values of `--for`: none, each known version, and versions that a known one stands for.
const NAMED: [&str; 7] = ["", "4.47.0", "4.57.6", "5.23.0", "5.20", "4.57.3", "4.51.3"];

/// What is wrong with the answer for one directory; `format_of` is the number of the version whose formats are compared.
fn broken(checkpoint: &Checkpoint, outcome: &Outcome, named: bool, formats: bool) -> Vec<String> {
    let mut broken = Vec::new();
    let is_error = outcome.findings.iter().any(|finding| finding.severity == Severity::Error);
    let fails = |load: &&PredictedLoad| {
        load.objects.iter().any(|o| matches!(o.verdict, LoadVerdict::Raises | LoadVerdict::LoadsWrong))
    };
    let failing: Vec<String> = outcome.verdicts.iter().filter(fails).map(PredictedLoad::version).collect();
    if named && !failing.is_empty() && !is_error {
        broken.push(format!("fails with {}, and no finding is an error", failing.join(", ")));
    }
    if formats {
        let report = Report::new(vec![CheckpointReport::new("model", None, checkpoint, outcome)], None);
        let shown = |format| report::render(&report, format, Style::default());
        for (format, words) in [
            (Format::Full, "error["),
            (Format::Concise, "error["),
            (Format::Json, "\"severity\": \"error\""),
            (Format::Jsonl, "\"severity\":\"error\""),
            (Format::Github, "::error"),
            (Format::Gitlab, "\"severity\": \"major\""),
            (Format::Sarif, "\"level\": \"error\""),
        ] {
            if shown(format).contains(words) != is_error {
                broken.push(format!("{format:?} has {words}: {}, but an error: {is_error}", !is_error));
            }
        }
    }
    broken
}

/// Law *exit*: what is wrong with the answers for one directory, by the versions that are named.
pub(super) fn exit(case: &Case, made: &Path, knowledge: &Knowledge) -> Vec<String> {
    let mut all = Vec::new();
    for (number, version) in NAMED.iter().enumerate() {
        let named: Vec<String> = [version].iter().filter(|v| !v.is_empty()).map(|v| (**v).to_owned()).collect();
        let (checkpoint, outcome) = open(made, case.deep, &named, knowledge);
        COMPARED.fetch_add(outcome.verdicts.len(), Ordering::Relaxed);
        let formats = case.name.len() % NAMED.len() == number;
        let wrong = broken(&checkpoint, &outcome, !named.is_empty(), formats);
        all.extend(wrong.into_iter().map(|why| format!("{} --for {version:?}: {why}", case.name)));
    }
    all
}

#[test]
fn the_exit_code_follows_the_loaders_that_were_named() {
    let knowledge = knowledge();
    // An adapter is judged by versions of PEFT.
    let look = |case: &Case, made: &Path| {
        if case.name.starts_with("ADP") { Vec::new() } else { exit(case, made, &knowledge) }
    };
    holds(8, look, &knowledge);
}

/// A version that nobody read is judged as the nearest known one: the verdict, the severities and so the exit code.
#[test]
fn a_version_between_is_judged_as_the_one_that_stands_for_it() {
    let room = tempfile::tempdir().unwrap();
    super::base(room.path());
    let config = room.path().join("config.json");
    let mut value: Value = serde_json::from_slice(&std::fs::read(&config).unwrap()).unwrap();
    value["num_hidden_layers"] = 5.into();
    std::fs::write(&config, value.to_string()).unwrap();
    let knowledge = knowledge();
    for version in ["5.20", "4.57.3", "4.51.3", "4.44", "5.23.0"] {
        let (_, outcome) = open(room.path(), false, &[version.to_owned()], &knowledge);
        let worst = outcome.findings.iter().map(|finding| finding.severity).max();
        assert_eq!(worst, Some(Severity::Error), "{version}");
        assert_eq!(outcome.verdicts.first().unwrap().verdict, LoadVerdict::LoadsWrong, "{version}");
    }
    // Without a name, a load that is near to the writer's version alone is a warning, as before.
    let (_, outcome) = open(room.path(), false, &[], &knowledge);
    assert!(outcome.findings.iter().any(|finding| finding.severity == Severity::Error));
}

/// A program is judged alike whichever versions of transformers are named, and raises exactly where a finding says so.
#[test]
fn what_a_program_refuses_is_its_verdict() {
    let knowledge = knowledge();
    let wanted = |name: &str| {
        ["ARC009/", "ARC018/", "IDX009/", "IDX010/", "SRV003/", "sound/quantized", "base/"]
            .iter()
            .any(|start| name.starts_with(start))
    };
    let look = |case: &Case, made: &Path| -> (usize, Vec<String>) {
        let (mut raising, mut broken) = (0, Vec::new());
        for program in ["vllm", "mlx-lm"] {
            let mut verdicts = Vec::new();
            for named in ["", "4.47.0", "5.23.0", "all"] {
                let named = [named].into_iter().filter(|named| !named.is_empty()).map(ToOwned::to_owned);
                let named: Vec<String> = named.chain([program.to_owned()]).collect();
                let (_, outcome) = open(made, case.deep, &named, &knowledge);
                let load = outcome.verdicts.iter().find(|load| load.loader.starts_with(program)).unwrap();
                let is_told = outcome.findings.iter().any(|finding| finding.code == "SRV003");
                if is_told && load.verdict != LoadVerdict::Raises {
                    broken.push(format!("{} --for {named:?}: SRV003, and {:?}", case.name, load.verdict));
                }
                raising += usize::from(is_told);
                verdicts.push(load.verdict);
            }
            if verdicts.iter().any(|verdict| *verdict != verdicts[0]) {
                broken.push(format!("{} {program}: {verdicts:?}", case.name));
            }
        }
        (raising, broken)
    };
    let tried = on_cases(&knowledge, wanted, |_, case, made| look(case, made));
    assert!(tried.iter().any(|(case, (raising, _))| case.name.starts_with("ARC009/") && *raising > 0));
    let broken: Vec<String> = tried.into_iter().flat_map(|(_, (_, broken))| broken).collect();
    assert!(broken.is_empty(), "{} broken:\n{}", broken.len(), broken.join("\n"));
}
