//! Tensors that are all there under other names: a wrapper's prefix, or a level too many or too few.
//!
//! `torch.compile` puts `_orig_mod.` before every name, `DataParallel` and `DeepSpeed` `module.`, a class that holds the
//! model in an attribute that attribute's name. A loader reports every tensor twice then, as missing and as unexpected.
//! First the stored names lose what wrappers add ([`Unwrapped`]); which prefix stands for which of the class's is then read off
//! the names themselves.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};

use super::LoadReport;
use super::unwrapped::Unwrapped;
use super::wrapped::Wrapped;
use super::{Stored, build, predict, with_names};
use crate::checkpoint::{Fault, FaultKind};
use crate::knowledge::wrappers::Wrappers;
use crate::knowledge::{Architecture, Expected};

/// Stored names from which prefixes are guessed.
const SAMPLES: usize = 48;
/// Leading parts of a stored name that may be a prefix.
const DEPTH: usize = 4;
/// Prefixes that are told, one after the other.
const ROUNDS: usize = 3;
/// Pairs of prefixes that one of them may come to, so that it moves no other tensor.
const PAIRS: usize = 64;

/// A checkpoint with its tensors under the names of the class.
#[derive(Debug, Clone)]
pub struct Moved {
    /// The tensors, renamed.
    pub stored: Stored,
    /// The class, built for the renamed tensors.
    pub expected: Expected,
    /// The load of the renamed tensors.
    pub report: LoadReport,
    /// One for each prefix, and one for parts inside of names.
    pub faults: Vec<Fault>,
}

/// Finds prefixes under which tensors of the class lie, and parts of their names that wrappers added; `None` when there are none, or renaming does not help.
#[must_use]
pub fn moved(
    wrappers: &Wrappers,
    architecture: Architecture<'_>,
    config: &Value,
    expected: &Expected,
    stored: &Stored,
    report: &LoadReport,
) -> Option<Moved> {
    let mut found =
        Moved { stored: stored.clone(), expected: expected.clone(), report: report.clone(), faults: Vec::new() };
    if is_listed(report)
        && let Some(unwrapped) = Unwrapped::find(wrappers, expected, stored, report)
    {
        found.faults.push(unwrapped.fault());
        found.report = unwrapped.report;
        found.stored = unwrapped.stored;
        if architecture.reads_tensors()
            && let Ok(expected) = build(architecture, config, &found.stored)
        {
            found.report = predict(&expected, &found.stored);
            found.expected = expected;
        }
    }
    for _ in 0..ROUNDS {
        if !is_listed(&found.report) {
            break;
        }
        let step = best(&found.expected, &found.stored);
        let moving = step.as_ref().map_or(0, |step| step.names.len());
        if let Some(wrapped) = Wrapped::find(&found.expected, &found.stored).filter(|wrapped| wrapped.len() > moving) {
            let renamed = wrapped.renamed(&found.stored);
            let report = predict(&found.expected, &renamed);
            if size(&found.report).saturating_sub(size(&report)) < wrapped.len() {
                break;
            }
            found = Moved { stored: renamed, report, ..found };
            found.faults.push(wrapped.fault());
            continue;
        }
        let Some(mut step) = step else { break };
        if architecture.reads_tensors() {
            // With all of them renamed, the class may have more of these tensors.
            let strays = strays(&found.expected, &found.stored);
            let strays: Vec<String> = strays.filter(|n| n.starts_with(&step.from)).map(str::to_owned).collect();
            let renamed = found.stored.under(&strays, &step.from, &step.to);
            if let Ok(expected) = build(architecture, config, &renamed) {
                step.names = arriving(&expected, &found.stored, &step.from, &step.to);
                found.expected = expected;
            }
        }
        let renamed = found.stored.under(&step.names, &step.from, &step.to);
        let report = predict(&found.expected, &renamed);
        let cleared = size(&found.report).saturating_sub(size(&report));
        // Each tensor was reported as missing and as unexpected, or was at least one of them; a loader that raised reported
        // none.
        let loads = found.report.raises.is_some() && report.is_whole();
        if cleared < step.names.len() && !loads {
            break;
        }
        // Those that an earlier step has moved were under other names before.
        found.faults.push(step.fault(stored));
        found.stored = renamed;
        found.report = report;
    }
    (!found.faults.is_empty()).then_some(found)
}

/// Whether a report lists tensors twice, as missing and as unexpected, or nothing because the loader raised.
const fn is_listed(report: &LoadReport) -> bool {
    (!report.missing.is_empty() && !report.unexpected.is_empty()) || report.raises.is_some()
}

fn size(report: &LoadReport) -> usize {
    report.missing.len().saturating_add(report.unexpected.len()).saturating_add(usize::from(report.raises.is_some()))
}

/// A prefix, what the class has in its place, and the stored names that start so and would fit.
struct Step {
    from: String,
    to: String,
    names: Vec<String>,
}

impl Step {
    fn fault(&self, stored: &Stored) -> Fault {
        let fault = Fault::new(FaultKind::NamesMoved)
            .with("from", self.from.as_str())
            .with("to", self.to.as_str())
            .with("count", self.names.len())
            .with("prefixes", json!(self.prefixes(stored)));
        with_names(fault, "names", self.names.iter().map(String::as_str))
    }

