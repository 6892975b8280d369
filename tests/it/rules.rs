//! Every rule on every fixture: each case is reported by its own rule, and the snapshot records findings of other
//! rules.

mod expressions;
pub mod failure_modes;
mod generation;
mod lets;
mod memory;
mod names;
mod objects;
mod peft;
mod refusals;
mod seeded;

use std::collections::BTreeSet;
use std::fmt::Write as _;

use crate::support::{Expect, Tried, tried};
use ckpt_doctor::check::finding::{Finding, Severity};
use ckpt_doctor::check::load::LoadReport;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::check::verdict::LoadVerdict;
use ckpt_doctor::check::{check, check_for};
use ckpt_doctor::checkpoint::{Checkpoint, FaultKind, FaultSource};

fn failures(of: impl Fn(&Tried) -> Option<String>) -> Vec<String> {
    tried().iter().filter_map(|t| of(t).map(|why| format!("{}: {why}\n  found {}", t.case.name, t.codes()))).collect()
}

fn shown(findings: &[&Finding]) -> String {
    let mut out = String::new();
    for finding in findings {
        let _ = write!(out, "\n    {} {} {}", finding.code, finding.severity.name(), finding.message);
        for place in finding.locations.iter().take(3) {
            let _ = write!(
                out,
                "\n      at {:?} line {:?} pointer {:?} tensor {:?}",
                place.file, place.line, place.pointer, place.tensor
            );
        }
    }
    out
}

fn mismatch(expect: &Expect, own: &[&Finding]) -> Option<String> {
    let at = |wanted: &Option<String>, of: &dyn Fn(&Finding) -> bool| wanted.is_some() && !own.iter().any(|f| of(f));
    let any = |f: &Finding, is: &dyn Fn(&ckpt_doctor::check::finding::Location) -> bool| f.locations.iter().any(is);
    let wrong = [
        (own.is_empty(), "the rule is silent"),
        (own.len() != expect.count.unwrap_or(1), "another number of findings"),
        (own.iter().any(|f| f.severity != expect.severity), "another severity"),
        (at(&expect.file, &|f| any(f, &|l| l.file == expect.file)), "the file is not named"),
        (at(&expect.tensor, &|f| any(f, &|l| l.tensor == expect.tensor)), "the tensor is not named"),
        (at(&expect.pointer, &|f| any(f, &|l| l.pointer == expect.pointer)), "the pointer is not named"),
        (expect.line.is_some() && !own.iter().any(|f| any(f, &|l| l.line == expect.line)), "the line is not named"),
        (at(&expect.says, &|f| f.message.contains(expect.says.as_deref().unwrap_or_default())), "the message differs"),
        (
            at(&expect.fix.map(|safety| safety.name().to_owned()), &|f| {
                f.fix.as_ref().map(|fix| fix.safety) == expect.fix
            }),
            "the fix has another safety",
        ),
    ];
    let reasons: Vec<&str> = wrong.iter().filter(|(wrong, _)| *wrong).map(|(_, reason)| *reason).collect();
    (!reasons.is_empty()).then(|| format!("{}{}", reasons.join(", "), shown(own)))
}

