//! The record of a merge: what it planned and what it wrote, as data for every renderer.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use serde::{Serialize, Serializer};

use crate::surgery::convert::CastLosses;
use crate::surgery::expr::TensorTransform;

/// The record of a merge.
#[derive(Debug, Clone, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct MergeReport {
    /// Recipe name.
    pub recipe: String,
    /// The stage it ended with; null while it runs, as in the report that is written into the result.
    pub stage: Option<MergeStage>,
    /// The output directory.
    pub out: String,
    /// Directories of the donors, by role; empty in the report that is written into the result.
    pub donors: BTreeMap<String, String>,
    /// Options in effect, defaults included.
    pub options: BTreeMap<String, String>,
    /// The stages that ran, in order.
    pub stages: Vec<StageOutcome>,
    /// Seams that do not fit; if there are any, nothing was written.
    pub seams: Vec<Seam>,
    /// Number of tensors by transform.
    pub transforms: BTreeMap<TensorTransform, usize>,
    /// Tensors that are not byte copies.
    pub changed: Vec<ChangedTensor>,
    /// Tensors to train, and to freeze meanwhile; null before the tensors are planned.
    pub training: Option<Training>,
    /// Python code that loads the result, one statement each; empty when nothing is known about its class.
    pub usage: Vec<String>,
    /// Python code that asks the result about a picture, one statement each; empty where no processor takes one.
    pub prompt: Vec<String>,
    /// The tokens that prompts and training code name, by their ids.
    pub tokens_used: Vec<TokenIds>,
    /// What a dry run says in addition; missing for other runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dry_run: Option<DryRun>,
    /// Donor tensors that the result does not contain, by role and pattern.
    pub dropped: Vec<Dropped>,
    /// Repairs of donor documents, one sentence each.
    pub repairs: Vec<String>,
    /// Notes about the result for its user, one sentence each.
    pub notes: Vec<String>,
    /// Files of the result and their origin.
    pub files: Vec<MergedFile>,
    /// Tensors in the result.
    pub tensors: usize,
    /// Bytes of tensor data in the result.
    pub bytes: u64,
}

/// The stage that a merge ended with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum MergeStage {
    /// A donor has errors that the recipe does not tolerate; nothing was written.
    Donors,
    /// Seams do not fit; nothing was written.
    Seam,
    /// The planned checkpoint has errors; nothing was written.
    Planned,
    /// The plan has no errors, and `--dry-run` ended the merge.
    DryRun,
    /// The result was written.
    Written,
}

/// What a checkpoint is in a merge. Reports spell it `donor vision`, `planned`, `written`.
#[derive(Debug, Clone, PartialEq, Eq)]
#[cfg_attr(test, derive(schemars::JsonSchema), schemars(with = "String"))]
#[non_exhaustive]
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
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct StageOutcome {
    /// Its name.
    pub name: String,
    /// Its outcome.
    pub outcome: String,
}

/// A seam that does not fit: two parts that must agree and do not.
#[derive(Debug, Clone, Serialize, Default)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Seam {
    /// The mismatch, in one sentence.
    pub message: String,
    /// The stored tensor that does not fit.
    pub tensor: Option<ShapedName>,
    /// The tensor that it must match.
    pub meets: Option<ShapedName>,
    /// The shape that the result needs for `tensor`.
    pub needed: Option<Vec<u64>>,
    /// Options that resolve the mismatch: `--set projector=pad`.
    pub options: Vec<String>,
}

/// A name with a shape.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ShapedName {
    /// Role of the donor.
    pub donor: String,
    /// Name in the donor.
    pub name: String,
    /// Shape in the donor.
    pub shape: Vec<u64>,
}

/// A tensor of the result that is not a byte copy.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ChangedTensor {
    /// Name in the result.
    pub name: String,
    /// The transform of its bytes.
    pub transform: TensorTransform,
    /// Shape in the donor; null if nothing was taken from it.
    pub from: Option<Vec<u64>>,
    /// Shape in the result.
    pub to: Vec<u64>,
    /// Factor on all values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// The values that it starts again with: `normal 0.020`, `zeros`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub values: Option<String>,
    /// The cast of its values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cast: Option<Cast>,
    /// Values that scaling or casting could not keep; null before the tensor is written.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub losses: Option<CastLosses>,
}

impl ChangedTensor {
    /// Whether its values were only cast, and all of them were kept.
    #[must_use]
    pub(crate) fn is_plain_cast(&self) -> bool {
        let lost = self.losses.is_some_and(|losses| losses != CastLosses::default());
        self.transform == TensorTransform::Convert && self.scale.is_none() && !lost
    }

    /// How its bytes were made, in words: `pad, scale 8, cast`.
    #[must_use]
    pub(crate) fn how(&self) -> String {
        let fit = (self.transform != TensorTransform::Convert).then(|| self.transform.name().to_owned());
        let scale = self.scale.map(|scale| format!("scale {scale}"));
        let cast = self.cast.as_ref().map(|_| "cast".to_owned());
        fit.into_iter().chain(self.values.clone()).chain(scale).chain(cast).collect::<Vec<_>>().join(", ")
    }
}

