//! Votes and their outcome.

use std::fmt;

use serde::Serialize;
use serde_json::Value;

use crate::checkpoint::pointer;
use crate::knowledge::{Evidence, Expected};

/// The votes on one value of config.json.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Vote {
    /// JSON pointer into config.json.
    pub pointer: String,
    /// The value in the config; if the config lacks it, the default of the class; null without a default.
    pub config_value: Value,
    /// Whether config.json contains the value.
    pub given: bool,
    /// The value that the tensors imply.
    pub voted_value: Value,
    /// Number of stored tensors whose name or shape agrees with the voted value.
    #[serde(rename = "for")]
    pub votes_for: usize,
    /// Number of stored tensors whose name or shape disagrees with it.
    #[serde(rename = "against")]
    pub votes_against: usize,
    /// Examples of tensors that agree with it.
    pub evidence: Vec<Witness>,
}

impl Vote {
    /// Whether the tensors contradict the config.
    #[must_use]
    pub fn outvotes(&self) -> bool {
        self.config_value != self.voted_value
    }
}

/// A stored tensor that agrees with a value, under its name in the class.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Witness {
    /// Its name.
    pub tensor: String,
    /// Its stored shape; null if it is unknown.
    pub shape: Option<Vec<u64>>,
}

/// `model.norm.weight [4096]`.
impl fmt::Display for Witness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.tensor)?;
        let Some(shape) = &self.shape else { return Ok(()) };
        let sizes: Vec<String> = shape.iter().map(u64::to_string).collect();
        write!(f, " [{}]", sizes.join(", "))
    }
}

/// Config values of which the tensors determine only a product or a ratio.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Undecided {
    /// JSON pointers into config.json.
    pub pointers: Vec<String>,
    /// The known relation: `head_dim * num_attention_heads = 4096`.
    pub constraint: String,
}

/// The agreement of a class with the stored tensors, before the rules of a loader.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Fit {
    /// Tensors that the class expects; tied tensors count once.
    pub expected: usize,
    /// Of these, stored.
    pub found: usize,
    /// Of these, stored with another shape.
    pub mismatched: usize,
    /// Stored tensors.
    pub stored: usize,
}

impl Fit {
    /// Of a class and the tensors stored under its names.
    #[must_use]
    pub fn new(expected: &Expected, stored: &Evidence) -> Self {
        let mut fit = Self { stored: stored.iter().count(), ..Self::default() };
        for (name, tensor) in &expected.tensors {
            let here = stored.contains(name);
            let elsewhere = tensor.tied_to.as_ref().is_some_and(|to| stored.contains(to));
            if here || !elsewhere {
                fit.expected = fit.expected.saturating_add(1);
            }
            fit.found = fit.found.saturating_add(usize::from(here));
            let differs = stored.shape(name).is_some_and(|shape| shape != tensor.shape);
            fit.mismatched = fit.mismatched.saturating_add(usize::from(differs));
        }
        fit
    }

    /// Share of names and shapes that both sides agree on, from 0 to 1.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "counts of tensors are far below 2^52")]
    pub fn score(&self) -> f64 {
        let union = self.expected.saturating_add(self.stored).saturating_sub(self.found);
        let good = self.found.saturating_sub(self.mismatched);
        if union == 0 { 0.0 } else { good as f64 / union as f64 }
    }

    /// Whether every name and shape agrees.
    #[cfg(any(test, feature = "internals"))]
    #[must_use]
    pub const fn is_exact(&self) -> bool {
        self.found == self.expected && self.found == self.stored && self.mismatched == 0
    }
}

/// The outcome of a vote.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Votes {
    /// Every value that the tensors determine, in the order of the config.
    pub votes: Vec<Vote>,
    /// Values that they leave open.
    pub undecided: Vec<Undecided>,
    /// The config with the voted values in place.
    #[serde(skip)]
    pub config: Value,
    /// The same with the class's defaults filled in.
    #[serde(skip)]
    pub resolved: Value,
    /// The agreement with the values of the config.
    pub before: Fit,
    /// The agreement with the voted values.
    pub after: Fit,
    /// Whether the search stopped early because the model is large.
    #[serde(skip)]
    pub exhausted: bool,
}

impl Votes {
    /// Writes the voted value into another config; for an element of a list, the whole list.
    pub fn apply(&self, vote: &Vote, config: &mut Value) {
        let ends = vote.pointer.match_indices('/').map(|(at, _)| at).skip(1);
        let outer = ends.filter_map(|end| vote.pointer.get(..end));
        match outer.filter_map(|p| Some((p, self.resolved.pointer(p)?))).find(|(_, value)| value.is_array()) {
            Some((pointer, list)) => pointer::put(config, &Value::Null, pointer, list.clone()),
            None => pointer::put(config, &Value::Null, &vote.pointer, vote.voted_value.clone()),
        };
    }

    /// The votes that contradict the config.
    pub fn outvoted(&self) -> impl Iterator<Item = &Vote> {
        self.votes.iter().filter(|vote| vote.outvotes())
    }
}
