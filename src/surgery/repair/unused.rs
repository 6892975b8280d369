//! Stored tensors that a repair would leave unused although a rename could use them.
//!
//! A repair that gives a missing tensor another source, a tie or a copy, makes the load complete, and the trained values stay
//! in the file, ignored: the model loads and computes something else.

use std::collections::{BTreeMap, BTreeSet};

use crate::check::Outcome;

/// A stored tensor that no loader uses after the repair, although it has the name of a tensor that was missing before, up to a
/// prefix. Called by the planner for each set of fixes.
pub(super) fn left_unused(before: &Outcome, after: &Outcome) -> Option<String> {
    after.loads.iter().find_map(|load| {
        let old = before.loads.iter().find(|old| old.loader == load.loader)?;
        let still: BTreeSet<&String> = load.missing.iter().collect();
        let is_filled = |name: &&String| !still.contains(name);
        let mut filled: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        for name in old.missing.iter().filter(is_filled) {
            filled.entry(last(name)).or_default().push(name);
        }
        let is_meant = |unused: &&String| {
            filled.get(last(unused)).is_some_and(|names| names.iter().any(|name| is_same(name, unused)))
        };
        load.unexpected.iter().find(is_meant).cloned()
    })
}

/// The last two parts of a name.
fn last(name: &str) -> &str {
    let dots: Vec<usize> = name.match_indices('.').map(|(at, _)| at).collect();
    let start = dots.len().checked_sub(2).and_then(|i| dots.get(i)).map_or(0, |at| at.saturating_add(1));
    name.get(start..).unwrap_or(name)
}

/// Whether two names differ by a prefix alone: one is the end of the other, or they are equal from a number on.
fn is_same(one: &str, other: &str) -> bool {
    let ends =
        |long: &str, short: &str| long.strip_suffix(short).is_some_and(|rest| rest.is_empty() || rest.ends_with('.'));
    let same = one.rsplit('.').zip(other.rsplit('.')).take_while(|(a, b)| a == b).map(|(part, _)| part);
    // A list in another part of the model has the same layers.
    ends(one, other) || ends(other, one) || {
        let parts: Vec<&str> = same.collect();
        let number = parts.iter().rposition(|part| part.parse::<u64>().is_ok());
        number.is_some_and(|at| parts.len() > at.saturating_add(2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::load::LoadReport;

    fn outcome(missing: &[&str], unexpected: &[&str]) -> Outcome {
        let owned = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        let report = LoadReport { missing: owned(missing), unexpected: owned(unexpected), ..LoadReport::default() };
        Outcome { loads: vec![report], ..Outcome::default() }
    }

    type Case<'a> = (&'a [&'a str], &'a [&'a str], &'a [&'a str], bool);

    #[test]
    fn a_tensor_that_a_rename_would_use_is_told() {
        let cases: [Case<'_>; 6] = [
            // The head is tied, and the trained one stays in the file.
            (&["lm_head.weight"], &[], &["_orig_mod.lm_head.weight"], true),
            // It was used, or is missing still.
            (&["lm_head.weight"], &[], &[], false),
            (&["lm_head.weight"], &["lm_head.weight"], &["_orig_mod.lm_head.weight"], false),
            // Of two copies one was chosen.
            (&["model.layers.0.mlp.weight"], &[], &["teacher.model.layers.0.mlp.weight"], true),
            (&["model.visual.blocks.0.norm.weight"], &[], &["a.visual.blocks.0.norm.weight"], true),
            // Another tensor.
            (&["model.norm.weight"], &[], &["model.visual.norm_out.weight"], false),
        ];
        for (missing, still, unused, is_told) in cases {
            let told = left_unused(&outcome(missing, unused), &outcome(still, unused));
            assert_eq!(told.is_some(), is_told, "{missing:?} {still:?} {unused:?}");
        }
    }
}
