//! Checkpoints that load under one version of transformers but not under another.

use super::LoadReport;
use super::{Stored, with_names};
use crate::checkpoint::{Fault, FaultKind};
use crate::knowledge::{Expected, Loader};

/// A loader's prediction, and the class it was made for.
#[derive(Clone, Copy)]
pub struct Judged<'a> {
    /// The prediction.
    pub report: &'a LoadReport,
    /// The class that the loader builds.
    pub expected: &'a Expected,
}

/// The fault that a checkpoint loads under one version and not under the other.
#[must_use]
pub fn difference(loads: Judged<'_>, other: Judged<'_>, stored: &Stored) -> Option<Fault> {
    if !loads.report.is_whole() || other.report.is_whole() {
        return None;
    }
    let report = other.report;
    // A key that the index lists and no shard contains is a fault of the index.
    let missing: Vec<&str> = report.missing.iter().map(String::as_str).filter(|name| !stored.is_absent(name)).collect();
    if missing.is_empty() && report.mismatched.is_empty() && report.raises.is_none() {
        return None;
    }
    let fault =
        Fault::new(FaultKind::LoadsDiffer).with("loads", loads.report.version()).with("loader", report.version());
    let fault = fault.under(other.expected.loader.version());
    let mut fault = match &report.raises {
        Some(exception) => fault.with("raises", exception.as_str()),
        None if missing.is_empty() => {
            let names = report.mismatched.iter().map(|m| m.name.as_str());
            with_names(fault.with("count", report.mismatched.len()), "mismatched", names)
        }
        None => with_names(fault.with("count", missing.len()), "missing", missing.iter().copied()),
    };
    if let Some(reason) = reason(loads.expected, other, stored) {
        fault = fault.with("reason", reason);
    }
    Some(fault)
}

/// The step in which the two versions differ, if it is known; the rule puts it into words.
fn reason(loads: &Expected, other: Judged<'_>, stored: &Stored) -> Option<&'static str> {
    let old_norms = |name: &str| name.contains("gamma") || name.contains("beta");
    let only_there = || {
        let mut missing = other.report.missing.iter();
        !other.report.missing.is_empty() && !missing.any(|name| loads.tensors.contains_key(name))
    };
    if other.report.raises.is_some() {
        None
    } else if stored.names().any(old_norms) {
        Some(match other.expected.loader {
            Loader::V4_47_0 => "gamma-renamed-everywhere",
            Loader::V4_57_6 | Loader::V5_23_0 => "gamma-renamed-after-layer-norm",
        })
    } else if other.expected.loader.major() == 4
        && stored.names().any(|name| loads.tensors.contains_key(name) && !other.expected.tensors.contains_key(name))
    {
        Some("names-of-5")
    } else if only_there() {
        Some("class-differs")
    } else {
        None
    }
}
