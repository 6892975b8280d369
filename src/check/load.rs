//! Load reports: the lists that `from_pretrained` reports for a checkpoint, and the tensors that it loads incorrectly
//! without a warning. One predictor for each known loader, from names and shapes alone.

mod adapted;
mod convert;
mod difference;
mod keys;
mod moved;
mod pattern;
mod rename;
mod report;
mod stored;
mod target;
mod unbuilt;
mod unwrapped;
mod v4;
mod v4_57;
mod v5;
mod wrapped;

use std::collections::BTreeSet;

use serde_json::Value;

use crate::checkpoint::{Fault, FaultKind, Place};
use crate::knowledge::prediction::{PredictionLayers, lies_in, numbered};
use crate::knowledge::{Architecture, Evidence, Expected, Loader, Refusal};

pub(super) use adapted::AdaptedNames;
pub use difference::{Judged, difference};
pub use moved::{Moved, moved};
pub(crate) use report::version;
pub use report::{LoadReport, Mismatch, Silent, SilentReason};
pub use stored::Stored;
pub use target::{Target, targets};
pub(super) use target::{of_run, wanted};

/// Predicts the lists of the loader that `expected` was built for.
#[must_use]
pub fn predict(expected: &Expected, stored: &Stored) -> LoadReport {
    let report = match expected.loader {
        Loader::V4_47_0 => v4::predict(expected, stored),
        Loader::V4_57_6 => v4_57::predict(expected, stored),
        Loader::V5_23_0 => v5::predict(expected, stored),
    };
    let unbuilt = unbuilt::unbuilt(expected, &report.unexpected);
    LoadReport { loader: expected.loader.version().to_owned(), unbuilt, ..report }
}

/// The stored tensors under the names that the loader has for them in the model, renamed and converted. A shape is
/// left out where it depends on more than is known.
#[must_use]
pub fn in_model(expected: &Expected, stored: &Stored) -> Evidence {
    match expected.loader {
        Loader::V4_47_0 => v4::in_model(expected, stored),
        Loader::V4_57_6 => v4_57::in_model(expected, stored),
        Loader::V5_23_0 => v5::in_model(expected, stored),
    }
}

/// The class that the loader builds from `config` for these tensors. [`Architecture::expect_given`] explains the errors.
///
/// A class that reads sizes from stored tensors finds them under the names that it has for them itself: the loader
/// renames stored tensors, and `from_pretrained` accepts a checkpoint of the base model alone.
///
/// # Errors
/// The reason why the class cannot be built from this config.
pub fn build(architecture: Architecture<'_>, config: &Value, stored: &Stored) -> Result<Expected, Refusal> {
    let expected = architecture.expect_given(config, &stored.evidence())?;
    if !architecture.reads_tensors() {
        return Ok(expected);
    }
    architecture.expect_given(config, &spelled(&expected, stored))
}

/// The stored tensors for [`Architecture::expect_given`]: under the names of the class, and those that the class does not
/// have under the base-model prefix too, because it may have them once it is built with them.
pub(super) fn spelled(expected: &Expected, stored: &Stored) -> Evidence {
    let named = in_model(expected, stored);
    let prefix = format!("{}.", expected.base_model_prefix);
    let is_stray = |name: &str| !expected.tensors.contains_key(name) && !name.starts_with(&prefix);
    let strays =
        named.iter().filter(|(name, _)| is_stray(name)).map(|(name, shape)| (format!("{prefix}{name}"), shape));
    let all = named.iter().map(|(name, shape)| (name.to_owned(), shape)).chain(strays);
    all.map(|(name, shape)| (name, shape.map(<[u64]>::to_vec))).collect()
}

/// Optional groups of which no tensor is stored.
fn absent_groups(expected: &Expected, there: impl Fn(&str) -> bool) -> BTreeSet<&str> {
    let optional = || expected.tensors.iter().filter_map(|(name, t)| Some((name, t.optional.as_deref()?)));
    let present: BTreeSet<&str> = optional().filter(|(name, _)| there(name)).map(|(_, group)| group).collect();
    optional().map(|(_, group)| group).filter(|group| !present.contains(group)).collect()
}

/// The fault of a list of tensors, which counts all of them and names as many as a report has room for; `None` for none.
fn of_names<'n>(kind: FaultKind, names: impl Iterator<Item = &'n str> + Clone) -> Option<Fault> {
    let count = names.clone().count();
    (count > 0).then(|| with_names(Fault::new(kind).with("count", count), "names", names))
}

