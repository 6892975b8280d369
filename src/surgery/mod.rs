//! Findings or a recipe become a plan; only this module writes checkpoints.

pub mod merge {
    pub mod record;
}
pub mod plan;
pub mod transform;
