//! Findings or a recipe become a plan; only this module writes checkpoints.

pub mod apply;
pub mod donor;
mod error;
pub mod journal;
mod lock;
pub mod merge;
pub mod plan;
pub mod repair;
mod staging;
mod system;
mod target;
pub mod transform;
pub mod verify;
