//! What changed where: maps of both checkpoints, and the changes by layer.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::{ComparedBytes, Differences, TensorDifferences};
use crate::check::inspect::{ModuleMap, Painted, PropertyKind, by_dtype};
use crate::checkpoint::{Checkpoint, Distance};

/// Rows of the table by layer: the kinds of tensors that changed the most.
const ROWS: usize = 60;
/// Columns of the table by layer.
const COLUMNS: usize = 200;

/// The maps of two compared checkpoints: the first by what became of its tensors, the second by those that it alone has.
/// Called for the page of `diff`, with what [`compare`](super::compare) found.
#[must_use]
pub fn maps(one: &Checkpoint, other: &Checkpoint, differences: &Differences) -> [ModuleMap; 2] {
    let found = &differences.tensors;
    let added: HashMap<&str, usize> = found.added.iter().map(|one| (one.name.as_str(), 1)).collect();
    let map = |checkpoint, values: &[&str], named| {
        let values = values.iter().map(|&value| value.to_owned()).collect();
        ModuleMap::new(checkpoint, &[Painted::by_name(PropertyKind::Change, values, named), by_dtype(checkpoint)])
    };
    let first = [kept(one, found), "changed", "recast", "reshaped", "removed"];
    [map(one, &first, listed(found)), map(other, &["in both", "added"], added)]
}

/// The names in the lists of differences, with the number of their list, from 1: those of the first checkpoint.
fn listed(found: &TensorDifferences) -> HashMap<&str, usize> {
    let changed = found.changed.iter().map(|one| (one.name.as_str(), 1));
    let recast = found.recast.iter().map(|one| (one.name.as_str(), 2));
    let reshaped = found.reshaped.iter().map(|one| (one.name.as_str(), 3));
    let removed = found.removed.iter().map(|one| (one.name.as_str(), 4));
    changed.chain(recast).chain(reshaped).chain(removed).collect()
}

/// What is known of the tensors of the first checkpoint that no list of differences names.
fn kept(one: &Checkpoint, found: &TensorDifferences) -> &'static str {
    let listed = listed(found);
    let names: BTreeSet<&str> = one.tensors().map(|(_, tensor)| tensor.name.as_str()).collect();
    let others = names.iter().filter(|name| !listed.contains_key(*name)).count();
    match found.bytes {
        _ if found.equal != others => "equal or not compared",
        ComparedBytes::Sampled => "no difference found",
        ComparedBytes::All | ComparedBytes::Measured | ComparedBytes::Ranked => "equal",
    }
}

/// The tensors that differ in their bytes, by layer: a row for each kind of tensor, a column for each number of a layer.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ChangesByLayer {
    /// Numbers of the layers, ascending.
    pub layers: Vec<u64>,
    /// Layers that are not among them.
    pub further_layers: usize,
    /// Kinds of tensors, those that changed the most first.
    pub rows: Vec<ChangedKind>,
    /// Kinds that changed and are not among the rows.
    pub further_rows: usize,
    /// What is known of a tensor that is not among the changed ones: `equal`.
    pub kept: &'static str,
}

/// Tensors whose names differ only in numbers.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ChangedKind {
    /// Their names, with `*` for the number of the layer and `#` for other numbers.
    pub pattern: String,
    /// For each layer what changed there; `None` for a layer without such a tensor.
    pub cells: Vec<Option<ChangedCell>>,
}

/// The tensors of one kind in one layer.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ChangedCell {
    /// All of them.
    pub tensors: usize,
    /// Those with other bytes.
    pub changed: usize,
    /// How far these are from the first checkpoint's; missing unless it was measured for all of them.
    pub by: Option<Distance>,
}

impl ChangedCell {
    /// Counts a tensor with other bytes, and how far it is from the first checkpoint's.
    fn change(&mut self, by: Option<Distance>) {
        self.by = if self.changed == 0 { by } else { self.by.zip(by).map(|(one, other)| one.and(other)) };
        self.changed = self.changed.saturating_add(1);
    }
}

/// The changed tensors of the first checkpoint by layer. Called for the page of `diff`.
#[must_use]
pub fn changes_by_layer(one: &Checkpoint, found: &TensorDifferences) -> ChangesByLayer {
    let changed = found.changed.iter().map(|one| (one.name.as_str(), one.by));
    let recast = found.recast.iter().map(|one| (one.name.as_str(), one.by));
    let changes: HashMap<&str, Option<Distance>> = changed.chain(recast).collect();
    let mut kinds: BTreeMap<String, BTreeMap<u64, ChangedCell>> = BTreeMap::new();
    let removed = found.removed.iter().map(|one| one.name.as_str());
    let elsewhere: BTreeSet<&str> = removed.chain(found.reshaped.iter().map(|one| one.name.as_str())).collect();
    for (_, tensor) in one.tensors().filter(|(_, tensor)| !elsewhere.contains(tensor.name.as_str())) {
        let Some((pattern, layer)) = kind(&tensor.name) else { continue };
        let cell = kinds.entry(pattern).or_default().entry(layer).or_default();
        cell.tensors = cell.tensors.saturating_add(1);
        if let Some(by) = changes.get(tensor.name.as_str()) {
            cell.change(*by);
        }
    }
    kinds.retain(|_, cells| cells.len() > 1 && cells.values().any(|cell| cell.changed > 0));
    let mut layers: Vec<u64> = kinds.values().flat_map(|cells| cells.keys().copied()).collect();
    layers.sort_unstable();
    layers.dedup();
    let further_layers = layers.len().saturating_sub(COLUMNS);
    layers.truncate(COLUMNS);
    let row = |(pattern, cells): (String, BTreeMap<u64, ChangedCell>)| ChangedKind {
        pattern,
        cells: layers.iter().map(|layer| cells.get(layer).copied()).collect(),
    };
    let mut rows: Vec<ChangedKind> = kinds.into_iter().map(row).collect();
    let further_rows = rows.len().saturating_sub(ROWS);
    rows.sort_by(|a, b| b.most().total_cmp(&a.most()));
    rows.truncate(ROWS);
    ChangesByLayer { layers, further_layers, rows, further_rows, kept: kept(one, found) }
}

impl ChangedKind {
    /// The largest relative change; of kinds that were not measured, all are alike.
    fn most(&self) -> f64 {
        let cells = self.cells.iter().flatten().filter(|cell| cell.changed > 0);
        cells.map(|cell| cell.by.and_then(Distance::relative).unwrap_or_default()).fold(0.0, f64::max)
    }
}

/// The name of a tensor with `*` for its first number and `#` for others, and that number.
fn kind(name: &str) -> Option<(String, u64)> {
    let mut layer = None;
    let mut part = |part: &str| match part.parse::<u64>() {
        Ok(number) if layer.is_none() => {
            layer = Some(number);
            "*".to_owned()
        }
        Ok(_) => "#".to_owned(),
        Err(_) => part.to_owned(),
    };
    let parts: Vec<String> = name.split('.').map(&mut part).collect();
    Some((parts.join("."), layer?))
}

#[cfg(test)]
mod tests {
    use super::kind;

    #[test]
    fn the_first_number_is_the_layer() {
        assert_eq!(kind("m.layers.3.experts.7.w"), Some(("m.layers.*.experts.#.w".to_owned(), 3)));
        assert_eq!(kind("lm_head.weight"), None);
    }
}