impl MergeReport {
    /// One sentence for each pair of types of which values were cast: the number of tensors, and the lost values.
    #[must_use]
    pub(crate) fn casts(&self) -> Vec<String> {
        let mut casts: BTreeMap<(&str, &str), (usize, Option<CastLosses>)> = BTreeMap::new();
        for changed in &self.changed {
            let Some(cast) = &changed.cast else { continue };
            let (tensors, losses) = casts.entry((cast.from, cast.to)).or_default();
            *tensors = tensors.saturating_add(1);
            if let Some(more) = changed.losses {
                losses.get_or_insert_default().add(more);
            }
        }
        let sentence = |((from, to), (tensors, losses)): ((&str, &str), (usize, Option<CastLosses>))| {
            let lost = losses.map(|lost| {
                let CastLosses { overflow, underflow, nan } = lost;
                format!("; {overflow} values overflowed to infinity, {underflow} underflowed to zero, {nan} are NaN")
            });
            let noun = if tensors == 1 { "tensor" } else { "tensors" };
            format!("{tensors} {noun} cast from {from} to {to}{}", lost.unwrap_or_default())
        };
        casts.into_iter().map(sentence).collect()
    }
}

/// Element types before and after a cast, as safetensors spells them.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Cast {
    /// Type in the donor.
    pub from: &'static str,
    /// Type in the result.
    pub to: &'static str,
}

/// The tensors of a result by what a training has to do with them. Names are those in the files of the result.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Training {
    /// An anchored regular expression that matches the names in `train`, what the models of `versions` call them, and no other
    /// name of the result; null without any.
    pub pattern: Option<String>,
    /// Versions of transformers whose names of the parameters are known.
    pub versions: Vec<String>,
    /// Tensors with new values, and those that meet tensors of another donor.
    pub train: Vec<String>,
    /// All others.
    pub freeze: Vec<String>,
    /// How large the tensors in `train` are, in the same order.
    pub sizes: Vec<TrainedTensor>,
}

impl Training {
    /// Number of values in the tensors of `train`.
    #[must_use]
    pub fn values(&self) -> u64 {
        self.sizes.iter().fold(0, |sum, tensor| sum.saturating_add(tensor.values))
    }

    /// Number of values in new rows.
    #[must_use]
    pub fn new_values(&self) -> u64 {
        self.with_new_rows().fold(0, |sum, (_, rows)| sum.saturating_add(rows.values))
    }

    /// The tensors that got rows.
    pub fn with_new_rows(&self) -> impl Iterator<Item = (&str, &NewRows)> {
        self.sizes.iter().filter_map(|tensor| Some((tensor.name.as_str(), tensor.new_rows.as_ref()?)))
    }
}

/// A tensor to train.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TrainedTensor {
    /// Its name.
    pub name: String,
    /// Number of its values.
    pub values: u64,
    /// The rows that were appended to a donor's; null where there are none.
    pub new_rows: Option<NewRows>,
}

/// Rows that no donor has: those of the tokens that were added.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct NewRows {
    /// The first one, from 0: the id of its token.
    pub first: u64,
    /// The last one.
    pub last: u64,
    /// Number of values in them.
    pub values: u64,
    /// What the models of [`Training::versions`] call the tensor, where it is not the name in the files.
    pub in_models: Vec<String>,
}

/// A token of the result that a training or a prompt names, or a run of numbered ones.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TokenIds {
    /// Text of the token, or of the first one of a run; null where no file of the result has its id.
    pub text: Option<String>,
    /// Its id.
    pub first: u64,
    /// The id of the last one of a run, else the same.
    pub last: u64,
    /// What it is: the keys of documents that have its id, such as `image_token_index`, or the name that the processor gives it.
    pub used_as: Vec<String>,
}

/// The facts of a dry run.
#[derive(Debug, Clone, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct DryRun {
    /// Bytes of the files to write, without the report, the manifest and the model card.
    pub needed: u64,
    /// Bytes free on the file system of the target; null when it does not report them.
    pub free: Option<u64>,
    /// The shards in order.
    pub shards: Vec<PlannedShardSize>,
    /// The change of config.json; for renderers that show text.
    #[serde(skip)]
    pub config: Option<ConfigChange>,
}

/// A shard to be written.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct PlannedShardSize {
    /// File name.
    pub name: String,
    /// Number of tensors.
    pub tensors: usize,
    /// Bytes of the file.
    pub bytes: u64,
}

/// config.json of a result, and of the donor that it starts from.
#[derive(Debug, Clone)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct ConfigChange {
    /// Role of the donor.
    pub donor: String,
    /// Text in the donor.
    pub old: Arc<str>,
    /// Text in the result.
    pub new: Arc<str>,
}

/// Donor tensors that the result does not contain.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Dropped {
    /// Donor role.
    pub donor: String,
    /// Pattern of the recipe.
    pub pattern: String,
    /// Number of tensors that it matches.
    pub count: usize,
    /// Why the recipe drops them.
    pub why: String,
}

/// A file of the result.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct MergedFile {
    /// File name.
    pub name: String,
    /// Its origin.
    pub origin: String,
}
