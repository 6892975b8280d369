//! Layers that predict further tokens: `rules/prediction-layers.json5`.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use serde::Deserialize;
use serde_json::Value;

use super::source::{self, DataError};

static BUILT_IN: LazyLock<PredictionLayers> = LazyLock::new(|| PredictionLayers::embedded().unwrap_or_default());

/// `rules/prediction-layers.json5`: what tells a layer that predicts further tokens from an ordinary one.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PredictionLayers {
    /// Keys of a config that state the number of such layers.
    keys: Vec<String>,
    /// Key of the number of ordinary layers, beside them.
    depth: String,
    /// Parts of names that no ordinary layer has.
    parts: Vec<String>,
    /// Pages that were read.
    #[allow(dead_code, reason = "for readers of the file")]
    sources: Vec<String>,
}

/// What the layers of one list hold, by number: what follows the number in the names of tensors.
type Layers<'n> = BTreeMap<u64, BTreeSet<&'n str>>;

impl PredictionLayers {
    /// The file, parsed.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; a test parses it.
    fn embedded() -> Result<Self, DataError> {
        let file = "prediction-layers.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// The built-in data.
    #[must_use]
    pub fn built_in() -> &'static Self {
        &BUILT_IN
    }

    /// The layers among these tensors that predict further tokens, as the start of their names and their number:
    /// `("model.layers", 61)`. Called with stored names by the votes, and with those that a loader ignores by load reports.
    ///
    /// A layer with one of the parts is one. So is a layer that the config states behind the last ordinary one, if it holds
    /// what an ordinary layer holds and more: the parts of further models are not known.
    pub fn among<'n>(&self, config: &Value, names: impl Iterator<Item = &'n str>) -> BTreeSet<(&'n str, u64)> {
        let mut lists: BTreeMap<&str, Layers<'_>> = BTreeMap::new();
        for (list, number, rest) in names.flat_map(numbered) {
            lists.entry(list).or_default().entry(number).or_default().insert(rest);
        }
        let has_part = |held: &BTreeSet<&str>| {
            held.iter().any(|rest| rest.split('.').any(|part| self.parts.iter().any(|known| known == part)))
        };
        let stated = self.stated(config);
        let mut found = BTreeSet::new();
        for (list, layers) in &lists {
            let ordinary = |depth: u64| layers.range(..depth).map(|(_, held)| held).filter(|held| !held.is_empty());
            let is_stated = |number: u64, held: &BTreeSet<&str>| {
                stated.is_some_and(|(depth, count)| {
                    (depth..depth.saturating_add(count)).contains(&number)
                        && ordinary(depth).any(|other| other.len() < held.len() && other.is_subset(held))
                })
            };
            let own = layers.iter().filter(|(number, held)| has_part(held) || is_stated(**number, held));
            found.extend(own.map(|(number, _)| (*list, *number)));
        }
        found
    }

    /// The number of ordinary layers and of those that predict further tokens, if the config states any.
    #[must_use]
    pub fn stated(&self, config: &Value) -> Option<(u64, u64)> {
        let of = |config: &Value| {
            let counts = self.keys.iter().filter_map(|key| config.get(key)?.as_u64());
            let count = counts.max().filter(|count| *count > 0)?;
            Some((config.get(&self.depth)?.as_u64()?, count))
        };
        of(config).or_else(|| of(config.get("text_config")?))
    }
}

/// Whether a tensor lies in one of these layers.
#[must_use]
pub fn lies_in(layers: &BTreeSet<(&str, u64)>, name: &str) -> bool {
    !layers.is_empty() && numbered(name).any(|(list, number, _)| layers.contains(&(list, number)))
}

/// The numbers in a name: what stands before each, the number, and what follows.
pub fn numbered(name: &str) -> impl Iterator<Item = (&str, u64, &str)> {
    let dots = name.match_indices('.').map(|(at, _)| at);
    dots.filter_map(|at| {
        let (list, rest) = (name.get(..at)?, name.get(at.checked_add(1)?..)?);
        let (number, rest) = rest.split_once('.')?;
        Some((list, number.parse().ok()?, rest))
    })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn among(config: &Value, names: &[&'static str]) -> Vec<u64> {
        let layers = PredictionLayers::embedded().unwrap();
        layers.among(config, names.iter().copied()).into_iter().map(|(_, number)| number).collect()
    }

    #[test]
    fn known_parts_and_stated_layers_are_told_from_ordinary_ones() {
        let of = |depth: u64, count: u64| json!({ "num_hidden_layers": depth, "num_nextn_predict_layers": count });
        let known = ["m.layers.0.norm.weight", "m.layers.1.norm.weight", "m.layers.1.eh_proj.weight"];
        assert_eq!(among(&json!({}), &known), [1]);
        let unknown = ["m.layers.0.norm.weight", "m.layers.1.norm.weight", "m.layers.1.mix.weight"];
        assert_eq!(among(&json!({}), &unknown), [] as [u64; 0]);
        assert_eq!(among(&of(1, 1), &unknown), [1]);
        assert_eq!(among(&json!({ "text_config": of(1, 1) }), &unknown), [1]);
        // A config that states a layer too few, or none of these.
        assert_eq!(among(&of(1, 0), &unknown), [] as [u64; 0]);
        assert_eq!(among(&of(1, 1), &["m.layers.0.norm.weight", "m.layers.1.norm.weight"]), [] as [u64; 0]);
        // Dense layers first, then a mixture of experts: the surplus layer is an ordinary one of another kind.
        let kinds =
            ["l.0.norm.weight", "l.0.up.weight", "l.1.norm.weight", "l.1.experts.0.up.weight", "l.1.gate.weight"];
        assert_eq!(among(&of(1, 1), &kinds), [] as [u64; 0]);
    }
}
