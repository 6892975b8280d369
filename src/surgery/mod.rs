//! Findings or a recipe become a plan; only this module writes checkpoints.
