//! Combines fixes into one repair: planned on the checkpoint in memory, checked by the same rules, written once.
//!
//! Fixes are applied in rounds, as in ruff: fixes that do not overlap are applied together, then the rules run again,
//! until no fix is left. A fix is withdrawn when its finding remains, or when any loader would do worse after it.

mod draft;
mod objection;
mod planner;
mod unused;

use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::error::RepairError;
use super::plan::PlannedShard;
use crate::check::{Edit, Outcome, Safety};
use crate::checkpoint::{Checkpoint, untold};

pub use planner::{plan, tried};

/// A finding whose fix was applied.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct Fixed {
    /// Code of the rule.
    pub code: String,
    /// Its name.
    pub name: String,
    /// The first file that the fix edited.
    pub file: Option<String>,
    /// Message of the finding.
    pub message: String,
    /// Safety of the fix.
    pub safety: Safety,
    /// What the fix did.
    pub title: String,
}

/// A fix that was tried and rolled back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct Withdrawn {
    /// Code of the rule.
    pub code: String,
    /// What the fix would do.
    pub title: String,
    /// Why it was rolled back.
    pub reason: String,
    /// Its edits.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub edits: Vec<Edit>,
}

/// A file that the repair changes.
#[derive(Debug, Clone)]
pub struct Change {
    /// File name.
    pub name: String,
    /// New content.
    pub new: Content,
}

/// New content of a changed file.
#[derive(Debug, Clone)]
pub enum Content {
    /// Text.
    Text(Arc<str>),
    /// Tensors of the original under a new header.
    Shard(PlannedShard),
}

impl Content {
    /// Number of bytes.
    #[must_use]
    pub(crate) fn len(&self) -> u64 {
        match self {
            Self::Text(text) => text.len() as u64,
            Self::Shard(shard) => shard.file_len(),
        }
    }
}

/// A planned repair and its result.
#[derive(Debug, Clone)]
pub struct Repair {
    /// The checkpoint before the repair.
    pub original: Arc<Checkpoint>,
    /// Result of checking the repaired checkpoint.
    #[cfg_attr(not(feature = "internals"), allow(dead_code, reason = "the tests compare it"))]
    pub outcome: Outcome,
    /// Findings with applied fixes.
    pub fixed: Vec<Fixed>,
    /// Fixes that were tried and rolled back.
    pub withdrawn: Vec<Withdrawn>,
    /// The files that change, by name.
    pub changes: Vec<Change>,
}

impl Repair {
    /// The directory that the writers change or link.
    ///
    /// # Errors
    /// [`RepairError::InMemory`].
    pub(super) fn directory(&self) -> Result<&Path, RepairError> {
        let source = &self.original.source;
        source.directory().ok_or_else(|| RepairError::InMemory { path: source.path().to_owned() })
    }
}
