//! Compares a checkpoint with the knowledge about its class; pure functions from a checkpoint to findings.

pub mod adapter;
mod bounded;
mod built_tokenizer;
mod card;
mod class_names;
#[cfg(feature = "cli")]
pub mod compare;
mod config_pattern;
mod directory;
pub mod engine;
mod evaluate;
mod exceptions;
pub mod finding;
mod finite;
pub mod fix;
#[cfg(feature = "cli")]
pub mod foreseen;
mod generation;
pub mod index;
pub mod inspect;
pub mod judge;
mod judged;
pub mod layers;
pub mod load;
mod model_type;
mod module_imports;
pub mod modules;
pub mod observe;
pub mod options;
mod outcome;
mod pickles;
mod policy;
mod preprocessor;
mod processor;
mod programs;
pub mod quantization;
mod refusals;
mod robots;
mod ropes;
pub mod size;
mod statistics;
mod sub_configs;
mod suppressions;
mod templates;
mod tokenizer_config;
mod tokenizer_json;
pub mod tokens;
pub mod variables;
pub mod verdict;
mod view;
pub mod votes;

pub use crate::knowledge::rule::Safety;
pub(crate) use built_tokenizer::building_class;
pub use engine::{check, check_for};
pub use finding::{Finding, Location, Severity};
pub use fix::{Edit, FixHint, clamped, renamed};
pub use outcome::Outcome;
pub use suppressions::{SuppressionUse, suppression_uses, unused_suppressions};
pub(crate) use templates::default_template;
#[cfg(feature = "internals")]
pub use templates::rendered_in_process;
pub use templates::{RenderJob, Rendering, render_elsewhere};
