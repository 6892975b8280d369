//! Predicts the load of a checkpoint for each loader, and the faults that follow from the predictions.
//!
//! ```text
//! config, names ── resolve_targets ──> TargetClass ── build_classes ──> BuiltClass ── predict ──> Prediction
//!                                                                                                     │
//!                                        Judgement <── faults ── ExplainedLoad <── explain ───────────┘
//! ```
//!
//! A target is a version of transformers. Each stage takes the list of one type and returns that of the next.

mod classes;
mod explain;
mod faults;
mod integers;
mod predict;
#[cfg(test)]
mod tests;
mod unscaled;

use std::cell::RefCell;

use serde_json::Value;

use explain::FoundCauses;

use super::load::{self, LoadReport, Stored, Target};
use super::votes::Vote;
use crate::checkpoint::{Checkpoint, Fault};
use crate::knowledge::{Architecture, Expected, Knowledge, Loader, Refusal};

use crate::knowledge::quantization::{DeclaredScheme, declared_scheme, scheme_read};

/// The predictions for all loaders, and what rules take from them.
#[derive(Debug, Default)]
pub struct Judgement {
    /// The architecture of the first target; `None` for an unknown class.
    pub architecture: Option<String>,
    /// The config with the defaults of the class, as the first loader resolves it; null for an unknown class.
    pub config: Value,
    /// A report for each loader.
    pub loads: Vec<LoadReport>,
    /// The versions of transformers that have the class.
    pub targets: Vec<Target>,
    /// For each other loader that was tried, why its load is not predicted.
    pub unpredicted: Vec<(&'static str, String)>,
    /// Faults for the rules.
    pub faults: Vec<Fault>,
    /// Config values that stored tensors contradict.
    pub votes: Vec<Vote>,
}

/// What every stage reads.
struct Inputs<'a> {
    checkpoint: &'a Checkpoint,
    knowledge: &'a Knowledge,
    /// The value of config.json.
    config: &'a Value,
    stored: &'a Stored,
    /// Versions of transformers that the user named; empty for the defaults.
    versions: &'a [String],
    /// The quantisation scheme that the config declares at a place that some loader reads.
    scheme: DeclaredScheme<'a>,
    /// The scheme that each loader reads.
    read: Vec<(Loader, DeclaredScheme<'a>)>,
    memo: &'a Memo,
}

/// What was found for the targets of a checkpoint. A run judges several lists of versions, and what is found for one of them is
/// the same in each.
#[derive(Debug, Default)]
pub struct Memo {
    reports: RefCell<Vec<(ClassKey, Option<LoadReport>)>>,
    causes: RefCell<Vec<(ClassKey, FoundCauses)>>,
    classes: RefCell<Vec<(ClassKey, Result<Expected, Refusal>)>>,
}

/// The loader, the architecture and the class.
type ClassKey = (Loader, String, String);

/// What is found for this key: known from another list of versions, or by `find`.
fn remembered<K: PartialEq, T: Clone>(known: &RefCell<Vec<(K, T)>>, key: K, find: impl FnOnce() -> T) -> T {
    if let Some((_, found)) = known.borrow().iter().find(|(of, _)| *of == key) {
        return found.clone();
    }
    let found = find();
    known.borrow_mut().push((key, found.clone()));
    found
}

fn class_key(architecture: Architecture<'_>) -> ClassKey {
    (architecture.loader(), architecture.name().to_owned(), architecture.class().to_owned())
}

impl<'a> Inputs<'a> {
    /// The scheme that a loader reads.
    fn scheme_of(&self, loader: Loader) -> &DeclaredScheme<'a> {
        self.read.iter().find(|(one, _)| *one == loader).map_or(&self.scheme, |(_, scheme)| scheme)
    }

    /// As [`load::build`].
    fn build(&self, architecture: Architecture<'_>) -> Result<Expected, Refusal> {
        remembered(&self.memo.classes, class_key(architecture), || load::build(architecture, self.config, self.stored))
    }

    fn is_plain(&self) -> bool {
        matches!(self.scheme, DeclaredScheme::Plain)
    }
}

/// Predicts the loads of a checkpoint. Called by the rule engine, with the versions that the user named; without any, the
/// version that wrote config.json and the newest known one of each major version apply. Empty when config.json is missing or
/// invalid, or when tensors may exist that were not read.
#[must_use]
pub fn judge(
    checkpoint: &Checkpoint,
    knowledge: &Knowledge,
    versions: &[String],
    stored: &Stored,
    memo: &Memo,
) -> Judgement {
    let Some(config) = checkpoint.config().filter(|_| !checkpoint.is_partial()) else { return Judgement::default() };
    let scheme = declared_scheme(config, &knowledge.schemes);
    let read = schemes_read(config, knowledge);
    let inputs = Inputs { checkpoint, knowledge, config, stored, versions, scheme, read, memo };
    let targets = classes::resolve_targets(&inputs);
    let architecture = targets.first().map(|target| target.architecture.name().to_owned());
    let classes = classes::build_classes(&inputs, targets);
    let targets = classes.iter().map(|one| one.target.clone()).collect();
    let unpredicted = classes::unpredicted(&inputs, &classes);
    let mut faults = classes::faults(&inputs, &classes);
    let loads = explain::explain(&inputs, predict::predict(&inputs, classes));
    let votes = explain::distinct_votes(&loads);
    faults.extend(faults::faults(&inputs, &loads, &votes));
    let unscaled = unscaled::unscaled(&inputs, &loads);
    let config = loads.first().map_or(Value::Null, |load| load.prediction.expected.config.clone());
    let mut loads: Vec<LoadReport> =
        loads.into_iter().filter_map(|load| predict::completed(&inputs, load.prediction)).collect();
    if let Some(fault) = faults::undeclared_scheme(&inputs, &loads) {
        faults.push(fault);
    } else {
        // No scales are stored that nothing reads, so the values themselves are in question.
        faults.extend(unscaled.fault);
        for (loader, reason) in unscaled.undecided {
            for load in loads.iter_mut().filter(|load| load.loader == loader) {
                load.undecided = Some(reason.clone());
            }
        }
    }
    Judgement { architecture, config, loads, targets, unpredicted, faults, votes }
}

fn schemes_read<'a>(config: &'a Value, knowledge: &'a Knowledge) -> Vec<(Loader, DeclaredScheme<'a>)> {
    let read = |loader| scheme_read(config, &knowledge.schemes, &knowledge.scheme_places, loader);
    Loader::ALL.into_iter().map(|loader| (loader, read(loader))).collect()
}
