//! Compares what is there with what should be; pure functions from a checkpoint to findings.

pub mod finding;
pub mod load;

pub use finding::{Finding, FixHint, Location, Severity};
