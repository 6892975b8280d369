//! Stored layers of a model that its class does not build: the model computes without them.
//!
//! A config that says fewer layers than are stored makes a smaller model of the first ones. The loader ignores the others with
//! a warning, as it ignores heads of other tasks and buffers of old versions, without which nothing is computed otherwise.

use std::collections::{BTreeMap, BTreeSet};

use crate::knowledge::Expected;
use crate::knowledge::prediction::{PredictionLayers, numbered};

/// A list of layers that the class builds.
#[derive(Default)]
struct Layers<'e> {
    last: u64,
    /// What follows the number in the names of its tensors.
    tensors: BTreeSet<&'e str>,
}

/// Those of the ignored tensors that lie in layers behind the last that the class builds, and are named as in the others. Called
/// for the load report of each class.
pub(in crate::check) fn unbuilt(expected: &Expected, ignored: &[String]) -> Vec<String> {
    if ignored.is_empty() {
        return Vec::new();
    }
    let prefix = format!("{}.", expected.base_model_prefix);
    let mut built: BTreeMap<&str, Layers<'_>> = BTreeMap::new();
    for name in expected.tensors.keys() {
        for (list, number, rest) in numbered(bare(name, &prefix)) {
            let layers = built.entry(list).or_default();
            layers.last = layers.last.max(number);
            layers.tensors.insert(rest);
        }
    }
    let names = expected.tensors.keys().chain(ignored).map(|name| bare(name, &prefix));
    let predicting = PredictionLayers::built_in().among(&expected.config, names);
    let is_unbuilt = |name: &&String| {
        numbered(bare(name, &prefix)).any(|(list, number, rest)| {
            let beyond = |layers: &Layers<'_>| number > layers.last && layers.tensors.contains(rest);
            built.get(list).is_some_and(beyond) && !predicting.contains(&(list, number))
        })
    };
    ignored.iter().filter(is_unbuilt).cloned().collect()
}

/// A name without the prefix of the base model, which a file may have or not.
fn bare<'n>(name: &'n str, prefix: &str) -> &'n str {
    if prefix.len() > 1 { name.strip_prefix(prefix).unwrap_or(name) } else { name }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::knowledge::ExpectedTensor;

    #[test]
    fn layers_behind_the_last_are_of_the_model() {
        let built =
            ["transformer.h.0.attn.weight", "transformer.h.0.mlp.weight", "transformer.wte.weight", "lm_head.weight"];
        let tensors = built.iter().map(|name| ((*name).to_owned(), ExpectedTensor::default())).collect();
        let expected = Expected { tensors, base_model_prefix: "transformer".to_owned(), ..Expected::default() };
        let of = |names: &[&str]| unbuilt(&expected, &names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>());
        assert_eq!(
            of(&["transformer.h.1.attn.weight", "h.2.mlp.weight"]),
            ["transformer.h.1.attn.weight", "h.2.mlp.weight"]
        );
        // Buffers of old versions, other heads, a head of another task, and a layer that predicts further tokens.
        assert!(
            of(&["transformer.h.0.attn.bias", "h.1.attn.masked_bias", "score.weight", "mtp.h.1.attn.weight"])
                .is_empty()
        );
        assert!(of(&["transformer.h.1.attn.weight", "transformer.h.1.eh_proj.weight"]).is_empty());
    }
}