/// Adds a list of tensors under `key`, and each of them as a place, as far as a report has room.
fn with_names<'n>(fault: Fault, key: &str, names: impl Iterator<Item = &'n str> + Clone) -> Fault {
    let names: Vec<&str> = names.clone().take(report::listed(names)).collect();
    let fault = fault.with(key, names.clone());
    names.into_iter().fold(fault, |fault, name| fault.at(Place::tensor(name)))
}

/// The ignored layers that predict further tokens, if the config states that there are any: transformers builds none of them,
/// and the classes of published models ignore theirs without a warning. A layer that the class builds is an ordinary one to it,
/// whose other tensors are told.
fn predicting<'r>(report: &'r LoadReport, expected: &'r Expected) -> BTreeSet<(&'r str, u64)> {
    let layers = PredictionLayers::built_in();
    if report.unexpected.is_empty() || layers.stated(&expected.config).is_none() {
        return BTreeSet::new();
    }
    let built = expected.tensors.keys().map(String::as_str);
    let mut found = layers.among(&expected.config, report.unexpected.iter().map(String::as_str).chain(built.clone()));
    for (list, number, _) in built.flat_map(numbered) {
        found.remove(&(list, number));
    }
    found
}

/// Faults of a load report, one for each cause.
///
/// `indexed-but-absent` is not among them: the comparison of the index with the shards reports it without a class.
/// `under` names the loader when loaders differ.
#[must_use]
pub fn faults(report: &LoadReport, expected: &Expected, under: Option<&str>) -> Vec<Fault> {
    let mut faults = Vec::new();
    let causes = [(SilentReason::PrefixHijack, FaultKind::PrefixHijack), (SilentReason::TiedOver, FaultKind::TiedOver)];
    for (reason, kind) in causes {
        let silent = report.silent.iter().filter(|s| s.reason == reason);
        faults.extend(silent.map(|s| {
            let fault = Fault::new(kind).at(Place::tensor(&*s.name)).with("tensor", s.name.as_str());
            s.by.iter().fold(fault, |fault, by| fault.at(Place::tensor(by)).with("by", by.as_str()))
        }));
    }
    if let Some(reason) = &report.raises {
        faults.push(Fault::new(FaultKind::LoadRaises).with("reason", reason.as_str()));
    }
    // A hijack is the cause of everything else: the lists repeat it a thousand times.
    if !report.silent.iter().any(|s| s.reason == SilentReason::PrefixHijack) {
        let unbuilt: BTreeSet<&str> = report.unbuilt.iter().map(String::as_str).collect();
        let predicting = predicting(report, expected);
        let is_other = |name: &&str| !unbuilt.contains(name) && !lies_in(&predicting, name);
        let others = report.unexpected.iter().map(String::as_str).filter(is_other);
        faults.extend(of_names(FaultKind::MissingTensors, report.missing.iter().map(String::as_str)));
        faults.extend(of_names(FaultKind::UnbuiltTensors, report.unbuilt.iter().map(String::as_str)));
        faults.extend(of_names(FaultKind::UnexpectedTensors, others));
        // A shape of no elements is no other shape: nothing was stored.
        let is_empty = |m: &&Mismatch| m.stored.contains(&0) && !m.expected.contains(&0);
        let (empty, others): (Vec<&Mismatch>, Vec<&Mismatch>) = report.mismatched.iter().partition(is_empty);
        faults.extend(of_names(FaultKind::EmptyTensors, empty.iter().map(|m| m.name.as_str())));
        let hidden = others.len().saturating_sub(report::LISTED);
        faults.extend(others.into_iter().take(report::LISTED).map(|m| {
            let fault =
                Fault::new(FaultKind::MismatchedTensor).at(Place::tensor(&*m.name)).with("tensor", m.name.as_str());
            fault.with("stored", m.stored.clone()).with("expected", m.expected.clone())
        }));
        if let Some(last) = faults.last_mut().filter(|_| hidden > 0) {
            last.hidden = u64::try_from(hidden).unwrap_or(u64::MAX);
        }
    }
    let named = |fault: Fault| match under {
        Some(loader) => fault.with("under", loader),
        None => fault,
    };
    faults.into_iter().map(named).collect()
}

#[cfg(test)]
mod tests;
