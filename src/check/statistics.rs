//! Statistics of policies: each set against itself.
//!
//! A set has one list for each statistic (`mean`, `std`, `min`, `max`, `q01` …), with one number for each dimension of a state or
//! an action. Policies normalise with `(x - mean) / std` or scale `[q01, q99]` to `[-1, 1]`, and reverse it for actions.

use std::collections::BTreeMap;

use serde_json::{Map, Value, json};

use crate::checkpoint::{Checkpoint, Document, Fault, FaultKind, Place, Shard, pointer};
use crate::knowledge::statistics::StatisticsPlaces;

/// Names of statistics of one number for each dimension, and the mask of `OpenVLA`.
const NAMES: [&str; 11] = ["mean", "std", "min", "max", "q01", "q10", "q50", "q90", "q99", "mask", "count"];
/// Pairs of which the first must not be above the second.
const ORDERED: [(&str, &str); 6] =
    [("min", "max"), ("q01", "q99"), ("q10", "q90"), ("min", "mean"), ("mean", "max"), ("q01", "q50")];
/// Magnitude beyond which a number is no quantity of a robot; VLA024 has the bound for means of SpatialVLA.
const IMPLAUSIBLE: f64 = 1e10;
/// Sets that are read, for hostile documents. Published policies have some dozens.
const MAX_SETS: usize = 4096;

/// A set of statistics.
struct StatisticSet {
    place: Place,
    /// The path that tells it from others: `bridge_orig/action`, `observation.state`.
    name: String,
    /// Values by statistic; `None` for NaN, infinities and null.
    values: BTreeMap<String, Vec<Option<f64>>>,
}

/// Faults of all sets of a checkpoint. Called by the engine.
pub(super) fn faults(checkpoint: &Checkpoint, places: &StatisticsPlaces) -> Vec<Fault> {
    let mut sets = Vec::new();
    for document in checkpoint.documents.values().chain(checkpoint.nested.documents.values()) {
        for kind in places.documents.iter().filter(|kind| kind.file.is_match(&document.name)) {
            sets.extend(of_document(document, &kind.sets));
        }
    }
    for shard in checkpoint.shards.values() {
        sets.extend(of_shard(checkpoint, shard, places));
    }
    sets.iter().take(MAX_SETS).flat_map(StatisticSet::faults).collect()
}

/// The sets below a pointer with `*` steps.
fn of_document(document: &Document, sets: &str) -> Vec<StatisticSet> {
    let Some(value) = &document.value else { return Vec::new() };
    let mut found = vec![(String::new(), String::new(), value)];
    for step in sets.split('/').skip(1) {
        let below = found.into_iter().flat_map(|(path, name, value)| children(&path, &name, value, step));
        found = below.take(MAX_SETS).collect();
    }
    let set = |(path, name, value): (String, String, &Value)| {
        let values = value.as_object().map(numbers).unwrap_or_default();
        let place = Place::file(&document.name).pointer(path);
        (!values.is_empty()).then_some(StatisticSet { place, name, values })
    };
    found.into_iter().filter_map(set).collect()
}

/// The children of a value that a step of a pattern selects, with their pointers and names.
fn children<'v>(path: &str, name: &str, value: &'v Value, step: &str) -> Vec<(String, String, &'v Value)> {
    let Some(map) = value.as_object() else { return Vec::new() };
    let selected = map.iter().filter(|(key, _)| step == "*" || *key == step);
    let child = |(key, value): (&String, &'v Value)| {
        // The steps that a pattern fixes tell nothing apart.
        let name = match (step, name) {
            ("*", "") => key.clone(),
            ("*", name) => format!("{name}/{key}"),
            _ => name.to_owned(),
        };
        (pointer::join(path, key), name, value)
    };
    selected.map(child).collect()
}

/// The lists of numbers of a set, by statistic.
fn numbers(map: &Map<String, Value>) -> BTreeMap<String, Vec<Option<f64>>> {
    let number = |value: &Value| match value {
        Value::Bool(flag) => Some(if *flag { 1.0 } else { 0.0 }),
        other => other.as_f64(),
    };
    let is_number = |value: &Value| value.is_number() || value.is_null() || value.is_boolean();
    let list = |(key, value): (&String, &Value)| {
        let list = value.as_array().filter(|list| NAMES.contains(&key.as_str()) && list.iter().all(is_number))?;
        Some((key.clone(), list.iter().map(number).collect()))
    };
    map.iter().filter_map(list).collect()
}

