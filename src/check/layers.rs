//! Layers of an unknown class: one that lacks a tensor which all its siblings have.
//!
//! Without a class, only the clearest case is reported: a stack of layers that are alike but
//! for one or two, and these lack some tensors and have none of their own. Layers of two kinds (dense and sparse ones,
//! attention and state space) differ in more than what one of them lacks, or too often.

use std::collections::{BTreeMap, BTreeSet};

use crate::checkpoint::{Fault, FaultKind, Place};

/// Least number of layers in a stack for its majority to count.
const STACK: usize = 6;
/// Most layers of a stack that may be at fault.
const ODD: usize = 2;
/// Most tensors that a layer lacks by accident; more are a layer of another kind.
const LACKING: usize = 4;
/// Faults that are reported.
const CAP: usize = 20;

/// A fault for each layer that lacks what its siblings have.
#[must_use]
pub fn faults<'n>(names: impl Iterator<Item = &'n str>) -> Vec<Fault> {
    // "model.layers." -> 7 -> what layer 7 holds.
    let mut stacks: BTreeMap<&str, BTreeMap<u64, BTreeSet<&str>>> = BTreeMap::new();
    for name in names {
        for (stack, index, rest) in indexed(name) {
            stacks.entry(stack).or_default().entry(index).or_default().insert(rest);
        }
    }
    let mut faults: Vec<Fault> = stacks.iter().flat_map(|(stack, layers)| lacking(stack, layers)).collect();
    faults.truncate(CAP);
    faults
}

/// A name at each of its numbers: what stands before, the number, what stands after.
fn indexed(name: &str) -> impl Iterator<Item = (&str, u64, &str)> {
    name.match_indices('.').filter_map(|(dot, _)| {
        let (stack, after) = name.split_at_checked(dot.saturating_add(1))?;
        let (index, rest) = after.split_once('.')?;
        let number = index.bytes().all(|b| b.is_ascii_digit()).then(|| index.parse().ok())??;
        Some((stack, number, rest))
    })
}

fn lacking(stack: &str, layers: &BTreeMap<u64, BTreeSet<&str>>) -> Vec<Fault> {
    let mut kinds: BTreeMap<&BTreeSet<&str>, Vec<u64>> = BTreeMap::new();
    for (index, held) in layers {
        kinds.entry(held).or_default().push(*index);
    }
    let Some((usual, members)) = kinds.iter().max_by_key(|(_, members)| members.len()) else { return Vec::new() };
    let odd: Vec<(u64, &BTreeSet<&str>)> =
        kinds.iter().filter(|(held, _)| *held != usual).flat_map(|(held, m)| m.iter().map(|i| (*i, *held))).collect();
    // At the ends of a stack layers are often of another kind: first_k_dense_replace, a last layer without attention.
    let ends = [layers.keys().next(), layers.keys().next_back()];
    let by_design = |(index, held): &(u64, &BTreeSet<&str>)| {
        let lacks = usual.difference(held).count();
        !held.is_subset(usual) || lacks > LACKING || (ends.contains(&Some(index)) && lacks > 1)
    };
    if members.len() < STACK || odd.is_empty() || odd.len() > ODD || odd.iter().any(by_design) {
        return Vec::new();
    }
    odd.iter()
        .map(|(index, held)| {
            let lost: Vec<String> = usual.difference(held).map(|rest| format!("{stack}{index}.{rest}")).collect();
            let mut fault = Fault::new(FaultKind::LayerLacksTensor)
                .with("layer", format!("{stack}{index}"))
                .with("siblings", members.len())
                .with("names", lost.clone())
                .with("lacks", lost.len());
            fault.places = lost.iter().map(Place::tensor).collect();
            fault
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::faults;

    fn stack(layers: u64, held: impl Fn(u64) -> Vec<&'static str>) -> Vec<String> {
        (0..layers).flat_map(|i| held(i).into_iter().map(move |rest| format!("h.{i}.{rest}"))).collect()
    }

    fn missing(names: &[String]) -> Vec<String> {
        let faults = faults(names.iter().map(String::as_str));
        let lists = faults.iter().filter_map(|f| f.detail.get("names")?.as_array());
        lists.flatten().filter_map(|name| name.as_str()).map(str::to_owned).collect()
    }

    #[test]
    fn one_layer_that_lacks_a_tensor_is_named() {
        let names = stack(12, |i| if i == 5 { vec!["a.weight"] } else { vec!["a.weight", "b.weight"] });
        assert_eq!(missing(&names), ["h.5.b.weight"]);
    }

    #[test]
    fn layers_of_two_kinds_are_by_design() {
        // Every third layer, the first one, too few layers, and one with other tensors instead.
        assert!(missing(&stack(12, |i| if i % 3 == 0 { vec!["a"] } else { vec!["a", "b"] })).is_empty());
        assert!(missing(&stack(12, |i| if i == 0 { vec!["mlp"] } else { vec!["gate", "mlp", "up"] })).is_empty());
        assert!(missing(&stack(4, |i| if i == 2 { vec!["a"] } else { vec!["a", "b"] })).is_empty());
        assert!(missing(&stack(12, |i| if i == 5 { vec!["a", "c"] } else { vec!["a", "b"] })).is_empty());
    }
}
