//! Compares a checkpoint with the knowledge about its class; pure functions from a checkpoint to findings.

pub mod adapter;
mod bounded;
pub mod engine;
mod exceptions;
pub mod finding;
pub mod fix;
pub mod index;
pub mod inspect;
pub mod judge;
pub mod layers;
pub mod load;
mod model_type;
pub mod modules;
mod outcome;
mod policy;
pub mod quantization;
mod refusals;
pub mod size;
mod suppressions;
pub mod tokens;
pub mod variables;
pub mod verdict;
pub mod votes;

pub use crate::knowledge::rule::Safety;
pub use engine::{check, check_for};
pub use finding::{Finding, Location, Severity};
pub use fix::{Edit, FixHint, clamped, renamed};
pub use outcome::Outcome;
pub use suppressions::unused_suppressions;
