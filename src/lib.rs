//! Validates, repairs and merges model checkpoint directories from their files alone.
//!
//! [`Checker`] checks a checkpoint directory, without Python, and predicts what transformers reports when it loads the
//! checkpoint. [`Merge`] builds one checkpoint from several. [`Shard::read_header`] reads the header of one safetensors
//! file.
//!
//! ```
//! use ckpt_doctor::{Checker, LoadVerdict, Severity};
//!
//! # fn main() -> Result<(), ckpt_doctor::Error> {
//! let report = Checker::new().loader("4.50")?.check("fixtures/donors/llava3d-tiny")?;
//! for finding in &report.findings {
//!     println!("{} {}: {}", finding.code, finding.name, finding.message);
//! }
//! assert!(report.findings.iter().all(|finding| finding.severity < Severity::Error));
//! assert!(report.loads.iter().all(|load| load.verdict == LoadVerdict::Loads));
//! # Ok(())
//! # }
//! ```
//!
//! # Features
//!
//! - `cli` (default): the `ckpt-doctor` program and its output formats. A crate that only uses the library turns it off
//!   with `default-features = false`.
//! - `internals`: makes all modules public for the tests of this crate. It is not covered by semantic versioning.

// Each module is one stage, and data moves from the first to the last: `checkpoint` reads files, `knowledge` parses rules
// and architectures, `check` compares the two, `surgery` plans and writes changes, `report` renders, `merge` runs all of
// these to build one checkpoint from several. `api` and `cli` run them for a user. No module imports from a later one.

#![cfg_attr(
    not(all(feature = "cli", unix)),
    allow(dead_code, unused_imports, reason = "only the program fixes, undoes, inspects and reads settings files")
)]

#[cfg(feature = "internals")]
pub mod check;
#[cfg(feature = "internals")]
pub mod checkpoint;
#[cfg(feature = "internals")]
pub mod knowledge;
#[cfg(feature = "internals")]
pub mod merge;
#[cfg(feature = "internals")]
pub mod report;
#[cfg(feature = "internals")]
pub mod surgery;

#[cfg(not(feature = "internals"))]
mod check;
#[cfg(not(feature = "internals"))]
mod checkpoint;
#[cfg(not(feature = "internals"))]
mod knowledge;
#[cfg(not(feature = "internals"))]
mod merge;
#[cfg(not(feature = "internals"))]
mod report;
#[cfg(not(feature = "internals"))]
mod surgery;

mod api;
#[cfg(feature = "cli")]
mod cli;

#[cfg(test)]
mod schemas;

pub use api::{Checker, Error, Merge};
pub use check::finding::{Accepted, Suppressed};
pub use check::load::{LoadReport, Mismatch, Silent, SilentReason};
pub use check::verdict::{LoadVerdict, ObjectVerdict, PredictedLoad};
pub use check::{Edit, Finding, FixHint, Location, Safety, Severity};
pub use checkpoint::{
    Dtype, Fault, FaultKind, HashAlgorithm, Place, Progress, Shard, ShardFormat, Tensor, TensorContents, TensorStats,
};
pub use report::model::{
    ChangedTensor, CheckpointReport, Counts, Dropped, Fixed, MergeReport, MergeStage, MergedFile, Report, Role, Seam,
    ShapedName, StageOutcome, Summary, ToolInfo, UncheckedPath, Verdict, Withdrawn,
};
pub use surgery::expr::TensorTransform;

/// Runs the program; for `src/main.rs`.
#[cfg(feature = "cli")]
#[doc(hidden)]
pub use cli::main;
