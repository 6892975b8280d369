//! The tensors that one config value decides, found by changing it and building the class again.
//!
//! Nothing here reads the expressions of an architecture. Whatever they say, two builds show which names and which
//! dimensions follow a value, and how.

use std::collections::BTreeMap;

use serde_json::Value;

use super::space::{Numbered, Space, with};
use crate::checkpoint::pointer;
use crate::knowledge::Expected;

/// Another value for a leaf, to see what it changes. Half rather than double: it makes builds cheaper, and lists
/// that have an element for each layer stay long enough.
pub(super) fn other(value: &Value) -> Option<Value> {
    if let Some(flag) = value.as_bool() {
        return Some(Value::Bool(!flag));
    }
    if value.is_null() {
        return Some(8.into());
    }
    if let Some(n) = value.as_u64() {
        let half = match n {
            0 => 1,
            1 => 2,
            n => n / 2,
        };
        return Some(half.into());
    }
    value.as_f64().filter(|x| *x > 0.0 && *x < 1e6).map(|x| Value::from(x / 2.0))
}

/// A value of the config that the class's tensors depend on.
pub(super) struct ProbedKey {
    pub pointer: String,
    /// Its value now, given or by default.
    pub value: Value,
    /// The changed value, and the class built with it.
    pub other: Value,
    pub built: Expected,
}

/// The values that names or shapes depend on, found by changing many at once and splitting where something changed.
pub(super) fn keys(space: &Space<'_>, config: &Value, base: &Expected) -> Vec<ProbedKey> {
    keys_among(space, config, base, space.shaping(&base.config))
}

/// As [`keys`], of the values at these pointers only.
pub(super) fn keys_among(
    space: &Space<'_>,
    config: &Value,
    base: &Expected,
    pointers: impl IntoIterator<Item = String>,
) -> Vec<ProbedKey> {
    let mut kinds: BTreeMap<u8, Vec<(String, Value, Value)>> = BTreeMap::new();
    for pointer in pointers {
        let Some(value) = base.config.pointer(&pointer) else { continue };
        let Some(other) = other(value) else { continue };
        let kind = match value {
            Value::Number(n) if n.is_u64() => 0,
            Value::Number(_) => 1,
            Value::Bool(_) => 2,
            _ => 3,
        };
        kinds.entry(kind).or_default().push((pointer, value.clone(), other));
    }
    let mut found = Vec::new();
    for group in kinds.values() {
        split(space, config, base, group, &mut found);
    }
    found
}

fn split(
    space: &Space<'_>,
    config: &Value,
    base: &Expected,
    group: &[(String, Value, Value)],
    found: &mut Vec<ProbedKey>,
) {
    if space.exhausted() {
        return;
    }
    let mut changed = config.clone();
    for (pointer, _, other) in group {
        pointer::put(&mut changed, &base.config, pointer, other.clone());
    }
    let built = space.build(&changed);
    if built.as_ref().is_some_and(|b| b.tensors == base.tensors) || space.exhausted() {
        return;
    }
    match (group, built) {
        ([(pointer, value, other)], Some(built)) => {
            found.push(ProbedKey { pointer: pointer.clone(), value: value.clone(), other: other.clone(), built });
        }
        ([(pointer, value, _)], None) => {
            // Half a value may be refused where twice it, or one more, is not.
            let others = value.as_u64().map(|n| [n.saturating_mul(2), n.saturating_add(1), n.saturating_sub(1)]);
            let mut tried = others.into_iter().flatten().filter(|n| Some(*n) != value.as_u64()).filter_map(|n| {
                let built = space.build(&with(config, &base.config, pointer, n.into()))?;
                (built.tensors != base.tensors).then_some((n, built))
            });
            if let Some((n, built)) = tried.next() {
                found.push(ProbedKey { pointer: pointer.clone(), value: value.clone(), other: n.into(), built });
            }
        }
        (group, _) => {
            let (left, right) = group.split_at(group.len() / 2);
            split(space, config, base, left, found);
            split(space, config, base, right, found);
        }
    }
}