/// The sets among the tensors of a shard: `action.mean` and `action.std` are one.
fn of_shard(checkpoint: &Checkpoint, shard: &Shard, places: &StatisticsPlaces) -> Vec<StatisticSet> {
    let is_statistics = places.shards.iter().any(|pattern| pattern.is_match(&shard.name));
    let mut sets: BTreeMap<&str, StatisticSet> = BTreeMap::new();
    for tensor in &shard.tensors {
        if !is_statistics && !places.buffers.iter().any(|start| tensor.name.starts_with(start)) {
            continue;
        }
        let Some((stem, statistic)) = tensor.name.rsplit_once('.').filter(|(_, last)| NAMES.contains(last)) else {
            continue;
        };
        let Some(values) = checkpoint.numbers(shard, tensor) else { continue };
        let set = sets.entry(stem).or_insert_with(|| StatisticSet {
            place: Place::file(&shard.name),
            name: stem.to_owned(),
            values: BTreeMap::new(),
        });
        let finite = |value: f64| value.is_finite().then_some(value);
        set.values.insert(statistic.to_owned(), values.into_iter().map(finite).collect());
    }
    sets.into_values().collect()
}

impl StatisticSet {
    fn faults(&self) -> Vec<Fault> {
        let found = [self.not_finite(), self.widths_differ(), self.out_of_order(), self.implausible()];
        found.into_iter().flatten().collect()
    }

    /// A fault of one of the statistics, each of which is a tensor in a shard.
    fn fault(&self, kind: FaultKind, statistic: &str) -> Fault {
        let place = self.place.clone();
        let is_document = place.pointer.is_some();
        let place = if is_document { place } else { place.in_tensor(format!("{}.{statistic}", self.name)) };
        Fault::new(kind).at(place).with("set", self.name.as_str())
    }

    /// A number that is null, NaN or infinite.
    fn not_finite(&self) -> Option<Fault> {
        let first = |(statistic, values): (&String, &Vec<Option<f64>>)| {
            Some((statistic.clone(), values.iter().position(Option::is_none)?, values.len()))
        };
        let (statistic, dimension, width) = self.values.iter().find_map(first)?;
        let fault = self.fault(FaultKind::StatisticsNotFinite, &statistic).with("statistic", statistic);
        Some(fault.with("dimension", dimension).with("width", width))
    }

    /// Lists of different lengths.
    fn widths_differ(&self) -> Option<Fault> {
        let widths: Vec<(&String, usize)> = self
            .values
            .iter()
            .filter(|(name, _)| *name != "count")
            .map(|(name, values)| (name, values.len()))
            .collect();
        let (first, width) = widths.first()?;
        let (other, other_width) = widths.iter().find(|(_, other)| other != width)?;
        let fault = self.fault(FaultKind::StatisticsWidthsDiffer, other);
        let fault = fault.with("one", first.as_str()).with("one_width", *width);
        Some(fault.with("other", other.as_str()).with("other_width", *other_width))
    }

    /// A lower bound above its upper bound. Means are compared with a margin, since they are sums in float32.
    fn out_of_order(&self) -> Option<Fault> {
        let pair = |(low, high): (&str, &str)| {
            let (lows, highs) = (self.values.get(low)?, self.values.get(high)?);
            let dimension = lows.iter().zip(highs).position(|(l, h)| is_above(*l, *h))?;
            let at = |values: &Vec<Option<f64>>| json!(values.get(dimension).copied().flatten());
            let fault = self.fault(FaultKind::StatisticsOutOfOrder, low).with("low", low).with("high", high);
            Some(fault.with("low_value", at(lows)).with("high_value", at(highs)).with("dimension", dimension))
        };
        ORDERED.into_iter().find_map(pair)
    }

    /// A number that no state or action has, or a negative standard deviation.
    fn implausible(&self) -> Option<Fault> {
        let first = |(statistic, values): (&String, &Vec<Option<f64>>)| {
            let is_wrong = |v: f64| v.abs() > IMPLAUSIBLE || statistic == "std" && v < 0.0;
            let dimension = values.iter().position(|value| value.is_some_and(is_wrong))?;
            Some((statistic.clone(), dimension, values.get(dimension).copied().flatten()))
        };
        let (statistic, dimension, value) = self.values.iter().filter(|(name, _)| *name != "count").find_map(first)?;
        let fault = self.fault(FaultKind::StatisticsImplausible, &statistic).with("statistic", statistic);
        Some(fault.with("dimension", dimension).with("value", json!(value)))
    }
}

/// Whether `low` is above `high` by more than rounding explains.
fn is_above(low: Option<f64>, high: Option<f64>) -> bool {
    match (low, high) {
        (Some(low), Some(high)) => low - high > 1e-4 * low.abs().max(high.abs()).max(1e-2),
        _ => false,
    }
}