    /// Pairs of prefixes that rename these tensors and no other: where others have the prefix too, longer ones. None
    /// when there would be too many, or a whole name is the start of another one.
    fn prefixes(&self, stored: &Stored) -> Vec<(String, String)> {
        let ours: BTreeSet<&str> = self.names.iter().map(String::as_str).collect();
        let all: BTreeSet<&str> = stored.names().chain(stored.shapes().map(|(name, _)| name)).collect();
        let mut shared: BTreeSet<&str> = BTreeSet::new();
        let mut found: Vec<(String, String)> = Vec::new();
        for name in &self.names {
            if found.iter().any(|(from, _)| name.starts_with(from)) {
                continue;
            }
            let rest = self.from.len();
            let ends = name.match_indices('.').map(|(at, _)| at.saturating_add(1)).filter(|end| *end > rest);
            let ends = std::iter::once(rest).chain(ends.take(DEPTH)).chain([name.len()]);
            let exact = ends.filter_map(|end| name.get(..end)).find(|prefix| {
                let alone = !shared.contains(prefix)
                    && all.range(*prefix..).take_while(|n| n.starts_with(prefix)).all(|n| ours.contains(n));
                if !alone {
                    shared.insert(prefix);
                }
                alone
            });
            match exact.and_then(|prefix| Some((prefix, prefix.strip_prefix(&self.from)?))) {
                Some((prefix, rest)) if found.len() < PAIRS => {
                    found.push((prefix.to_owned(), format!("{}{rest}", self.to)));
                }
                _ => return Vec::new(),
            }
        }
        found
    }
}

/// The pair of prefixes that brings most tensors to their place.
fn best(expected: &Expected, stored: &Stored) -> Option<Step> {
    let here: BTreeSet<&str> = stored.names().collect();
    let wanted: BTreeSet<&str> = expected.tensors.keys().map(String::as_str).filter(|n| !here.contains(n)).collect();
    let strays: Vec<&str> = strays(expected, stored).collect();
    let mut pairs: BTreeMap<(&str, &str), usize> = BTreeMap::new();
    let step = strays.len().div_ceil(SAMPLES).max(1);
    for stray in strays.iter().step_by(step) {
        for (from, rest) in splits(stray) {
            let fits = wanted.iter().filter_map(|name| Some((from, prefix(name, rest)?)));
            // The shortest detour is the likeliest.
            if let Some(pair) = fits.min_by_key(|(_, to)| to.len()) {
                pairs.entry(pair).or_default();
            }
        }
    }
    for ((from, to), count) in &mut pairs {
        let arrives = |n: &&&str| n.strip_prefix(*from).is_some_and(|rest| wanted.contains(&*format!("{to}{rest}")));
        *count = strays.iter().filter(arrives).count();
    }
    // Of two that bring as many to their place, the prefix that no other tensor has, so that it can be said and renamed
    // as a prefix; then the shorter one.
    let alone = |from: &str, count: usize| here.iter().filter(|n| n.starts_with(from)).count() == count;
    let ((from, to), count) = pairs.into_iter().max_by_key(|((from, to), count)| {
        (*count, alone(from, *count), Reverse(from.len().saturating_add(to.len())))
    })?;
    // One tensor under another name may be another tensor.
    if count < 2 {
        return None;
    }
    Some(Step { from: from.to_owned(), to: to.to_owned(), names: arriving(expected, stored, from, to) })
}

/// Stored names that the class does not have.
fn strays<'s>(expected: &Expected, stored: &'s Stored) -> impl Iterator<Item = &'s str> {
    stored.names().filter(|name| !expected.tensors.contains_key(*name))
}

/// Stored names that become missing names of the class when they start with `to` in place of `from`.
fn arriving(expected: &Expected, stored: &Stored, from: &str, to: &str) -> Vec<String> {
    let here: BTreeSet<&str> = stored.names().collect();
    let arrives = |name: &&str| {
        let renamed = name.strip_prefix(from).map(|rest| format!("{to}{rest}"));
        renamed.is_some_and(|name| expected.tensors.contains_key(&name) && !here.contains(&*name))
    };
    strays(expected, stored).filter(arrives).map(str::to_owned).collect()
}

/// A name taken apart after each of its first dots, and before the first; never behind a number, which is a place in a
/// list and no prefix.
fn splits(name: &str) -> impl Iterator<Item = (&str, &str)> {
    let ends = name.match_indices('.').map(|(at, _)| at.saturating_add(1));
    let cuts = std::iter::once(0).chain(ends.take(DEPTH));
    cuts.filter_map(|at| name.split_at_checked(at)).filter(|(from, _)| !numbered(from))
}

/// What stands before `rest` in a name of the class.
fn prefix<'n>(name: &'n str, rest: &str) -> Option<&'n str> {
    let to = name.strip_suffix(rest)?;
    ((to.is_empty() || to.ends_with('.')) && !numbered(to)).then_some(to)
}

fn numbered(prefix: &str) -> bool {
    prefix.split('.').any(|part| part.parse::<u64>().is_ok())
}
