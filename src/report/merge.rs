//! The record of a merge: what it planned and what it wrote, as data for every renderer.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Serialize, Serializer};

use crate::surgery::plan::TensorTransform;

/// The record of a merge.
#[derive(Debug, Clone, Default, Serialize)]
pub struct MergeReport {
    /// Recipe name.
    pub recipe: String,
    /// The stage it ended with; none while it runs, as in the report that is written into the result.
    pub stage: Option<MergeStage>,
    /// Where the result is or would be.
    pub out: String,
    /// Donor role to path.
    pub donors: BTreeMap<String, String>,
    /// Options in force, defaults included.
    pub options: BTreeMap<String, String>,
    /// Stages in the order they ran, with one line each.
    pub stages: Vec<StageOutcome>,
    /// Seams that do not fit; non-empty means nothing was written.
    pub seams: Vec<Seam>,
    /// Number of tensors by how their bytes are made.
    pub transforms: BTreeMap<TensorTransform, usize>,
    /// The tensors that are not plain copies.
    pub changed: Vec<ChangedTensor>,
    /// Donor tensors that were left behind, by donor role and pattern.
    pub dropped: Vec<Dropped>,
    /// Repairs made on the way, one sentence each.
    pub repairs: Vec<String>,
    /// What a person should know of the result, one sentence each.
    pub notes: Vec<String>,
    /// Files of the result and where each came from.
    pub files: Vec<MergedFile>,
    /// Tensors in the result.
    pub tensors: usize,
    /// Bytes of tensor data in the result.
    pub bytes: u64,
}

/// The stage that a merge ended with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum MergeStage {
    /// A donor has errors that the recipe does not tolerate; nothing was written.
    Donors,
    /// Seams do not fit; nothing was written.
    Seam,
    /// The planned checkpoint has errors; nothing was written.
    Planned,
    /// The plan is sound, and `--dry-run` asked for no more.
    DryRun,
    /// The result was written.
    Written,
}

/// What a checkpoint is in a merge. Reports spell it `donor vision`, `planned`, `written`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Role {
    /// A donor, by its role in the recipe.
    Donor(String),
    /// The checkpoint that the plan describes.
    Planned,
    /// The result, read again from disk.
    Written,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Donor(role) => write!(f, "donor {role}"),
            Self::Planned => f.write_str("planned"),
            Self::Written => f.write_str("written"),
        }
    }
}

impl Serialize for Role {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// One line about one stage of the pipeline.
#[derive(Debug, Clone, Serialize)]
pub struct StageOutcome {
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
    /// How its bytes are made.
    pub transform: TensorTransform,
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
