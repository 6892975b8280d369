//! Compares a checkpoint with the knowledge about its class; pure functions from a checkpoint to findings.

pub mod adapter;
pub mod engine;
pub mod finding;
pub mod fix;
pub mod index;
pub mod inspect;
pub mod judge;
pub mod layers;
pub mod load;
pub mod modules;
mod outcome;
mod policy;
pub mod quantization;
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
