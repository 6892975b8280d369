//! Thirty-two defects in a tiny Llama and a tiny SpatialVLA (`fixtures/seeded.json5`): each is reported by the rule for
//! its cause.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use crate::support::{Seeded, seeded};
use ckpt_doctor::check::finding::{Finding, Severity};

/// Findings above info, one per line.
fn shown(findings: &[&Finding]) -> String {
    let mut out = String::new();
    for f in findings {
        let _ = write!(out, "\n    {} {} {}", f.code, f.severity.name(), f.message);
    }
    out
}

/// The difference between the findings and those expected for the defect.
fn mismatch(seeded: &Seeded, loud: &[&Finding]) -> Option<String> {
    let own: Vec<&&Finding> = loud.iter().filter(|f| f.code == seeded.code).collect();
    if own.is_empty() {
        return Some(format!("{} is silent", seeded.code));
    }
    if !own.iter().all(|f| f.message.contains(&seeded.says)) {
        return Some(format!("the message of {} lacks {:?}", seeded.code, seeded.says));
    }
    if own.len() != seeded.count {
        return Some(format!("{} findings of {}, not {}", own.len(), seeded.code, seeded.count));
    }
    let others: BTreeSet<&str> = loud.iter().map(|f| f.code.as_str()).filter(|code| *code != seeded.code).collect();
    let follow: BTreeSet<&str> = seeded.also.iter().map(String::as_str).collect();
    (others != follow).then(|| format!("besides it {others:?}, not {follow:?}"))
}

#[test]
fn every_defect_is_reported_by_its_cause() {
    let all = seeded();
    let mut wrong = Vec::new();
    for (seeded, outcome) in &all.tried {
        // A defect in a file that no loader opens is information.
        let is_loud = |f: &&Finding| f.severity > Severity::Info || f.code == seeded.code;
        let loud: Vec<&Finding> = outcome.findings.iter().filter(is_loud).collect();
        if let Some(why) = mismatch(seeded, &loud) {
            wrong.push(format!("{} in {}: {why}{}", seeded.defect, seeded.model, shown(&loud)));
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
    assert_eq!(all.defects, 32);
    // Two defects need a processor, which the Llama lacks.
    assert_eq!(all.tried.len(), 2 * 32 - 2);
}

#[test]
fn the_sound_models_have_no_findings() {
    for (model, outcome) in &seeded().sound {
        let loud: Vec<&Finding> = outcome.findings.iter().filter(|f| f.severity > Severity::Info).collect();
        assert!(loud.is_empty(), "{model}{}", shown(&loud));
    }
}
