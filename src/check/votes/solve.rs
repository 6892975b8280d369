//! From a config that does not explain the tensors to one that does: the strongest vote first, until none gains.

use std::collections::BTreeSet;

use serde_json::Value;

use super::probe::{ProbedKey, Tally, by_dimensions, by_names, dimensions, keys, keys_among, stored_dimension};
use super::space::{Space, with};
use crate::checkpoint::pointer;
use crate::knowledge::Expected;

/// Times all values are voted on: a value can hide behind another (image size behind patch size), rarely two.
const ROUNDS: usize = 8;
/// Values tried for one key in a round.
const CANDIDATES: usize = 3;
/// Values beyond this are not searched; it bounds the steps of the search too.
const LARGEST: u64 = 1 << 32;

/// A config, and the class built from it.
#[derive(Clone)]
pub(super) struct SearchState {
    pub config: Value,
    pub built: Expected,
    pub distance: u64,
    /// Pointers to the values that were changed on the way.
    pub changed: BTreeSet<String>,
}

impl SearchState {
    /// The first state: names are spelled as its class spells them.
    pub fn new(space: &mut Space<'_>, config: Value) -> Option<Self> {
        let built = space.build(&config)?;
        space.rename(&built);
        Self::at(space, config)
    }

    /// The state of a config, by the names as they are.
    pub fn at(space: &Space<'_>, config: Value) -> Option<Self> {
        let built = space.build(&config)?;
        let distance = space.distance(&built);
        Some(Self { config, built, distance, changed: BTreeSet::new() })
    }

    /// The state with some values replaced, if the class can be built so.
    fn with(&self, space: &Space<'_>, values: &[(String, Value)]) -> Option<Self> {
        // The copies of a large config are work, too.
        if space.exhausted() {
            return None;
        }
        let mut config = put_all(&self.config, &self.built.config, values);
        let changed = values.iter().map(|(pointer, _)| pointer.clone());
        let built = space.build(&config).or_else(|| {
            for (pointer, value) in values {
                stretch(&mut config, &self.built.config, pointer, value);
            }
            space.build(&config).or_else(|| reconciled(space, &mut config, &self.built.config, values))
        })?;
        let distance = space.distance(&built);
        Some(Self { config, built, distance, changed: self.changed.iter().cloned().chain(changed).collect() })
    }
}

/// `config` with some values replaced; missing parents are taken from `resolved`.
pub(super) fn put_all(config: &Value, resolved: &Value, values: &[(String, Value)]) -> Value {
    let mut config = config.clone();
    for (pointer, value) in values {
        pointer::put(&mut config, resolved, pointer, value.clone());
    }
    config
}

/// Where a config lists something for each layer (`layer_types`), the list follows the number of layers.
pub(super) fn stretch(config: &mut Value, resolved: &Value, pointer: &str, value: &Value) {
    let Some((parent, _)) = pointer.rsplit_once('/') else { return };
    let (Some(before), Some(after)) = (resolved.pointer(pointer).and_then(Value::as_u64), value.as_u64()) else {
        return;
    };
    let (Ok(before), Ok(after)) = (usize::try_from(before), usize::try_from(after)) else { return };
    if before < 2 || after > 4096 {
        return;
    }
    let Some(siblings) = resolved.pointer(parent).and_then(Value::as_object) else { return };
    for (key, sibling) in siblings {
        if let Value::Array(items) = sibling
            && items.len() == before
        {
            let longer: Vec<Value> = items.iter().cycle().take(after).cloned().collect();
            pointer::put(config, resolved, &pointer::join(parent, key), Value::Array(longer));
        }
    }
}