/// A dimension that two builds of a class have in common.
#[derive(Debug, Clone, Copy)]
pub(super) struct Dimension<'e> {
    pub name: &'e str,
    pub axis: usize,
    /// In the first build, and in the second.
    pub here: u64,
    pub there: u64,
}

/// The dimensions in which two builds differ.
pub(super) fn dimensions<'e>(a: &'e Expected, b: &'e Expected) -> impl Iterator<Item = Dimension<'e>> {
    a.tensors.iter().filter_map(|(name, here)| Some((name, here, b.tensors.get(name)?))).flat_map(
        |(name, here, there)| {
            let same_rank = here.shape.len() == there.shape.len();
            let pairs = here.shape.iter().zip(&there.shape).enumerate();
            pairs
                .filter(move |(_, (here, there))| same_rank && here != there)
                .map(move |(axis, (here, there))| Dimension { name, axis, here: *here, there: *there })
        },
    )
}

/// The number of dimensions or names that imply each value.
pub(super) type Tally = BTreeMap<u64, usize>;

/// The values of `key` that would make stored dimensions come out, taking each as a linear function of it.
///
/// The first tally is of dimensions that *are* the value (`vocab_size`), the second of all.
pub(super) fn by_dimensions(space: &Space<'_>, key: &ProbedKey, base: &Expected) -> (Tally, Tally) {
    let (mut pure, mut all) = (Tally::new(), Tally::new());
    let (Some(value), Some(other)) = (key.value.as_u64(), key.other.as_u64()) else { return (pure, all) };
    for d in dimensions(base, &key.built) {
        let Some(stored) = stored_dimension(space, base, &d) else { continue };
        if (d.here, d.there) == (value, other) {
            add(&mut pure, stored);
        }
        if let Some(wanted) = linear(value, other, d, stored) {
            add(&mut all, wanted);
        }
    }
    (pure, all)
}

fn add(tally: &mut Tally, value: u64) {
    let slot = tally.entry(value).or_default();
    *slot = slot.saturating_add(1);
}

/// The stored size of a dimension, where the ranks agree.
pub(super) fn stored_dimension(space: &Space<'_>, base: &Expected, d: &Dimension<'_>) -> Option<u64> {
    let shape = space.stored.shape(d.name)?;
    (shape.len() == base.tensors.get(d.name)?.shape.len()).then(|| shape.get(d.axis).copied()).flatten()
}

/// `value + (stored - here) / slope`, where that is a whole number above 0.
fn linear(value: u64, other: u64, d: Dimension<'_>, stored: u64) -> Option<u64> {
    let [value, other, here, there, stored] = [value, other, d.here, d.there, stored].map(i128::from);
    let rise = stored.checked_sub(here)?.checked_mul(value.checked_sub(other)?)?;
    let run = here.checked_sub(there)?;
    if rise.checked_rem(run)? != 0 {
        return None;
    }
    let wanted = value.checked_add(rise.checked_div(run)?)?;
    u64::try_from(wanted).ok().filter(|n| *n > 0)
}

/// The values of a count that stored names imply: one more layer for each number beyond those built.
pub(super) fn by_names(numbered: &Numbered, key: &ProbedKey, base: &Expected) -> Tally {
    let mut tally = Tally::new();
    let (Some(value), Some(other)) = (key.value.as_u64(), key.other.as_u64()) else { return tally };
    let (larger, smaller) = if value > other { (base, &key.built) } else { (&key.built, base) };
    let differ = larger.tensors.keys().filter(|name| !smaller.tensors.contains_key(*name)).map(String::as_str);
    for (pattern, last) in Numbered::from_names(differ).iter() {
        if let Some(stored) = numbered.largest(pattern)
            && let Some(wanted) = value.max(other).checked_add(stored).and_then(|n| n.checked_sub(last))
            && wanted > 0
        {
            add(&mut tally, wanted);
        }
    }
    tally
}
