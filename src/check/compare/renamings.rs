//! Prefixes of tensor names that one checkpoint has in place of another one's.

use std::collections::HashMap;

use super::{Placed, PrefixChange, Unpaired};

/// Maximum number of prefixes that are found.
const RULES: usize = 16;
/// Names of the first side that suggest prefixes in a round, and names of the second side for each of them.
const SUGGESTING: [usize; 2] = [8, 16];
/// Names on which a suggestion is tried.
const TRIED: usize = 2_000;

/// Pairs tensors whose names differ in a prefix: of whole parts, and the one that pairs most tensors of equal shapes first.
/// A name that such a prefix leads to pairs with another shape, too.
pub(super) fn pair<'c>(
    left: &mut Unpaired<'c>,
    right: &mut Unpaired<'c>,
    pairs: &mut Vec<(Placed<'c>, Placed<'c>)>,
) -> Vec<PrefixChange> {
    let mut found: Vec<PrefixChange> = Vec::new();
    while found.len() < RULES && !left.is_empty() && !right.is_empty() {
        let Some((from, to)) = best(left, right) else { break };
        let tensors = apply(&from, &to, left, right, pairs);
        found.push(PrefixChange { from, to, tensors });
    }
    found
}

/// Pairs every name that the prefix leads to. Returns their number.
fn apply<'c>(
    from: &str,
    to: &str,
    left: &mut Unpaired<'c>,
    right: &mut Unpaired<'c>,
    pairs: &mut Vec<(Placed<'c>, Placed<'c>)>,
) -> usize {
    let led: Vec<(&str, String)> = left.keys().filter_map(|name| Some((*name, renamed(name, from, to)?))).collect();
    let mut count: usize = 0;
    for (name, there) in led {
        if let Some(partner) = right.remove(there.as_str()) {
            pairs.extend(left.remove(name).map(|own| (own, partner)));
            count = count.saturating_add(1);
        }
    }
    count
}

/// The prefixes that pair most of the names that are tried; `None` when none pairs any.
fn best(left: &Unpaired<'_>, right: &Unpaired<'_>) -> Option<(String, String)> {
    let mut by_end: HashMap<&str, Vec<&str>> = HashMap::new();
    for name in right.keys() {
        by_end.entry(end(name)).or_default().push(name);
    }
    let [suggesting, each] = SUGGESTING;
    let tried: Vec<&str> = spread(left, TRIED).collect();
    let score = |from: &str, to: &str| {
        let fits = |name: &&&str| {
            let there = renamed(name, from, to).and_then(|there| right.get(there.as_str()));
            there.zip(left.get(**name)).is_some_and(|(there, own)| there.1.shape == own.1.shape)
        };
        tried.iter().filter(fits).count()
    };
    let mut scored: Vec<(usize, String, String)> = Vec::new();
    for name in spread(left, suggesting) {
        let alike = by_end.get(end(name)).map(Vec::as_slice).unwrap_or_default();
        let mut alike: Vec<(&str, &str, &str)> = alike.iter().map(|there| prefixes(name, there)).collect();
        // Those that share most of the name.
        alike.sort_by_key(|(from, to, _)| (from.len().saturating_add(to.len()), to.len()));
        for (from, to, _) in alike.into_iter().take(each) {
            if !scored.iter().any(|(_, one, other)| one == from && other == to) {
                scored.push((score(from, to), from.to_owned(), to.to_owned()));
            }
        }
    }
    let shortest = |from: &String, to: &String| std::cmp::Reverse(from.len().saturating_add(to.len()));
    let (count, from, to) = scored.into_iter().max_by_key(|(count, from, to)| (*count, shortest(from, to)))?;
    (count > 0).then_some((from, to))
}

/// At most `most` names, from all over the map.
fn spread<'u>(names: &'u Unpaired<'_>, most: usize) -> impl Iterator<Item = &'u str> {
    names.keys().copied().step_by(names.len().div_ceil(most).max(1))
}

/// The last two parts of a name.
fn end(name: &str) -> &str {
    let mut dots = name.rmatch_indices('.').map(|(at, _)| at);
    dots.nth(1).and_then(|at| name.get(at..)).unwrap_or(name)
}

/// What differs at the start of two names, in whole parts, and the rest that they share.
fn prefixes<'n>(name: &'n str, there: &'n str) -> (&'n str, &'n str, &'n str) {
    let same = name.bytes().rev().zip(there.bytes().rev()).take_while(|(one, other)| one == other).count();
    let whole = |text: &str, shared: usize| {
        let at = text.len().checked_sub(shared)?;
        (at == 0 || text.as_bytes().get(at.checked_sub(1)?) == Some(&b'.')).then_some(())
    };
    // The longest end of both that begins with a part.
    let shared = (0..=same).rev().find(|n| whole(name, *n).and(whole(there, *n)).is_some()).unwrap_or(0);
    let cut = |text: &'n str| text.split_at_checked(text.len().saturating_sub(shared)).unwrap_or((text, ""));
    let ((from, rest), (to, _)) = (cut(name), cut(there));
    (from, to, rest)
}

/// The name with another prefix; `None` when it does not start with `from`.
fn renamed(name: &str, from: &str, to: &str) -> Option<String> {
    Some([to, name.strip_prefix(from)?].concat())
}

#[cfg(test)]
mod tests {
    use super::{end, prefixes, renamed};

    #[test]
    fn prefixes_are_whole_parts() {
        for (name, there, expected) in [
            (
                "language_model.model.norm.weight",
                "model.language_model.norm.weight",
                ("language_model.model.", "model.language_model.", "norm.weight"),
            ),
            ("norm.weight", "model.norm.weight", ("", "model.", "norm.weight")),
            ("xnorm.weight", "model.norm.weight", ("xnorm.", "model.norm.", "weight")),
        ] {
            assert_eq!(prefixes(name, there), expected);
            let (from, to, _) = expected;
            assert_eq!(renamed(name, from, to).as_deref(), Some(there));
        }
        assert_eq!((end("a.b.c"), end("b.c"), end("c")), (".b.c", "b.c", "c"));
    }
}
