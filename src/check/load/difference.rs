//! What loads under one version of transformers and not under another.

use super::LoadReport;
use super::{Stored, listed};
use crate::checkpoint::{Fault, FaultKind, Place};
use crate::knowledge::{Expected, Loader};

/// A loader's prediction, and the class it was made for.
#[derive(Clone, Copy)]
pub struct Judged<'a> {
    /// The prediction.
    pub report: &'a LoadReport,
    /// What the loader builds.
    pub expected: &'a Expected,
}

/// The fault that a checkpoint loads under one version and not under the other.
#[must_use]
pub fn difference(loads: Judged<'_>, other: Judged<'_>, stored: &Stored) -> Option<Fault> {
    if !loads.report.is_whole() || other.report.is_whole() {
        return None;
    }
    let report = other.report;
    // What the index promises and no shard has is the index's fault.
    let missing: Vec<String> = report.missing.iter().filter(|name| !stored.is_absent(name)).cloned().collect();
    if missing.is_empty() && report.mismatched.is_empty() && report.raises.is_none() {
        return None;
    }
    let mismatched: Vec<String> = report.mismatched.iter().map(|m| m.name.clone()).collect();
    let (what, names) = match (&report.raises, missing.as_slice()) {
        (Some(raises), _) => (format!("the load raises {raises}"), [].as_slice()),
        (None, []) => (format!("the load raises: {} of another shape", tensors(&mismatched)), mismatched.as_slice()),
        (None, missing) => (format!("{} would start random", tensors(missing)), missing),
    };
    let mut fault = Fault::new(FaultKind::LoadsDiffer)
        .with("loads", loads.report.version())
        .with("loader", report.version())
        .with("what", what);
    if let Some(reason) = reason(loads.expected, other, stored) {
        fault = fault.with("reason", reason);
    }
    fault.places = names.iter().take(super::NAMES_SHOWN).map(Place::tensor).collect();
    Some(fault)
}

fn tensors(names: &[String]) -> String {
    format!("{} tensor{} ({})", names.len(), if names.len() == 1 { "" } else { "s" }, listed(names))
}

/// The step in which the two versions differ, when it can be told.
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
            Loader::V4_47_0 => "4.47 renames gamma and beta in every name",
            Loader::V4_57_6 => "4.57 renames gamma and beta only after LayerNorm",
            Loader::V5_23_0 => "5.x renames gamma and beta only after LayerNorm",
        })
    } else if other.expected.loader.major() == 4
        && stored.names().any(|name| loads.tensors.contains_key(name) && !other.expected.tensors.contains_key(name))
    {
        Some("the names are those of 5.x, and 4.x converts none")
    } else if only_there() {
        Some("the class has other tensors there")
    } else {
        None
    }
}
