//! Expressions of the data files: the Common Expression Language, wrapped so that no other stage sees the crate.
//!
//! Every evaluation is total. Overflow, division by zero and missing keys are errors with a message,
//! whatever values a checkpoint's documents hold.

mod compiled;
mod functions;
mod program;
mod scope;
mod steps;
mod template;

pub use compiled::{EvalError, Expression, ParseError};
pub(crate) use compiled::{compiled_at_once, compiled_when_needed};
pub(crate) use functions::glob;
pub use scope::Scope;
pub(crate) use steps::within;
pub use template::Template;

#[cfg(test)]
mod tests;