/// A class may refuse a width that its heads do not divide: then a number of heads that does stands in, which no
/// tensor asked for and which is not among the changes.
fn reconciled(space: &Space<'_>, config: &mut Value, resolved: &Value, values: &[(String, Value)]) -> Option<Expected> {
    for (pointer, value) in values {
        let (parent, last) = pointer.rsplit_once('/')?;
        let Some(width) = value.as_u64() else { continue };
        for (key, sibling) in resolved.pointer(parent)?.as_object()? {
            if key == last || !key.contains("head") {
                continue;
            }
            let Some(heads) = sibling.as_u64() else { continue };
            let mut other = config.clone();
            pointer::put(&mut other, resolved, &pointer::join(parent, key), common_divisor(width, heads).into());
            if let Some(built) = space.build(&other) {
                *config = other;
                return Some(built);
            }
        }
    }
    None
}

fn common_divisor(a: u64, b: u64) -> u64 {
    match a.checked_rem(b) {
        None => a,
        Some(rest) => common_divisor(b, rest),
    }
}

/// The config nearest to `start` that votes lead to.
pub(super) fn solve(space: &Space<'_>, start: SearchState) -> SearchState {
    let mut state = start;
    for _ in 0..ROUNDS {
        let before = state.distance;
        if before == 0 {
            break;
        }
        let found = keys(space, &state.config, &state.built);
        state = directly(space, &found, state);
        let found = if state.distance < before {
            // The next round looks for others that now matter.
            keys_among(space, &state.config, &state.built, found.into_iter().map(|key| key.pointer))
        } else {
            found
        };
        state = one_by_one(space, &found, state);
        if state.distance >= before {
            break;
        }
    }
    state
}

/// Dimensions that are a value themselves decide it: products of several values are read more easily after that.
fn directly(space: &Space<'_>, keys: &[ProbedKey], state: SearchState) -> SearchState {
    let votes: Vec<(String, Value)> = keys
        .iter()
        .filter_map(|key| {
            let (pure, _) = by_dimensions(space, key, &state.built);
            let total: usize = pure.values().sum();
            let (value, count) = pure.into_iter().max_by_key(|(_, count)| *count)?;
            let agreed = count.saturating_mul(3) >= total.saturating_mul(2);
            (agreed && key.value.as_u64() != Some(value)).then(|| (key.pointer.clone(), value.into()))
        })
        .collect();
    if votes.is_empty() {
        return state;
    }
    // Together, because sizes that go together may be refused one by one.
    match state.with(space, &votes) {
        Some(next) if next.distance < state.distance => next,
        _ => votes.into_iter().fold(state, |state, vote| match state.with(space, &[vote]) {
            Some(next) if next.distance < state.distance => next,
            _ => state,
        }),
    }
}

/// Each value that would bring the class nearer to the store, the one that brings it nearest first.
fn one_by_one(space: &Space<'_>, keys: &[ProbedKey], mut state: SearchState) -> SearchState {
    // Among those that bring it as near, a size that grows with a value is better explained than one that shrinks.
    let mut proposals: Vec<((u64, bool), String, Value)> = Vec::new();
    for key in keys {
        let distance = |value: &Value| {
            if *value == key.other {
                return Some(space.distance(&key.built));
            }
            Some(state.with(space, &[(key.pointer.clone(), value.clone())])?.distance)
        };
        let best = candidates(space, key, &state)
            .into_iter()
            .filter_map(|value| Some((distance(&value)?, value)))
            .min_by_key(|(distance, _)| *distance)
            .filter(|(distance, _)| *distance < state.distance)
            .or_else(|| inverted(space, key, &state));
        let falls = falls(key, &state.built);
        proposals.extend(best.map(|(distance, value)| ((distance, falls), key.pointer.clone(), value)));
    }
    proposals.sort_by_key(|(rank, _, _)| *rank);
    for (_, pointer, value) in proposals {
        if let Some(next) = state.with(space, &[(pointer, value)])
            && next.distance < state.distance
        {
            state = next;
        }
    }
    state
}

/// Whether some dimension shrinks when the value grows.
fn falls(key: &ProbedKey, base: &Expected) -> bool {
    let (Some(value), Some(other)) = (key.value.as_u64(), key.other.as_u64()) else { return false };
    dimensions(base, &key.built).any(|d| (d.here > d.there) != (value > other))
}

