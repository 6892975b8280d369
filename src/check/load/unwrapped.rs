//! Names without what wrappers added, before any conversion of a version.
//!
//! A wrapper prefixes the names that its module saves, and a loader renames those: `_orig_mod.visual.blocks.0.` is the
//! `model.visual.blocks.0.` of a vision-language model. So the parts of known wrappers are taken off the stored names, and the
//! loader is asked again. A prefix that many names have is tried in the same way: a trainer may hold the model in any
//! attribute.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::json;

use super::{LoadReport, Stored, predict, with_names};
use crate::checkpoint::{Fault, FaultKind};
use crate::knowledge::Expected;
use crate::knowledge::wrappers::Wrappers;

/// Leading parts of a name that may be a prefix.
const DEPTH: usize = 4;
/// Prefixes that are tried.
const TRIED: usize = 8;
/// Names times prefixes that are tried, beyond the first prefix.
const RENAMED: usize = 50_000;
/// A prefix is tried if one name of so many has it.
const SHARE: usize = 8;
/// Names times pairs of prefixes that a rename may compare.
const COMPARED: usize = 1 << 26;

/// Stored tensors under the names that their module had before it was wrapped.
pub(super) struct Unwrapped {
    /// What was taken off: `_orig_mod`, `base_model.model`.
    parts: BTreeSet<String>,
    /// New names by stored name, of those that change.
    names: BTreeMap<String, String>,
    /// Whether an adapter's own tensors are stored beside them: the weights alone are those of its base model.
    has_adapter: bool,
    /// The tensors under the new names.
    pub(super) stored: Stored,
    /// Their load.
    pub(super) report: LoadReport,
}

impl Unwrapped {
    /// Called for a load that lacks tensors and ignores others, or raises. `None` when nothing taken off the names helps.
    pub(super) fn find(wrappers: &Wrappers, expected: &Expected, stored: &Stored, report: &LoadReport) -> Option<Self> {
        let of_class: BTreeSet<&str> = expected.tensors.keys().flat_map(|name| name.split('.')).collect();
        let known = Self::without_known(wrappers, &of_class, expected, stored);
        let known = known.filter(|one| gain(report, &one.report) > 0);
        if known.as_ref().is_some_and(|one| one.report.is_whole() && one.report.unexpected.is_empty()) {
            return known;
        }
        let base = known.as_ref().map_or(report, |one| &one.report);
        let bare: Vec<(String, String)> = match &known {
            Some(one) => {
                let bare = |name: &str| one.names.get(name).cloned().unwrap_or_else(|| name.to_owned());
                stored.names().map(|name| (name.to_owned(), bare(name))).collect()
            }
            None => stored.names().map(|name| (name.to_owned(), name.to_owned())).collect(),
        };
        let of_known = known.as_ref().map(|one| one.parts.clone()).unwrap_or_default();
        let exact = |stored: &Stored| stored.names().filter(|name| expected.tensors.contains_key(*name)).count();
        let placed = exact(known.as_ref().map_or(stored, |one| &one.stored));
        let tried = prefixes(&bare).into_iter().filter_map(|prefix| {
            let names =
                bare.iter().map(|(old, name)| (old.clone(), name.strip_prefix(&*prefix).unwrap_or(name).to_owned()));
            let mut parts = of_known.clone();
            parts.insert(prefix.trim_end_matches('.').to_owned());
            let one = Self::of(wrappers, expected, stored, names, parts)?;
            // Where it does not bring most tensors to their place, another prefix may stand in its place, which is searched later.
            (one.report.missing.len() <= base.missing.len() / 2 || one.report.is_whole()).then_some(one)
        });
        // A prefix of the class's own, such as `model.`, is no wrapper's.
        let tried = tried.filter(|one| gain(base, &one.report) > 0 && exact(&one.stored) >= placed);
        // Of two that help as much, the one with more names of the class; then the shorter prefix, which comes first.
        tried.min_by_key(|one| (size(&one.report), std::cmp::Reverse(exact(&one.stored)))).or(known)
    }

    /// Without the parts of known wrappers.
    fn without_known(
        wrappers: &Wrappers,
        of_class: &BTreeSet<&str>,
        expected: &Expected,
        stored: &Stored,
    ) -> Option<Self> {
        let mut parts: BTreeSet<&str> = BTreeSet::new();
        let names: Vec<(String, String)> =
            stored.names().map(|name| (name.to_owned(), wrappers.bare(name, of_class, &mut parts))).collect();
        let parts = parts.into_iter().map(str::to_owned).collect();
        Self::of(wrappers, expected, stored, names.into_iter(), parts)
    }

