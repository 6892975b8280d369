//! Expressions of the data files: the Common Expression Language, wrapped so that no other stage sees the crate.
//!
//! Every evaluation terminates. Overflow, division by zero and missing keys are errors with a message, for any values
//! in a checkpoint's documents.

mod compiled;
mod functions;
mod limits;
mod parsed;
mod program;
mod references;
mod scope;
mod steps;
mod template;

pub use compiled::{EvalError, Expression};
pub(crate) use compiled::{compile_eagerly, compile_lazily};
pub(crate) use functions::{glob, is_function};
pub use references::{FunctionCall, References};
pub use scope::Scope;
pub(crate) use steps::within;
pub use template::Template;

#[cfg(test)]
mod tests;
