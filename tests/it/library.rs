//! The public interface of the crate, called as another crate calls it.

use std::fs;

use ckpt_doctor::{Checker, Dtype, Error, FaultKind, Merge, MergeStage, Severity, Shard};

use crate::support::project;

fn donor(name: &str) -> std::path::PathBuf {
    project().join("fixtures/donors").join(name)
}

#[test]
fn a_checker_predicts_the_load_of_the_version_named() {
    let checker = Checker::new().loader("4.50").expect("a version").deep(true);
    let report = checker.check(donor("llava3d-tiny")).expect("a checkpoint");
    assert!(report.findings.iter().all(|f| f.severity < Severity::Error), "{:?}", report.findings);
    let loads: Vec<_> = report.loads.iter().map(|l| (l.loader.as_str(), l.stands_for.as_deref())).collect();
    assert_eq!(loads, [("4.47.0", Some("4.50"))]);
    let missing = checker.check(donor("none")).expect_err("no directory");
    assert!(matches!(missing, Error::Open(_)) && missing.to_string().contains("none does not exist"), "{missing}");
}

#[test]
fn a_header_is_read_with_its_faults() {
    let shard = Shard::read_header(donor("llava3d-tiny").join("model-00001-of-00002.safetensors")).expect("a shard");
    let first = shard.tensors.first().expect("a tensor");
    assert!(shard.faults.is_empty() && first.dtype == Dtype::BF16 && !first.is_empty(), "{shard:?}");
    let place = tempfile::tempdir().expect("a directory");
    let file = place.path().join("cut.safetensors");
    assert!(matches!(Shard::read_header(&file), Err(Error::Open(_))));
    fs::write(&file, b"\x10\0\0").expect("written");
    let cut = Shard::read_header(&file).expect("a file");
    assert_eq!((cut.name.as_str(), cut.faults[0].kind), ("cut.safetensors", FaultKind::FileTooShort));
}

#[test]
fn a_merge_is_planned_then_run() {
    let place = tempfile::tempdir().expect("a directory");
    let out = place.path().join("merged");
    let merge =
        Merge::from_file(project().join("fixtures/merge.json5")).expect("a merge file").output(&out).hash_donors(true);
    let stage = |report: &ckpt_doctor::Report| report.merge.as_ref().and_then(|m| m.stage);
    assert_eq!(stage(&merge.plan().expect("a plan")), Some(MergeStage::DryRun));
    assert!(!out.exists());
    let report = merge.run().expect("a merge");
    assert_eq!(stage(&report), Some(MergeStage::Written));
    assert!(out.join("config.json").is_file() && report.to_json().contains("\"stage\": \"written\""));
    assert!(matches!(merge.run(), Err(Error::Write(_))), "the directory exists");

    let donors = || Merge::new(&out).donor("vision", donor("spatialvla-tiny")).donor("language", donor("llava3d-tiny"));
    assert!(matches!(donors().recipe("unknown").plan(), Err(Error::Data(_))));
    assert!(matches!(donors().option("unknown", "1").output(place.path().join("b")).plan(), Err(Error::Request(_))));
    assert!(matches!(Merge::from_file(place.path().join("none.json5")), Err(Error::Data(_))));
}
