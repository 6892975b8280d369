//! Infers config values from tensors: each stored tensor votes for the values that explain its name and shape.
//!
//! The class is a black box. One value of the config is changed at a time. The tensors that the class then builds show
//! which names and dimensions follow that value, and the stored ones imply what it should be. A value is accepted when the
//! class that it builds is closer to the stored tensors.

mod explain;
mod probe;
mod run;
mod solve;
mod space;
mod tally;
#[cfg(test)]
mod tests;
mod vote;

use serde_json::Value;

pub use self::explain::{Explanation, explain, fault};
pub use self::run::vote;
pub(super) use self::space::{leaves, with};
pub use self::vote::{Fit, Vote, Votes};

/// The `model_type` of every config inside a config.
#[must_use]
pub fn model_types(config: &Value) -> Vec<(String, Value)> {
    let inner = |pointer: &String| pointer.ends_with("/model_type") && pointer != "/model_type";
    let pointers = leaves(config).into_iter().filter(inner);
    pointers.filter_map(|p| Some((p.clone(), config.pointer(&p)?.clone()))).collect()
}
