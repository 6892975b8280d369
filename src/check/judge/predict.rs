//! The third stage: the load report of each class.

use std::borrow::Cow;
use std::collections::BTreeSet;

use super::classes::BuiltClass;
use super::{Inputs, class_key, remembered};
use crate::check::index;
use crate::check::load::{self, LoadReport, Target};
use crate::check::quantization::Quantised;
use crate::checkpoint::{Checkpoint, FaultKind};
use crate::knowledge::quantization::DeclaredScheme;
use crate::knowledge::{Architecture, Expected};

/// The load that one loader's class leads to.
pub(super) struct Prediction<'a> {
    pub(super) target: Target,
    pub(super) architecture: Architecture<'a>,
    pub(super) expected: Expected,
    /// The quantised modules; `None` without a known scheme.
    pub(super) quantised: Option<Quantised<'a>>,
    /// `None` when nothing is stored, or the names of the scheme cannot be compared with the class.
    pub(super) report: Option<LoadReport>,
}

/// Predicts the load of each class that could be built.
pub(super) fn predict<'a>(inputs: &'a Inputs<'a>, built: Vec<BuiltClass<'a>>) -> Vec<Prediction<'a>> {
    let predicted = built.into_iter().filter_map(|one| {
        let expected = one.class.ok()?;
        let quantised = quantised(inputs, inputs.scheme_of(one.target.loader), Some(&expected));
        let mut report = remembered(&inputs.memo.reports, class_key(one.architecture), || {
            report(inputs, &one.target, &expected, quantised.as_ref())
        });
        if let Some(report) = &mut report {
            report.stands_for.clone_from(&one.target.stands_for);
        }
        Some(Prediction { target: one.target, architecture: one.architecture, expected, quantised, report })
    });
    predicted.collect()
}

/// The quantised modules of the checkpoint, for a scheme that is known.
pub(super) fn quantised<'a>(
    inputs: &'a Inputs<'a>,
    scheme: &'a DeclaredScheme<'a>,
    expected: Option<&Expected>,
) -> Option<Quantised<'a>> {
    match scheme {
        DeclaredScheme::Known(applied) => Some(Quantised::new(applied, expected, inputs.checkpoint, inputs.stored)),
        _ => None,
    }
}

fn report(
    inputs: &Inputs<'_>,
    target: &Target,
    expected: &Expected,
    quantised: Option<&Quantised<'_>>,
) -> Option<LoadReport> {
    // The layout of an unknown scheme is unknown.
    if matches!(inputs.scheme_of(target.loader), DeclaredScheme::Unknown(_)) || inputs.stored.is_empty() {
        return None;
    }
    let plain = quantised.map_or(Cow::Borrowed(inputs.stored), |q| Cow::Owned(q.plain(inputs.stored)));
    let report = load::predict(expected, &plain);
    let report = match quantised {
        Some(quantised) => quantised.spelled(report)?,
        None => report,
    };
    Some(finished(inputs.checkpoint, report))
}

/// Removes from a report what the files themselves explain.
pub(super) fn finished(checkpoint: &Checkpoint, mut report: LoadReport) -> LoadReport {
    // A tensor whose header entry could not be read exists.
    let unreadable: BTreeSet<&str> =
        checkpoint.shards.values().flat_map(|s| &s.unreadable).map(String::as_str).collect();
    report.missing.retain(|name| !unreadable.contains(name.as_str()));
    // A shape that no bytes can have is a fault of the container.
    let is_impossible = |kind| matches!(kind, FaultKind::ShapeOverflow | FaultKind::SubByteMisaligned);
    let faults = checkpoint.shards.values().flat_map(|s| &s.faults).filter(|fault| is_impossible(fault.kind));
    let impossible: BTreeSet<&str> = faults.flat_map(|f| &f.places).filter_map(|p| p.tensor.as_deref()).collect();
    report.mismatched.retain(|m| !impossible.contains(m.name.as_str()));
    // A tensor that is overwritten by an equal one loses nothing.
    report.silent.retain(|s| s.by.as_deref().and_then(|by| same_bytes(checkpoint, &s.name, by)) != Some(true));
    report
}

/// Whether the tensors of these names are the same, see [`Checkpoint::same_bytes`].
pub(super) fn same_bytes(checkpoint: &Checkpoint, one: &str, other: &str) -> Option<bool> {
    let [one, other] = [one, other].map(|name| index::opened_tensor(checkpoint, name));
    checkpoint.same_bytes(one?, other?)
}

/// The report for readers: with the quantised modules that do not fit, and a missing shard, which rules of other families
/// report.
pub(super) fn completed(inputs: &Inputs<'_>, prediction: Prediction<'_>) -> Option<LoadReport> {
    let mut report = prediction.report?;
    if let Some(quantised) = &prediction.quantised {
        quantised.complete(&mut report);
    }
    let absent = index::first_absent_shard(inputs.checkpoint);
    report.raises = report.raises.or_else(|| absent.map(|name| format!("FileNotFoundError: {name}")));
    Some(report)
}