/// Values worth trying for a key, most wanted first.
fn candidates(space: &Space<'_>, key: &ProbedKey, state: &SearchState) -> Vec<Value> {
    match &key.value {
        Value::Bool(flag) => vec![Value::Bool(!flag)],
        Value::Null => {
            // A first value shows what depends on it; a second one, how.
            let probe = |n: u64| {
                let built = space.build(&with(&state.config, &state.built.config, &key.pointer, n.into()))?;
                Some(ProbedKey { pointer: key.pointer.clone(), value: key.other.clone(), other: n.into(), built })
            };
            let Some(second) = probe(16) else { return Vec::new() };
            let (_, mut tally) = by_dimensions(space, &second, &key.built);
            merge(&mut tally, by_names(&space.numbered, &second, &key.built));
            most(tally, None)
        }
        Value::Number(n) if n.is_u64() => {
            let (_, mut tally) = by_dimensions(space, key, &state.built);
            merge(&mut tally, by_names(&space.numbered, key, &state.built));
            let mut values = most(tally, key.value.as_u64());
            // Tensors that exist in the class only because the key has a value, and are not stored.
            let lost = |name: &String| {
                key.built.tensors.get(name) != state.built.tensors.get(name) && !space.stored.contains(name)
            };
            if values.is_empty() && state.built.tensors.keys().any(lost) {
                values.push(Value::Null);
            }
            values
        }
        Value::Number(_) => scaled(space, key, &state.built).into_iter().collect(),
        _ => Vec::new(),
    }
}

fn merge(into: &mut Tally, from: Tally) {
    for (value, count) in from {
        let slot = into.entry(value).or_default();
        *slot = slot.saturating_add(count);
    }
}

fn most(tally: Tally, but: Option<u64>) -> Vec<Value> {
    let mut votes: Vec<(u64, usize)> = tally.into_iter().filter(|(value, _)| Some(*value) != but).collect();
    votes.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    votes.into_iter().take(CANDIDATES).map(|(value, _)| value.into()).collect()
}

/// For a ratio such as `mlp_ratio`: the value that scales the first dimension to what is stored.
#[expect(clippy::cast_precision_loss, reason = "sizes are far below 2^52")]
fn scaled(space: &Space<'_>, key: &ProbedKey, base: &Expected) -> Option<Value> {
    let d = dimensions(base, &key.built).next()?;
    let stored = stored_dimension(space, base, &d)?;
    let value = key.value.as_f64()? * (stored as f64) / (d.here as f64);
    value.is_finite().then(|| value.into())
}

/// The value at which a dimension that no line explains, such as `(image_size / patch_size)²`, comes out as stored.
fn inverted(space: &Space<'_>, key: &ProbedKey, state: &SearchState) -> Option<(u64, Value)> {
    let (value, other) = (key.value.as_u64()?, key.other.as_u64()?);
    let (d, stored) = dimensions(&state.built, &key.built)
        .filter_map(|d| Some((d, stored_dimension(space, &state.built, &d)?)))
        .find(|(d, stored)| d.here != *stored)?;
    let rising = (d.here > d.there) == (value > other);
    let at = |x: u64| {
        let built = space.build(&with(&state.config, &state.built.config, &key.pointer, x.into()))?;
        built.tensors.get(d.name)?.shape.get(d.axis).copied()
    };
    let reached = |x: u64| at(x).map(|size| if rising { size >= stored } else { size <= stored });
    let (mut low, mut high) = (0_u64, value);
    while !reached(high)? {
        low = high;
        high = high.checked_mul(2).filter(|h| *h < LARGEST)?;
    }
    while high.saturating_sub(low) > 1 {
        let middle = low.midpoint(high);
        if reached(middle).unwrap_or(false) {
            high = middle;
        } else {
            low = middle;
        }
    }
    if at(high)? != stored {
        return None;
    }
    let next = state.with(space, &[(key.pointer.clone(), high.into())])?;
    (next.distance < state.distance).then(|| (next.distance, high.into()))
}
