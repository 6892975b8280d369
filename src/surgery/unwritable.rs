//! In place of `writers.rs` where there is no Unix: every function fails with [`ApplyError::NeedsUnix`].
//!
//! A Unix has the locks, the links and the renames of whole directories that let the next run finish a killed one.

use std::path::Path;

use super::donor::DonorSnapshot;
use super::error::{ApplyError, RepairError};
use super::leftover::Leftover;
use super::outcome::{RepairedCopy, Target};
use super::plan::{Plan, PlannedFile};
use super::repair::Repair;
use super::written::{Writing, WrittenShard};

/// Whether this system can write checkpoints. The command line refuses commands that write them where it cannot.
pub const CAN_WRITE: bool = false;

/// # Errors
/// Always.
pub fn apply(
    _: &Plan,
    _: &[DonorSnapshot],
    _: &Path,
    _: &[u64],
    _: &mut dyn FnMut(&[WrittenShard]) -> Vec<PlannedFile>,
    _: Writing,
    _: &(dyn Fn(u64) + Sync),
) -> Result<Option<Leftover>, ApplyError> {
    Err(ApplyError::NeedsUnix)
}

/// # Errors
/// Always.
pub fn check_target(_: &Path, _: &[&Path]) -> Result<Target, ApplyError> {
    Err(ApplyError::NeedsUnix)
}

/// # Errors
/// Always.
pub fn claim_target(_: &Path, _: &[&Path]) -> Result<Target, ApplyError> {
    Err(ApplyError::NeedsUnix)
}

/// # Errors
/// Always.
pub fn free_space(_: &Path) -> Result<Option<u64>, ApplyError> {
    Err(ApplyError::NeedsUnix)
}

/// # Errors
/// Always.
pub fn overlay(_: &Repair, _: &Path, _: &(dyn Fn(u64) + Sync)) -> Result<RepairedCopy, RepairError> {
    Err(ApplyError::NeedsUnix.into())
}

/// Repairs in place.
pub mod journal {
    use std::path::Path;

    use super::{ApplyError, Repair, RepairError};
    use crate::checkpoint::journal::StateFolder;
    use crate::surgery::outcome::{Recovery, RepairWritten, Undone};
    use crate::surgery::trust::Trust;

    /// # Errors
    /// Always.
    pub fn recover(_: &Path, _: &Trust) -> Result<Recovery, RepairError> {
        Err(ApplyError::NeedsUnix.into())
    }

    /// # Errors
    /// Always.
    pub fn undo(_: &Path, _: &Trust) -> Result<Undone, RepairError> {
        Err(ApplyError::NeedsUnix.into())
    }

    /// # Errors
    /// Always.
    pub fn write(_: &Repair, _: &StateFolder, _: &(dyn Fn(u64) + Sync)) -> Result<RepairWritten, RepairError> {
        Err(ApplyError::NeedsUnix.into())
    }
}
