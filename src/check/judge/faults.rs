//! The last stage: faults of the loads, one for each cause.

use serde_json::Value;

use super::Inputs;
use super::explain::ExplainedLoad;
use super::integers;
use super::predict::{Prediction, quantised, same_bytes};
use crate::check::load::{self, Judged, LoadReport, Stored};
use crate::check::votes::{self, Vote};
use crate::check::{quantization, size};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, pointer};
use crate::knowledge::Loader;
use crate::knowledge::quantization::DeclaredScheme;

/// Faults of the loads: prefixes, quantised modules, the size in the index, tensors, and config values that the stored
/// tensors contradict.
pub(super) fn faults(inputs: &Inputs<'_>, loads: &[ExplainedLoad<'_>], votes: &[Vote]) -> Vec<Fault> {
    let mut faults: Vec<Fault> = loads.iter().flat_map(prefixes).collect();
    let scheme = loads.first().map_or(&inputs.scheme, |load| inputs.scheme_of(load.prediction.target.loader));
    let without_class = if loads.is_empty() { quantised(inputs, scheme, None) } else { None };
    let modules = loads.first().and_then(|load| load.prediction.quantised.as_ref()).or(without_class.as_ref());
    faults.extend(quantization::faults(inputs.checkpoint, scheme, modules));
    faults.extend(total_size(inputs, loads));
    faults.extend(pointer_sizes(inputs, loads));
    faults.extend(integers::fault(inputs, loads));
    faults.extend(tensors(loads, inputs.stored).into_iter().map(|fault| compare_tied(inputs.checkpoint, fault)));
    faults.extend(votes.iter().map(|vote| {
        let has_vote = |load: &&ExplainedLoad<'_>| {
            load.votes().is_some_and(|votes| votes.iter().any(|v| v.pointer == vote.pointer))
        };
        let fault = votes::fault(vote).under_all(loads.iter().filter(has_vote).map(ExplainedLoad::loader));
        // With the value of the config the load raises where a tensor has another shape, and is wrong otherwise.
        let mismatch = |load: &ExplainedLoad<'_>| {
            Some((load.loader(), load.prediction.report.as_ref()?.mismatched.first()?.name.clone()))
        };
        let (raising, names): (Vec<&str>, Vec<String>) = loads.iter().filter(has_vote).filter_map(mismatch).unzip();
        names
            .into_iter()
            .next()
            .into_iter()
            .fold(fault.with("raising", raising), |fault, name| fault.with("mismatched", name))
    }));
    faults
}

/// The faults of prefixes of one load.
fn prefixes(load: &ExplainedLoad<'_>) -> impl Iterator<Item = Fault> {
    load.prefixes.iter().map(|fault| fault.clone().under(load.loader()))
}

/// The fault of an index that states another size than the class has.
fn total_size(inputs: &Inputs<'_>, loads: &[ExplainedLoad<'_>]) -> Option<Fault> {
    let mut faults = plain(inputs, loads).filter_map(|one| {
        let report = one.report.as_ref()?;
        size::fault(inputs.checkpoint, one.architecture, inputs.config, &one.expected, inputs.stored, report)
    });
    faults.next()
}

/// The fault of Git LFS pointers to more or fewer bytes than the class has.
fn pointer_sizes(inputs: &Inputs<'_>, loads: &[ExplainedLoad<'_>]) -> Option<Fault> {
    plain(inputs, loads).find_map(|one| size::pointer_fault(inputs.checkpoint, inputs.config, &one.expected))
}

/// Predictions of the leading loaders; none when the weights are quantised.
fn plain<'l>(inputs: &Inputs<'_>, loads: &'l [ExplainedLoad<'_>]) -> impl Iterator<Item = &'l Prediction<'l>> {
    let is_plain = inputs.is_plain();
    loads.iter().map(|load| &load.prediction).filter(move |one| one.target.leads && is_plain)
}

