//! Counts, for each key, the tensors that agree with its value and those that disagree, and finds undetermined keys.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::probe::{ProbedKey, dimensions, keys, keys_among, stored_dimension};
use super::solve::SearchState;
use super::space::{Space, with};
use super::vote::{Undecided, Vote, Witness};
use crate::knowledge::Expected;

/// Tensors named for one vote.
const WITNESSES: usize = 3;

/// The votes on the values that the search changed.
pub(super) fn votes_on_changes(space: &Space<'_>, state: &SearchState, given: &Value, said: &Value) -> Vec<Vote> {
    let state = &pinned(space, state);
    let keys = keys_among(space, &state.config, &state.built, state.changed.iter().cloned());
    keys.iter().map(|key| vote(space, key, state, given, said)).collect()
}

/// The state with computed values written out, so that each value is independent: `head_dim` no longer follows
/// `hidden_size`.
fn pinned(space: &Space<'_>, state: &SearchState) -> SearchState {
    let pinned = SearchState::at(space, state.built.config.clone()).filter(|s| s.built.tensors == state.built.tensors);
    pinned.map_or_else(|| state.clone(), |pinned| SearchState { changed: state.changed.clone(), ..pinned })
}

/// The votes on every value that shapes the class, and the values that no tensor decides.
///
/// `said` is the config as it was given with defaults filled in, `given` that without them.
pub(super) fn votes(
    space: &Space<'_>,
    state: &SearchState,
    given: &Value,
    said: &Value,
) -> (Vec<Vote>, Vec<Undecided>) {
    let state = &pinned(space, state);
    let keys = keys(space, &state.config, &state.built);
    let undecided = undecided(&keys, state);
    let loose: BTreeSet<&str> = undecided.iter().flat_map(|u| &u.pointers).map(String::as_str).collect();
    let mut votes = Vec::new();
    for key in &keys {
        let vote = vote(space, key, state, given, said);
        let changed = state.changed.contains(&key.pointer);
        // A change that was needed stands even if another pair of values would have done as well.
        if changed || (!loose.contains(key.pointer.as_str()) && vote.votes_for > 0) {
            votes.push(vote);
        }
    }
    (votes, undecided)
}

fn vote(space: &Space<'_>, key: &ProbedKey, state: &SearchState, given: &Value, said: &Value) -> Vote {
    let mut ballot = Ballot::default();
    ballot.count(space, &state.built, &key.built);
    if let Some(more) = key.value.as_u64().and_then(|n| n.checked_add(1))
        && let Some(built) = space.build(&with(&state.config, &state.built.config, &key.pointer, more.into()))
    {
        ballot.count(space, &state.built, &built);
    }
    let evidence = ballot.witnesses(space, &state.built, &key.value);
    let against: BTreeSet<&str> = ballot.differ.iter().map(|(name, _)| *name).collect();
    let agree: BTreeSet<&str> = ballot.agree.iter().map(|(name, _)| *name).filter(|n| !against.contains(n)).collect();
    // A value that the search did not change may follow from others, so its earlier value is not that of the config.
    let before = if state.changed.contains(&key.pointer) { said.pointer(&key.pointer) } else { Some(&key.value) };
    Vote {
        pointer: key.pointer.clone(),
        config_value: before.cloned().unwrap_or(Value::Null),
        given: given.pointer(&key.pointer).is_some(),
        voted_value: key.value.clone(),
        votes_for: agree.len(),
        votes_against: against.len(),
        evidence,
    }
}

