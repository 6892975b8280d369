//! What should be: rules, architectures and recipes read from `rules/`, and their expressions.

pub mod architecture;
pub mod evidence;
pub mod expression;
pub mod library;
pub mod loader;
mod ordered;
pub mod processor;
pub mod quantization;
pub mod recipe;
pub mod resemblance;
pub mod rule;
#[cfg(test)]
mod schemas;
pub mod selection;
pub mod settings;
pub mod source;

pub use architecture::{Architecture, Conversion, Doubt, Expected, ExpectedTensor, Refusal, UnknownPart};
pub use evidence::Evidence;
pub use expression::{EvalError, Expression, Scope, Template};
pub use library::Library;
pub use loader::Loader;