/// Faults of the tensors: for a leading loader all of them; for another one, that the checkpoint does not load there.
fn tensors(loads: &[ExplainedLoad<'_>], stored: &Stored) -> Vec<Fault> {
    // Loaders that agree have their faults reported once.
    let mut distinct: Vec<(&LoadReport, &Prediction<'_>, Vec<&'static str>)> = Vec::new();
    for load in loads.iter().filter(|load| load.prediction.target.leads) {
        let Some(report) = load.unexplained() else { continue };
        match distinct.iter_mut().find(|(one, prediction, _)| {
            one.agrees(report) && compares_shapes(prediction) == compares_shapes(&load.prediction)
        }) {
            Some((.., loaders)) => loaders.push(load.loader()),
            None => distinct.push((report, &load.prediction, vec![load.loader()])),
        }
    }
    let under = |report: &LoadReport| (distinct.len() > 1).then(|| format!("transformers {}", report.version()));
    let mut faults = Vec::new();
    for (report, prediction, loaders) in &distinct {
        let own = load::faults(report, &prediction.expected, under(report).as_deref());
        let own = own.into_iter().map(|fault| if compares_shapes(prediction) { fault } else { hidden_by_names(fault) });
        faults.extend(own.map(|fault| Fault { loaders: loaders.clone(), ..fault }));
    }
    let judged = |leads: bool| {
        let predictions = loads.iter().map(|load| &load.prediction).filter(move |one| one.target.leads == leads);
        predictions.filter_map(|one| Some(Judged { report: one.report.as_ref()?, expected: &one.expected }))
    };
    if let Some(leading) = judged(true).next() {
        let differences = judged(false).filter_map(|other| load::difference(leading, other, stored));
        faults.extend(differences.fold(Vec::new(), with_difference));
    }
    faults
}

/// Whether the load itself meets a tensor of another shape than the class has: under another name it finds none.
fn compares_shapes(prediction: &Prediction<'_>) -> bool {
    prediction.report.as_ref().is_some_and(|report| !report.mismatched.is_empty())
}

/// Marks a shape that only a load under the right names would meet.
fn hidden_by_names(fault: Fault) -> Fault {
    let is_shape = matches!(fault.kind, FaultKind::MismatchedTensor | FaultKind::EmptyTensors);
    if is_shape { fault.with("unmet", true) } else { fault }
}

/// Adds a difference between two loaders; versions that differ in the same way are one fault.
fn with_difference(mut faults: Vec<Fault>, fault: Fault) -> Vec<Fault> {
    let apart = |fault: &Fault| {
        fault.detail.iter().filter(|(key, _)| *key != "loader").map(|(k, v)| (k.clone(), v.clone())).collect::<Vec<_>>()
    };
    match faults.iter_mut().find(|other| apart(other) == apart(&fault)) {
        Some(other) => {
            let versions = [&*other, &fault]
                .map(|f| f.detail.get("loader").and_then(Value::as_str).unwrap_or_default().to_owned());
            other.detail.insert("loader".to_owned(), versions.join(" and ").into());
            other.loaders.extend(fault.loaders);
        }
        None => faults.push(fault),
    }
    faults
}

/// Grades a tied tensor that is overwritten by its bytes, where they were read: another value is lost.
fn compare_tied(checkpoint: &Checkpoint, fault: Fault) -> Fault {
    let text = |key: &str| fault.detail.get(key).and_then(Value::as_str);
    let same = text("tensor").zip(text("by")).and_then(|(tensor, by)| same_bytes(checkpoint, tensor, by));
    if same == Some(false) { Fault { kind: FaultKind::TiedOverAnother, ..fault } } else { fault }
}

/// The fault of tensors that look quantised although the first loader reads no scheme from the config. With a block at a place
/// that some versions do not read, it is a fault of the loads by these alone.
pub(super) fn undeclared_scheme(inputs: &Inputs<'_>, loads: &[LoadReport]) -> Option<Fault> {
    let affected: Vec<&'static str> = loads.iter().filter_map(|report| plain_reader(inputs, report)).collect();
    let is_first = match loads.first() {
        Some(first) => affected.first().is_some_and(|version| *version == first.loader),
        None => inputs.is_plain(),
    };
    if !is_first {
        return None;
    }
    let fault = quantization::undeclared(&inputs.knowledge.schemes, inputs.stored.names())?;
    Some(match unread_block(inputs.config, "", UNREAD_DEPTH) {
        Some(at) => fault.with("unread", at).with("by", affected.clone()).under_all(affected),
        None => fault,
    })
}

/// The version of a loader that reads no scheme from the config, and leaves tensors over.
fn plain_reader(inputs: &Inputs<'_>, report: &LoadReport) -> Option<&'static str> {
    let loader = Loader::ALL.into_iter().find(|loader| loader.version() == report.loader)?;
    let is_plain = matches!(inputs.scheme_of(loader), DeclaredScheme::Plain);
    (is_plain && !report.unexpected.is_empty()).then(|| loader.version())
}

/// Levels of a config that are searched for a block that is not read. Compositions have two.
const UNREAD_DEPTH: usize = 4;

/// JSON pointer of the first `quantization_config` in a config.
fn unread_block(config: &Value, at: &str, depth: usize) -> Option<String> {
    let object = config.as_object().filter(|_| depth > 0)?;
    if object.get("quantization_config").is_some_and(Value::is_object) {
        return Some(format!("{at}/quantization_config"));
    }
    object.iter().find_map(|(key, value)| unread_block(value, &pointer::join(at, key), depth.saturating_sub(1)))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::{UNREAD_DEPTH, unread_block};

    #[test]
    fn a_block_is_found_in_compositions_and_not_below_them() {
        let nested = |levels| {
            let block = json!({ "quantization_config": {} });
            (0..levels).fold(block, |inner, _| json!({ "text_config": inner }))
        };
        let found = |config: &Value| unread_block(config, "", UNREAD_DEPTH);
        assert_eq!(found(&nested(0)).as_deref(), Some("/quantization_config"));
        assert_eq!(found(&nested(1)).as_deref(), Some("/text_config/quantization_config"));
        let deep = nested(UNREAD_DEPTH - 1);
        assert_eq!(found(&deep), Some(format!("{}/quantization_config", "/text_config".repeat(UNREAD_DEPTH - 1))));
        assert_eq!(found(&nested(UNREAD_DEPTH)), None);
        assert_eq!(found(&json!({ "quantization_config": null })), None);
    }
}