    /// The tensors under these names, pairs of the stored and the new one; `None` when none changes, or two come to one name.
    fn of(
        wrappers: &Wrappers,
        expected: &Expected,
        stored: &Stored,
        names: impl Iterator<Item = (String, String)>,
        parts: BTreeSet<String>,
    ) -> Option<Self> {
        let mut taken: BTreeSet<String> = BTreeSet::new();
        let mut changed: BTreeMap<String, String> = BTreeMap::new();
        for (old, new) in names {
            if new.is_empty() || !taken.insert(new.clone()) {
                return None;
            }
            if old != new {
                changed.insert(old, new);
            }
        }
        if changed.is_empty() {
            return None;
        }
        let has_adapter = taken.iter().any(|name| wrappers.is_of_adapter(name));
        let old: BTreeSet<String> = changed.keys().cloned().collect();
        let shape = |name: &str| stored.shape(name).map(<[u64]>::to_vec);
        let new = changed.iter().map(|(old, new)| (new.clone(), shape(old))).collect();
        let renamed = stored.replacing(&old, new);
        let report = predict(expected, &renamed);
        Some(Self { parts, names: changed, has_adapter, stored: renamed, report })
    }

    /// The fault, with the prefixes that rename these tensors: of one prefix, or of parts inside of names.
    pub(super) fn fault(&self) -> Fault {
        let names = || self.names.keys().map(String::as_str);
        let fault = match self.prefix() {
            Some(prefix) => Fault::new(FaultKind::NamesMoved).with("from", prefix.as_str()).with("to", ""),
            None => Fault::new(FaultKind::NamesWrapped).with("parts", json!(self.parts)),
        };
        let fault = fault.with("count", self.names.len());
        let fault = if self.has_adapter { fault.with("adapter", true) } else { fault };
        let fault = fault.with("prefixes", json!(self.renames()));
        with_names(fault, "names", names())
    }

    /// The one prefix that all of them lose.
    fn prefix(&self) -> Option<String> {
        let mut lost = self.names.iter().map(|(old, new)| old.strip_suffix(new.as_str()));
        let first = lost.next()??;
        lost.all(|other| other == Some(first)).then(|| first.to_owned())
    }

    /// Pairs of prefixes that rename these tensors and no other, the longest first: a prefix may be the start of another.
    /// None for an adapter, and when there would be too many.
    fn renames(&self) -> Vec<(String, String)> {
        if self.has_adapter {
            return Vec::new();
        }
        if let Some(prefix) = self.prefix() {
            return vec![(prefix, String::new())];
        }
        let pairs: BTreeMap<String, String> = self.names.iter().filter_map(|(old, new)| cut(old, new)).collect();
        if pairs.len().saturating_mul(self.names.len()) > COMPARED {
            return Vec::new();
        }
        let mut pairs: Vec<(String, String)> = pairs.into_iter().collect();
        pairs.sort_by(|a, b| b.0.len().cmp(&a.0.len()).then_with(|| a.cmp(b)));
        pairs
    }
}

/// How much shorter the lists of the second report are.
fn gain(before: &LoadReport, after: &LoadReport) -> usize {
    size(before).saturating_sub(size(after))
}

fn size(report: &LoadReport) -> usize {
    report.missing.len().saturating_add(report.unexpected.len()).saturating_add(usize::from(report.raises.is_some()))
}

/// The start of a name up to the last part that was taken out of it, and what is left of that start.
fn cut(old: &str, new: &str) -> Option<(String, String)> {
    let same = old.bytes().rev().zip(new.bytes().rev()).take_while(|(a, b)| a == b).count();
    let rest = old.get(old.len().checked_sub(same)?..)?;
    // Whole parts: behind the first dot, unless all of the new name is left.
    let rest = if rest.len() == new.len() { rest } else { rest.split_once('.')?.1 };
    Some((old.strip_suffix(rest)?.to_owned(), new.strip_suffix(rest)?.to_owned()))
}

/// Prefixes that many of these names have, the shortest first; never behind a number, which is a place in a list.
fn prefixes(names: &[(String, String)]) -> Vec<String> {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for (_, name) in names {
        let ends = name.match_indices('.').map(|(at, _)| at.saturating_add(1)).take(DEPTH);
        let starts = ends.filter_map(|end| name.get(..end));
        for start in starts.take_while(|start| !start.split('.').any(|part| part.parse::<u64>().is_ok())) {
            let count = counts.entry(start).or_default();
            *count = count.saturating_add(1);
        }
    }
    let often = names.len().div_ceil(SHARE).max(2);
    let mut prefixes: Vec<(&str, usize)> = counts.into_iter().filter(|(_, count)| *count >= often).collect();
    prefixes.sort_by_key(|(prefix, count)| (std::cmp::Reverse(*count), prefix.len()));
    prefixes.truncate(TRIED.min(RENAMED.checked_div(names.len()).unwrap_or(TRIED)).max(1));
    prefixes.sort_by_key(|(prefix, _)| prefix.len());
    prefixes.into_iter().map(|(prefix, _)| prefix.to_owned()).collect()
}
