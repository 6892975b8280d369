//! Findings or a recipe become a plan; only this module writes checkpoints.

pub mod apply;
pub mod merge;
pub mod plan;
mod staging;
pub mod transform;
pub mod verify;