/// Dimensions, as name and axis, and names, without one, that depend on a value.
#[derive(Default)]
struct Ballot<'e> {
    agree: BTreeSet<(&'e str, Option<usize>)>,
    differ: BTreeSet<(&'e str, Option<usize>)>,
}

impl<'e> Ballot<'e> {
    /// The differences between the class with the voted value and with another one; the stored tensors agree with one.
    ///
    /// A name that is not stored is no evidence: it may have been lost.
    fn count(&mut self, space: &'e Space<'_>, voted: &'e Expected, other: &Expected) {
        let names: BTreeMap<&str, &str> = voted.tensors.keys().map(|name| (name.as_str(), name.as_str())).collect();
        for d in dimensions(voted, other) {
            if let (Some(stored), Some(name)) = (stored_dimension(space, voted, &d), names.get(d.name)) {
                let side = if stored == d.here { &mut self.agree } else { &mut self.differ };
                side.insert((name, Some(d.axis)));
            }
        }
        let vanished = voted.tensors.keys().filter(|name| !other.tensors.contains_key(*name));
        self.agree.extend(vanished.filter(|name| space.stored.contains(name)).map(|name| (name.as_str(), None)));
        let appeared = other.tensors.keys().filter(|name| !voted.tensors.contains_key(*name));
        for name in appeared {
            if let Some((name, _)) = space.stored.get(name) {
                self.differ.insert((name, None));
            }
        }
    }

    /// A few tensors that agree: first those with a dimension that is the value itself, then the last ones, which
    /// show how many there are.
    fn witnesses(&self, space: &Space<'_>, voted: &Expected, value: &Value) -> Vec<Witness> {
        let size = |name: &str, axis: &Option<usize>| voted.tensors.get(name)?.shape.get((*axis)?).copied();
        let order: BTreeMap<&str, usize> =
            voted.tensors.keys().enumerate().map(|(i, name)| (name.as_str(), i)).collect();
        let mut ranked: Vec<(bool, bool, usize, &str)> = self
            .agree
            .iter()
            .map(|(name, axis)| {
                let at = order.get(name).copied().unwrap_or(0);
                let at = if axis.is_some() { at } else { usize::MAX.saturating_sub(at) };
                (size(name, axis) != value.as_u64() || axis.is_none(), axis.is_none(), at, *name)
            })
            .collect();
        ranked.sort_unstable();
        let mut seen = BTreeSet::new();
        let names = ranked.into_iter().map(|(_, _, _, name)| name).filter(|name| seen.insert(*name));
        names
            .take(WITNESSES)
            .map(|name| Witness { tensor: name.to_owned(), shape: space.stored.shape(name).map(<[u64]>::to_vec) })
            .collect()
    }
}

/// Values of which only products or ratios show in the tensors: halving one and doubling another changes nothing.
fn undecided(keys: &[ProbedKey], state: &SearchState) -> Vec<Undecided> {
    // Every dimension as a product of powers of the values: one row for each set of exponents that occurs.
    let mut rows: BTreeMap<(&str, usize), BTreeMap<usize, i8>> = BTreeMap::new();
    let mut fixed = BTreeSet::new();
    for (at, key) in keys.iter().enumerate() {
        let names_change = key.built.tensors.len() != state.built.tensors.len()
            || key.built.tensors.keys().any(|name| !state.built.tensors.contains_key(name));
        let (Some(value), Some(other), false) = (key.value.as_u64(), key.other.as_u64(), names_change) else {
            fixed.insert(at);
            continue;
        };
        for d in dimensions(&state.built, &key.built) {
            match exponent(value, other, d.here, d.there) {
                Some(exponent) => {
                    rows.entry((d.name, d.axis)).or_default().insert(at, exponent);
                }
                None => {
                    fixed.insert(at);
                }
            }
        }
    }
    let rows: BTreeSet<Vec<(usize, i8)>> = rows.into_values().map(|row| row.into_iter().collect()).collect();
    let loose: Vec<usize> = (0..keys.len()).filter(|at| !fixed.contains(at)).collect();
    let vanishes = |change: &[(usize, i8)]| {
        rows.iter().all(|row| {
            let of = |at: &usize| change.iter().find(|(k, _)| k == at).map_or(0, |(_, sign)| i16::from(*sign));
            row.iter().map(|(at, exponent)| i16::from(*exponent).saturating_mul(of(at))).sum::<i16>() == 0
        })
    };
    let mut found: Vec<Undecided> = Vec::new();
    let mut taken = BTreeSet::new();
    let mut report = |change: &[(usize, i8)]| {
        if vanishes(change) && change.iter().all(|(at, _)| !taken.contains(at)) {
            taken.extend(change.iter().map(|(at, _)| *at));
            found.extend(Undecided::from_scaling(change, keys));
        }
    };
    for (n, &a) in loose.iter().enumerate() {
        let rest = loose.get(n.saturating_add(1)..).unwrap_or_default();
        for &b in rest {
            report(&[(a, 1), (b, -1)]);
            report(&[(a, 1), (b, 1)]);
        }
    }
    for (n, &a) in loose.iter().enumerate() {
        let rest = loose.get(n.saturating_add(1)..).unwrap_or_default();
        for (m, &b) in rest.iter().enumerate() {
            for &c in rest.get(m.saturating_add(1)..).unwrap_or_default() {
                for signs in [(1, -1), (-1, 1), (-1, -1), (1, 1)] {
                    report(&[(a, 1), (b, signs.0), (c, signs.1)]);
                }
            }
        }
    }
    found
}

impl Undecided {
    /// From which values can be scaled together, each with the sign of its exponent.
    fn from_scaling(change: &[(usize, i8)], keys: &[ProbedKey]) -> Option<Self> {
        // Name the odd one out first: with it, every other forms a product.
        let positive = change.iter().filter(|(_, sign)| *sign > 0).count();
        let odd = if positive.saturating_mul(2) > change.len() { -1 } else { 1 };
        let (lead, lead_sign) = change.iter().find(|(_, sign)| *sign == odd).or_else(|| change.first())?;
        let lead_key = keys.get(*lead)?;
        let parts: Vec<String> = change
            .iter()
            .filter(|(at, _)| at != lead)
            .filter_map(|(at, sign)| {
                let key = keys.get(*at)?;
                let (x, y) = (lead_key.value.as_u64()?, key.value.as_u64()?);
                let (a, b) = (dotted(&key.pointer), dotted(&lead_key.pointer));
                if sign == lead_sign {
                    let (over, under, x, y) = if y >= x { (a, b, y, x) } else { (b, a, x, y) };
                    Some(match x.checked_rem(y)? {
                        0 => format!("{over} / {under} = {}", x.checked_div(y)?),
                        _ => format!("{over} / {under} = {x} / {y}"),
                    })
                } else {
                    Some(format!("{a} * {b} = {}", x.checked_mul(y)?))
                }
            })
            .collect();
        let pointers = change.iter().filter_map(|(at, _)| Some(keys.get(*at)?.pointer.clone())).collect();
        Some(Self { pointers, constraint: parts.join(", ") })
    }
}

fn dotted(pointer: &str) -> String {
    pointer.trim_start_matches('/').replace('/', ".")
}

/// `e` where the dimension is a constant times the value to the power of `e`.
fn exponent(value: u64, other: u64, here: u64, there: u64) -> Option<i8> {
    let [v, o, h, t] = [value, other, here, there].map(u128::from);
    let same = |a: u128, b: u128, c: u128, d: u128| a.checked_mul(b).is_some_and(|x| Some(x) == c.checked_mul(d));
    if same(h, o, t, v) {
        Some(1)
    } else if same(h, v, t, o) {
        Some(-1)
    } else if same(h, o.checked_mul(o)?, t, v.checked_mul(v)?) {
        Some(2)
    } else {
        None
    }
}