#[test]
fn each_case_is_reported_by_its_rule() {
    let wrong = failures(|t| mismatch(t.case.expect.as_ref()?, &t.own()));
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn reports_arrive_as_workers_send_them() {
    let lost = failures(|t| t.lost.clone());
    assert!(lost.is_empty(), "{}", lost.join("\n"));
}

#[test]
fn no_rule_reports_the_base_of_its_case() {
    let wrong = failures(|t| {
        let code = t.case.code.as_ref()?;
        t.before.contains(code).then(|| "the base trips the rule already".to_owned())
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn sound_checkpoints_have_no_finding_above_info() {
    let wrong = failures(|t| {
        let loud: Vec<&Finding> = t.outcome.findings.iter().filter(|f| f.severity > Severity::Info).collect();
        (t.case.code.is_none() && !loud.is_empty()).then(|| shown(&loud))
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The tensors of a quantised checkpoint replace those of the class, so the predicted load is clean.
#[test]
fn quantised_checkpoints_load_clean() {
    let quantised = |t: &&Tried| t.case.name.starts_with("sound/quantized-");
    let dirty: Vec<String> = tried()
        .iter()
        .filter(quantised)
        .filter(|t| t.outcome.loads.iter().any(|load| !is_clean(load)))
        .map(|t| format!("{}: {:?}", t.case.name, t.outcome.loads))
        .collect();
    assert!(dirty.is_empty(), "{}", dirty.join("\n"));
    let loaded = tried().iter().filter(quantised).filter(|t| !t.outcome.loads.is_empty()).count();
    assert!(loaded >= 10, "{loaded} quantised cases have a load report");
}

fn is_clean(load: &LoadReport) -> bool {
    let names = load.missing.is_empty() && load.unexpected.is_empty();
    names && load.mismatched.is_empty() && load.silent.is_empty() && load.raises.is_none()
}

/// Whether a text is empty or contains a character that only a failed template has. Quotations of evidence may contain
/// such characters: the loader's own sentence, the start of a file.
fn broken(finding: &Finding, text: &str, of: &[char]) -> bool {
    let quoted = |c: char| finding.evidence.values().filter_map(|v| v.as_str()).map(|v| v.matches(c).count()).sum();
    text.trim().is_empty() || of.iter().any(|c| text.matches(*c).count() > quoted(*c))
}

#[test]
fn messages_render_in_full() {
    let wrong = failures(|t| {
        let own = t.own();
        let bad: Vec<&Finding> = own
            .into_iter()
            // A fix may contain JSON; a message never does.
            .filter(|f| {
                broken(f, &f.message, &['?', '{', '}'])
                    || f.fix.as_ref().is_some_and(|fix| broken(f, fix.title(), &['?']))
            })
            .collect();
        (!bad.is_empty()).then(|| shown(&bad))
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Verdicts, findings and the exit code agree: a verdict rests on findings, and an error on a verdict or a harm.
#[test]
fn verdicts_rest_on_findings() {
    let rules = crate::support::rules();
    let wrong = failures(|t| {
        let mut bad = Vec::new();
        for load in &t.outcome.verdicts {
            for object in &load.objects {
                if object.verdict > LoadVerdict::NotPredicted && object.findings.is_empty() {
                    bad.push(format!("{} {object:?}", load.loader));
                }
                if object.verdict != LoadVerdict::Loads && object.why.as_deref().is_none_or(str::is_empty) {
                    bad.push(format!("{} has no reason: {object:?}", load.loader));
                }
            }
        }
        let errors = t.outcome.findings.iter().filter(|f| f.severity == Severity::Error);
        for finding in errors.filter(|f| rules.find(&f.code).is_ok_and(|rule| rule.harm.is_none())) {
            if t.outcome.verdicts.iter().all(|load| load.verdict <= LoadVerdict::NotPredicted) {
                bad.push(format!("{} is an error, and every verdict is better", finding.code));
            }
        }
        (!bad.is_empty()).then(|| bad.join("\n    "))
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Every effect is rendered, and a finding that is an error has an effect or its rule a harm.
#[test]
fn errors_state_their_effects() {
    let rules = crate::support::rules();
    let harmful = |f: &Finding| rules.find(&f.code).is_ok_and(|rule| rule.harm.is_some());
    let wrong = failures(|t| {
        // Settings of the case may change severities.
        let findings = || t.outcome.findings.iter().filter(|_| t.case.settings.is_none());
        let bare = findings().filter(|f| f.severity == Severity::Error && f.effects.is_empty() && !harmful(f));
        let broken = findings().filter(|f| f.effects.iter().any(|e| broken(f, &e.text, &['?', '{', '}'])));
        let bad: Vec<&Finding> = bare.chain(broken).collect();
        (!bad.is_empty()).then(|| format!("{}\n{:?}", shown(&bad), bad.iter().map(|f| &f.effects).collect::<Vec<_>>()))
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The severity of one fault follows the loaders of the run: `--for`, or the version that wrote config.json.
#[test]
fn severity_follows_the_loaders_of_the_run() {
    let room = tempfile::tempdir().expect("a directory");
    let drop = r#"{ header_drop: { file: "model.safetensors", at: "/__metadata__" } }"#;
    let found = |dir: &std::path::Path, versions: &[&str]| {
        let versions: Vec<String> = versions.iter().map(|v| (*v).to_owned()).collect();
        let checkpoint = Checkpoint::open(dir).expect("a checkpoint").into();
        let outcome = check_for(&checkpoint, &crate::support::knowledge(), &RunOptions::for_versions(&versions));
        let finding = outcome.findings.into_iter().find(|f| f.code == "SAF009").expect("SAF009");
        let loaders = finding.effects.into_iter().map(|e| (e.loader, e.stands_for));
        (finding.severity, loaders.collect::<Vec<_>>())
    };
    let own = |stands_for: Option<&str>| vec![("4.47.0".to_owned(), stands_for.map(str::to_owned))];
    let dir = crate::support::made("llama", &format!("[{drop}]"), room.path());
    for (versions, severity, effects) in [
        (&[] as &[&str], Severity::Error, own(None)),
        (&["5.23.0"], Severity::Info, Vec::new()),
        (&["5.23.0", "4.50.1"], Severity::Error, own(Some("4.50.1"))),
        (&["4.57.6"], Severity::Info, Vec::new()),
    ] {
        assert_eq!(found(&dir, versions), (severity, effects), "{versions:?}");
    }
}

/// Weights for another program are an error only for who asks whether transformers loads them. It raises in any case.
#[test]
fn weights_of_another_program_are_an_error_when_transformers_is_named() {
    let room = tempfile::tempdir().expect("a directory");
    let set = r#"{ set: { file: "config.json", at: "/KEY", to: { bits: 4, group_size: 8 } } }"#;
    let keys = [set.replace("KEY", "quantization"), set.replace("KEY", "quantization_config")];
    let pack = r#"{ pack: { ending: "_proj.weight", into: [[".weight", "U32", ["rows", "cols / 8"]], [".scales", "BF16", ["rows", "cols / 8"]], [".biases", "BF16", ["rows", "cols / 8"]]] } }"#;
    let dir = crate::support::made("llama", &format!("[{}, {}, {pack}]", keys[0], keys[1]), room.path());
    for (versions, severity) in [(Vec::new(), Severity::Info), (vec!["5.23.0".to_owned()], Severity::Error)] {
        let checkpoint = Checkpoint::open(&dir).expect("a checkpoint").into();
        let outcome = check_for(&checkpoint, &crate::support::knowledge(), &RunOptions::for_versions(&versions));
        let finding = outcome.findings.iter().find(|f| f.code == "QNT010").expect("QNT010");
        assert_eq!(finding.severity, severity, "{versions:?}");
        assert!(outcome.verdicts.iter().all(|load| load.verdict == LoadVerdict::Raises), "{:?}", outcome.verdicts);
    }
}

/// What a nearby version predicts is an error for a version that the user named.
#[test]
fn a_finding_that_rests_on_a_nearby_version_is_an_error_for_a_named_one() {
    let room = tempfile::tempdir().expect("a directory");
    let old = r#"{ set: { file: "config.json", at: "/transformers_version", to: "4.40.0" } }"#;
    let dir = crate::support::made("llama", &format!(r#"[{old}, {{ drop_tensors: "model.norm." }}]"#), room.path());
    for (versions, severity) in [
        (&["4.40.0"] as &[&str], Severity::Error),
        (&["4.47.0"], Severity::Error),
        (&["4.40.0", "5.23.0"], Severity::Error),
        (&[], Severity::Error),
    ] {
        let versions: Vec<String> = versions.iter().map(|v| (*v).to_owned()).collect();
        let checkpoint = Checkpoint::open(&dir).expect("a checkpoint").into();
        let outcome = check_for(&checkpoint, &crate::support::knowledge(), &RunOptions::for_versions(&versions));
        let missing = outcome.findings.iter().find(|f| f.code == "ARC003").expect("ARC003");
        assert_eq!(missing.severity, severity, "{versions:?}");
        assert!(outcome.verdicts.iter().all(|load| load.verdict == LoadVerdict::LoadsWrong), "{:?}", outcome.verdicts);
    }
}

/// Code in the directory may build another class than transformers has: where the tensors differ, nothing is predicted.
#[test]
fn differences_from_a_class_with_code_in_the_directory_are_not_predicted() {
    let room = tempfile::tempdir().expect("a directory");
    let auto_map = r#"{ set: { file: "config.json", at: "/auto_map", to: { AutoModelForCausalLM: "modeling_own.LlamaForCausalLM" } } }"#;
    let code = r#"{ write: { file: "modeling_own.py", bytes: "class LlamaForCausalLM: pass" } }"#;
    let drop = r#"{ drop_tensors: "model.norm." }"#;
    for (name, changes, verdict) in [
        ("whole", format!("[{auto_map}, {code}]"), LoadVerdict::Loads),
        ("norm-dropped", format!("[{auto_map}, {code}, {drop}]"), LoadVerdict::NotPredicted),
        ("without-code", format!("[{drop}]"), LoadVerdict::LoadsWrong),
    ] {
        let dir = crate::support::made("llama", &changes, &room.path().join(name));
        let outcome = check(&Checkpoint::open(&dir).expect("a checkpoint").into(), &crate::support::knowledge());
        let verdicts: Vec<_> = outcome.verdicts.iter().map(|load| load.verdict).collect();
        assert!(verdicts.iter().all(|one| *one == verdict), "{name}: {:?}", outcome.verdicts);
    }
}

/// The donor has the same faults as the published checkpoints: three `Infinity`.
#[test]
fn the_donor_has_three_infinities() {
    let donor = crate::support::project().join("fixtures/donors/spatialvla-tiny");
    let outcome = check(&Checkpoint::open(donor).expect("the donor").into(), &crate::support::knowledge());
    let loud: Vec<_> = outcome.findings.iter().filter(|f| f.severity > Severity::Info).collect();
    let places: Vec<_> =
        loud.iter().map(|f| (&*f.code, f.locations[0].line, f.locations[0].pointer.as_deref())).collect();
    let std = |i: usize| {
        Some(
            [
                "/statistics/rh20t_rlds~11.0.0/action/std/0",
                "/statistics/rh20t_rlds~11.0.0/action/std/1",
                "/statistics/rh20t_rlds~11.0.0/action/std/2",
            ][i],
        )
    };
    assert_eq!(
        places,
        [("JSN001", Some(128), std(0)), ("JSN001", Some(129), std(1)), ("JSN001", Some(130), std(2))],
        "{}",
        shown(&loud)
    );
}

#[test]
fn every_kind_of_a_comparison_is_produced_by_some_case() {
    let produced: BTreeSet<FaultKind> = tried().iter().flat_map(|t| &t.kinds).copied().collect();
    let comparisons = FaultKind::ALL.iter().filter(|kind| kind.source() == FaultSource::Comparison);
    let never: Vec<&FaultKind> = comparisons.filter(|kind| !produced.contains(kind)).collect();
    assert!(never.is_empty(), "{never:?}");
}

/// Every rule on every case. The snapshot shows new findings on cases of other rules.
#[test]
fn cross_fire() {
    let mut matrix = String::new();
    for t in tried() {
        let _ = writeln!(matrix, "{}: {}", t.case.name, t.codes());
    }
    snapshot!("cross-fire", matrix.trim_end());
}
