//! What should be: rules, architectures and recipes read from `rules/`, and their expressions.

pub mod expression;
pub mod processor;
pub mod recipe;
pub mod source;

pub use expression::{EvalError, Expression, Scope, Template};
