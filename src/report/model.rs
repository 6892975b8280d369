//! The report: the JSON contract, and what every other renderer starts from.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use crate::check::finding::LoadReport;
use crate::check::{Finding, Severity};

/// Everything one run has to say. Serialised as is, it is the JSON contract (`schema` 1).
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// Version of this contract.
    pub schema: u32,
    /// Which program wrote it.
    pub tool: Tool,
    /// One entry for each checkpoint, in the order given.
    pub checkpoints: Vec<CheckpointReport>,
    /// What a merge did; absent for `check`.
    pub merge: Option<MergeReport>,
    /// Totals.
    pub summary: Summary,
}

/// Name and version of the program.
#[derive(Debug, Clone, Serialize)]
pub struct Tool {
    /// Always `ckpt-doctor`.
    pub name: &'static str,
    /// Its version.
    pub version: &'static str,
}

/// The verdict over one checkpoint.
#[derive(Debug, Clone, Serialize)]
pub struct CheckpointReport {
    /// As the user named it.
    pub path: String,
    /// What it is in this run, for a merge: `donor vision`, `planned`, `written`; absent for `check`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub role: Option<String>,
    /// Architecture the load report was predicted with.
    pub architecture: Option<String>,
    /// `clean`, or the worst severity.
    pub verdict: String,
    /// Findings by severity.
    pub counts: Counts,
    /// Findings sorted by file, place and code.
    pub findings: Vec<Finding>,
    /// Predicted load report; absent when the architecture is unknown or there are no tensors.
    pub load: Option<LoadReport>,
    /// Text of the documents findings point into, by file name; for renderers that show source.
    #[serde(skip)]
    pub sources: BTreeMap<String, Arc<str>>,
    /// Tensors seen, and their bytes.
    #[serde(skip)]
    pub tensors: (usize, u64),
}

/// How many findings there are of each severity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Errors.
    pub error: usize,
    /// Warnings.
    pub warning: usize,
    /// Notes.
    pub info: usize,
}

impl Counts {
    /// Counts findings.
    #[must_use]
    pub fn of(findings: &[Finding]) -> Self {
        let n = |s| findings.iter().filter(|f| f.severity == s).count();
        Self { error: n(Severity::Error), warning: n(Severity::Warning), info: n(Severity::Info) }
    }

    /// The worst severity present.
    #[must_use]
    pub const fn worst(self) -> Option<Severity> {
        if self.error > 0 {
            Some(Severity::Error)
        } else if self.warning > 0 {
            Some(Severity::Warning)
        } else if self.info > 0 {
            Some(Severity::Info)
        } else {
            None
        }
    }
}

/// Totals over all checkpoints.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Checkpoints looked at.
    pub checkpoints: usize,
    /// `clean`, or the worst severity.
    pub verdict: String,
    /// Findings by severity.
    pub counts: Counts,
}

/// What a merge planned and did.
#[derive(Debug, Clone, Serialize)]
pub struct MergeReport {
    /// Recipe name.
    pub recipe: String,
    /// How far it came: `seam`, `donors`, `planned`, `dry-run`, `written`.
    pub stage: String,
    /// Where the result is or would be.
    pub out: String,
    /// Donor role to path.
    pub donors: BTreeMap<String, String>,
    /// Options in force, defaults included.
    pub options: BTreeMap<String, String>,
    /// Stages in the order they ran, with one line each.
    pub stages: Vec<Stage>,
    /// Seams that do not fit; non-empty means nothing was written.
    pub seams: Vec<Seam>,
    /// How many tensors came how: `copy`, `pad`, `grow-rows`, `reinit`.
    pub transforms: BTreeMap<String, usize>,
    /// The tensors that are not plain copies.
    pub changed: Vec<ChangedTensor>,
    /// Donor tensors that were left behind, by donor role and pattern.
    pub dropped: Vec<Dropped>,
    /// Repairs made on the way, one sentence each.
    pub repairs: Vec<String>,
    /// Files of the result and where each came from.
    pub files: Vec<MergedFile>,
    /// Tensors in the result.
    pub tensors: usize,
    /// Bytes of tensor data in the result.
    pub bytes: u64,
}

/// One stage of the pipeline.
#[derive(Debug, Clone, Serialize)]
pub struct Stage {
    /// Its name.
    pub name: String,
    /// What came of it.
    pub outcome: String,
}

/// A seam that does not fit: two parts that must agree, and do not.
#[derive(Debug, Clone, Serialize)]
pub struct Seam {
    /// What has to agree, in one sentence.
    pub message: String,
    /// The part that does not fit: name and shape as stored.
    pub tensor: Option<ShapedName>,
    /// The part it has to meet: name and shape.
    pub meets: Option<ShapedName>,
    /// Shape the result needs for `tensor`.
    pub needed: Option<Vec<u64>>,
    /// Options that would solve it, as typed on the command line: `--set projector=pad`.
    pub options: Vec<String>,
}

/// A name with a shape.
#[derive(Debug, Clone, Serialize)]
pub struct ShapedName {
    /// Donor role it comes from.
    pub donor: String,
    /// Tensor name in that donor.
    pub name: String,
    /// Its shape there.
    pub shape: Vec<u64>,
}

/// A tensor of the result that is not a byte copy.
#[derive(Debug, Clone, Serialize)]
pub struct ChangedTensor {
    /// Name in the result.
    pub name: String,
    /// How it was made.
    pub transform: String,
    /// Shape in the donor; absent when nothing was taken.
    pub from: Option<Vec<u64>>,
    /// Shape in the result.
    pub to: Vec<u64>,
}

/// Donor tensors that were left behind.
#[derive(Debug, Clone, Serialize)]
pub struct Dropped {
    /// Donor role.
    pub donor: String,
    /// Pattern of the recipe.
    pub pattern: String,
    /// How many tensors it matched.
    pub count: usize,
    /// Why the recipe drops them.
    pub why: String,
}

/// A file of the result.
#[derive(Debug, Clone, Serialize)]
pub struct MergedFile {
    /// File name.
    pub name: String,
    /// Where it came from.
    pub origin: String,
}
