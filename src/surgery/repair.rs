//! Fixes become one repair: planned on the checkpoint in memory, judged by the same rules, written once.
//!
//! Fixes are made in rounds, as in ruff: those that do not touch one another together, then the rules are asked again,
//! until nothing is left to do. A fix that does not help, or that brings about an error of another kind, is withdrawn.

mod draft;
mod planner;

use std::sync::Arc;

use serde::Serialize;

use super::plan::PlannedShard;
use crate::check::{Outcome, Safety};
use crate::checkpoint::Checkpoint;

pub use planner::plan;

/// A finding whose fix was applied.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Fixed {
    /// Code of the rule.
    pub code: String,
    /// Its name.
    pub name: String,
    /// File of the finding.
    pub file: Option<String>,
    /// Message of the finding.
    pub message: String,
    /// How safe the fix is.
    pub safety: Safety,
    /// What the fix did.
    pub title: String,
}

/// A fix that was tried and rolled back.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Withdrawn {
    /// Code of the rule.
    pub code: String,
    /// What the fix would do.
    pub title: String,
    /// Why it was rolled back.
    pub reason: String,
}

/// A file that the repair changes.
#[derive(Debug, Clone)]
pub struct Change {
    /// Its name.
    pub name: String,
    /// What it will hold.
    pub new: Content,
}

/// What a changed file will hold.
#[derive(Debug, Clone)]
pub enum Content {
    /// Text.
    Text(Arc<str>),
    /// Tensors of the original under another header.
    Shard(PlannedShard),
}

impl Content {
    /// Bytes it takes.
    #[must_use]
    pub fn len(&self) -> u64 {
        match self {
            Self::Text(text) => text.len() as u64,
            Self::Shard(shard) => shard.file_len(),
        }
    }

    /// Whether it holds nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// What a repair would do, and what comes of it.
#[derive(Debug, Clone)]
pub struct Repair {
    /// The checkpoint as it is.
    pub original: Arc<Checkpoint>,
    /// As it will be.
    pub planned: Arc<Checkpoint>,
    /// What the rules say of it as it will be.
    pub outcome: Outcome,
    /// The findings whose fixes are made.
    pub fixed: Vec<Fixed>,
    /// Fixes that were tried and not kept.
    pub withdrawn: Vec<Withdrawn>,
    /// The files that change, by name.
    pub changes: Vec<Change>,
}

impl Repair {
    /// Bytes of each file that is to be written.
    pub(super) fn sizes(&self) -> Vec<u64> {
        self.changes.iter().map(|change| change.new.len()).collect()
    }
}
