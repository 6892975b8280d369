//! Predicted load reports, compared with the messages of transformers 4.47.0 for the same files.

use ckpt_doctor::check::load::LoadReport;
use ckpt_doctor::check::load::{Stored, predict};
use ckpt_doctor::knowledge::{Library, Loader};

use crate::support::data::{Load, Map, Record, records};

/// Compares one report; `None` when it matches.
fn difference(record: &Record, stored: Map, load: &Load) -> Option<String> {
    let library = Library::embedded();
    let stored = Stored::from_shapes(stored);
    let evidence = stored.evidence();
    let architecture = library.find(&record.config, stored.names(), Loader::V4_47_0).expect("a known class");
    let expected = architecture.expect_given(&record.config, &evidence).unwrap_or_else(|e| panic!("{e:?}"));
    let report: LoadReport = predict(&expected, &stored);
    if load.error.is_some() || report.raises.is_some() {
        return (load.error != report.raises).then(|| format!("raises {:?}, not {:?}", report.raises, load.error));
    }
    let mut mismatched: Vec<_> = load.mismatched.clone();
    mismatched.sort();
    let mut predicted: Vec<_> = report.mismatched.into_iter().map(|m| (m.name, m.stored, m.expected)).collect();
    predicted.sort();
    let same = report.missing == load.missing && report.unexpected == load.unexpected && predicted == mismatched;
    (!same)
        .then(|| format!("missing {:?}, unexpected {:?}, mismatched {predicted:?}", report.missing, report.unexpected))
}

#[test]
fn predictions_match_the_loader_on_the_sample() {
    let (mut loads, mut wrong) = (0, Vec::new());
    for record in records("sample") {
        let saved = record.saved();
        let load = record.load.as_ref().expect("the sample has loads");
        let mutations = record.mutations.iter().map(|m| (m.kind.as_str(), m.apply(&saved), &m.load));
        for (kind, stored, load) in std::iter::once(("saved", saved.clone(), load)).chain(mutations) {
            loads += 1;
            wrong.extend(difference(&record, stored, load).map(|d| format!("{} {kind}: {d}", record.class)));
        }
    }
    assert!(wrong.is_empty(), "{} of {loads}: {wrong:#?}", wrong.len());
    assert_eq!(loads, 40, "8 classes, each saved and with 4 mutations");
}
