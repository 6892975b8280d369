//! Architectures run backwards: each stored tensor votes for the config values that explain its name and shape.
//!
//! The class is a black box. One value of the config is changed, what the class builds then shows which names and
//! dimensions follow it, and those that are stored say what it should be. A value is believed when building with it
//! brings the class nearer to the store.

mod explain;
mod probe;
mod solve;
mod space;
mod tally;
#[cfg(test)]
mod tests;

use std::fmt;

use serde::Serialize;
use serde_json::Value;

pub use self::explain::{Explanation, explain, fault};
use self::solve::State;
use self::space::Space;
pub(super) use self::space::{leaves, with};
use super::load::Stored;
use crate::knowledge::{Architecture, Evidence, Expected};

/// Times the stored names are spelled anew after the config has changed.
const PASSES: usize = 3;

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
    pub fn of(expected: &Expected, stored: &Evidence) -> Self {
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
    /// Puts what a vote says into another config; a list it is an element of comes along whole.
    pub fn put(&self, config: &mut Value, vote: &Vote) {
        let ends = vote.pointer.match_indices('/').map(|(at, _)| at).skip(1);
        let outer = ends.filter_map(|end| vote.pointer.get(..end));
        match outer.filter_map(|p| Some((p, self.resolved.pointer(p)?))).find(|(_, value)| value.is_array()) {
            Some((pointer, list)) => put(config, pointer, list.clone()),
            None => put(config, &vote.pointer, vote.voted_value.clone()),
        }
    }

    /// The votes that contradict the config.
    pub fn outvoted(&self) -> impl Iterator<Item = &Vote> {
        self.votes.iter().filter(|vote| vote.outvotes())
    }
}

/// Puts a value into a config, with the objects around it where there are none.
pub fn put(config: &mut Value, pointer: &str, value: Value) {
    space::put(config, &Value::Null, pointer, value);
}

/// The `model_type` of every config inside a config.
#[must_use]
pub fn model_types(config: &Value) -> Vec<(String, Value)> {
    let inner = |pointer: &String| pointer.ends_with("/model_type") && pointer != "/model_type";
    let pointers = leaves(config).into_iter().filter(inner);
    pointers.filter_map(|p| Some((p.clone(), config.pointer(&p)?.clone()))).collect()
}

/// Lets the stored tensors vote on the values of `config` for a class; `None` when the class cannot be built from it
/// at all.
#[must_use]
pub fn vote(architecture: Architecture<'_>, config: &Value, stored: &Stored) -> Option<Votes> {
    run(architecture, config, stored, false)
}

/// As [`vote`]; with `changed`, values are only counted if one had to change.
fn run(architecture: Architecture<'_>, config: &Value, stored: &Stored, changed: bool) -> Option<Votes> {
    let mut space = Space::new(architecture, stored);
    let mut state = State::new(&mut space, config.clone())?;
    let (said, before) = (state.built.config.clone(), Fit::of(&state.built, &space.stored));
    space.learn(&said);
    for _ in 0..PASSES {
        let distance = state.distance;
        state = solve::solve(&space, state);
        // What the loader renames depends on what the class has: more layers, more names that it knows.
        let found = state.distance < distance && space.rename(&state.built);
        if !found {
            break;
        }
        state.distance = space.distance(&state.built);
    }
    let (votes, undecided) = if changed && state.changed.is_empty() {
        (Vec::new(), Vec::new())
    } else {
        tally::votes(&space, &state, config, &said)
    };
    let after = Fit::of(&state.built, &space.stored);
    let resolved = state.built.config;
    Some(Votes { votes, undecided, config: state.config, resolved, before, after, exhausted: space.exhausted() })
}
