//! Tensors under a prefix that the class does not have: `module.` of DDP, `_orig_mod.` of torch.compile, the layout of
//! a class that wraps another.

use std::collections::BTreeSet;

use crate::check::fix::{Edit, Site};

/// Prefixes tried for one tensor.
const TRIES: usize = 64;

/// Renames the tensors that the class does not expect to those it misses, where another prefix is all that differs.
pub(super) fn rename_prefix(site: &Site<'_>) -> Option<Vec<Edit>> {
    let load = site.bench.loads.first()?;
    let missing: BTreeSet<&str> = load.missing.iter().map(String::as_str).collect();
    let stored: BTreeSet<&str> = site.checkpoint().tensors().map(|(_, t)| t.name.as_str()).collect();
    let mut left: BTreeSet<&str> = load.unexpected.iter().map(String::as_str).filter(|n| stored.contains(n)).collect();
    let mut prefixes = Vec::new();
    while let Some(name) = left.iter().next().copied() {
        let found = candidates(name, &missing).find(|(from, to)| {
            let mut meant = stored.range(*from..).take_while(|n| n.starts_with(from));
            meant.all(|n| {
                left.contains(n) && n.strip_prefix(from).is_some_and(|rest| missing.contains(&*format!("{to}{rest}")))
            })
        });
        let Some((from, to)) = found else {
            // What has no place in the class stays as it is.
            left.remove(name);
            continue;
        };
        left.retain(|n| !n.starts_with(from));
        prefixes.push((from.to_owned(), to));
    }
    (!prefixes.is_empty()).then(|| vec![Edit::Rename { prefixes }])
}

/// Prefixes of `name`, and what stands in their place in a missing name with the same end; the shortest first.
fn candidates<'n>(name: &'n str, missing: &BTreeSet<&str>) -> impl Iterator<Item = (&'n str, String)> {
    let ends = std::iter::once(0).chain(name.match_indices('.').map(|(at, _)| at.saturating_add(1)));
    let all: Vec<(&str, String)> = ends
        .filter_map(|at| name.split_at_checked(at))
        .flat_map(|(from, rest)| {
            let before = move |other: &str| {
                let to = other.strip_suffix(rest)?;
                (to.is_empty() || to.ends_with('.')).then(|| (from, to.to_owned()))
            };
            missing.iter().filter_map(move |other| before(other)).collect::<Vec<_>>()
        })
        .take(TRIES)
        .collect();
    all.into_iter()
}
