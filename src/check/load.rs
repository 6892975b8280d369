//! The load report: what `from_pretrained` would say of a checkpoint's tensors, and what it would not.
//!
//! One prediction for each loader that is known, on names and shapes alone.

mod convert;
mod difference;
mod keys;
mod moved;
mod pattern;
mod rename;
mod report;
mod stored;
mod target;
mod v4;
mod v4_57;
mod v5;

use std::collections::BTreeSet;

use crate::checkpoint::{Fault, FaultKind, Place};
use crate::knowledge::{Evidence, Expected, Loader};

pub use difference::{Judged, difference};
pub use moved::{Moved, moved};
pub use report::{LoadReport, Mismatch, Silent, SilentReason};
pub use stored::Stored;
pub use target::{Target, targets};

/// Names in the message of one fault.
const NAMES_SHOWN: usize = 5;

/// Predicts the lists of the loader that `expected` was built for.
#[must_use]
pub fn predict(expected: &Expected, stored: &Stored) -> LoadReport {
    let report = match expected.loader {
        Loader::V4_47_0 => v4::predict(expected, stored),
        Loader::V4_57_6 => v4_57::predict(expected, stored),
        Loader::V5_23_0 => v5::predict(expected, stored),
    };
    LoadReport { loader: expected.loader.version().to_owned(), ..report }
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

/// Optional groups of which nothing is there.
fn absent_groups(expected: &Expected, there: impl Fn(&str) -> bool) -> BTreeSet<&str> {
    let optional = || expected.tensors.iter().filter_map(|(name, t)| Some((name, t.optional.as_deref()?)));
    let present: BTreeSet<&str> = optional().filter(|(name, _)| there(name)).map(|(_, group)| group).collect();
    optional().map(|(_, group)| group).filter(|group| !present.contains(group)).collect()
}

/// Faults for the rules to judge: one for each cause, not one for each tensor.
///
/// `indexed-but-absent` is not among them: comparing the index with the shards finds it without a class.
/// `under` names the loader where several say different things.
#[must_use]
pub fn faults(report: &LoadReport, under: Option<&str>) -> Vec<Fault> {
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
        for (kind, names) in
            [(FaultKind::MissingTensors, &report.missing), (FaultKind::UnexpectedTensors, &report.unexpected)]
        {
            if !names.is_empty() {
                let mut fault = Fault::new(kind).with("count", names.len()).with("names", listed(names));
                fault.places = names.iter().take(NAMES_SHOWN).map(Place::tensor).collect();
                faults.push(fault);
            }
        }
        // A shape of no elements is no other shape: nothing was stored.
        let is_empty = |m: &&Mismatch| m.stored.contains(&0) && !m.expected.contains(&0);
        let (empty, others): (Vec<&Mismatch>, Vec<&Mismatch>) = report.mismatched.iter().partition(is_empty);
        if !empty.is_empty() {
            let names: Vec<String> = empty.iter().map(|m| m.name.clone()).collect();
            let mut fault =
                Fault::new(FaultKind::EmptyTensors).with("count", names.len()).with("names", listed(&names));
            fault.places = names.iter().take(NAMES_SHOWN).map(Place::tensor).collect();
            faults.push(fault);
        }
        faults.extend(others.into_iter().map(|m| {
            let fault =
                Fault::new(FaultKind::MismatchedTensor).at(Place::tensor(&*m.name)).with("tensor", m.name.as_str());
            fault.with("stored", m.stored.clone()).with("expected", m.expected.clone())
        }));
    }
    let named = |fault: Fault| match under {
        Some(loader) => fault.with("under", loader),
        None => fault,
    };
    faults.into_iter().map(named).collect()
}

fn listed(names: &[String]) -> String {
    let shown: Vec<&str> = names.iter().take(NAMES_SHOWN).map(String::as_str).collect();
    match names.len().saturating_sub(shown.len()) {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

#[cfg(test)]
mod tests;
