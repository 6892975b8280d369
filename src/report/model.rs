//! The report: the JSON contract, and what every other renderer starts from.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use super::merge::{
    Cast, ChangedTensor, ConfigChange, Dropped, DryRun, MergeReport, MergeStage, MergedFile, NewRows, PlannedShardSize,
    Role, Seam, ShapedName, StageOutcome, TokenIds, TrainedTensor, Training,
};
use crate::check::finding::Suppressed;
use crate::check::inspect::ModuleMap;
use crate::check::verdict::PredictedLoad;
use crate::check::{Finding, Severity};
use crate::checkpoint::{TensorContents, untold};
use crate::knowledge::Knowledge;
#[cfg(feature = "cli")]
use crate::knowledge::rule::Rule;
use crate::knowledge::settings::Policy;
pub use crate::surgery::repair::{Fixed, Withdrawn};

/// The report of one run. Serialised, it is the JSON contract (`schema` 3).
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct Report {
    /// Version of this contract.
    pub schema: u32,
    /// The program that wrote the report.
    pub tool: ToolInfo,
    /// One entry per checkpoint, in the order of the arguments; a merge has its donors, the plan and the result.
    pub checkpoints: Vec<CheckpointReport>,
    /// The merge; null for `check`.
    pub merge: Option<MergeReport>,
    /// Paths that could not be checked.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub unchecked: Vec<UncheckedPath>,
    /// Totals over all checkpoints.
    pub summary: Summary,
    /// Maps for a page; empty unless one was asked for.
    #[serde(skip)]
    pub(crate) maps: Vec<CheckpointMap>,
    /// What the formats for other programs say of the run and its rules.
    #[serde(skip)]
    pub(crate) terms: ReportTerms,
}

/// What a finding means for the run, and what its rule says.
#[derive(Debug, Clone)]
pub(crate) struct ReportTerms {
    /// Lowest severity that fails the run; `None` with `--exit-zero`.
    pub(crate) fail_on: Option<Severity>,
    /// Texts of the rules with findings, by code.
    pub(crate) rules: BTreeMap<String, RuleText>,
}

impl Default for ReportTerms {
    fn default() -> Self {
        Self { fail_on: Some(Severity::Error), rules: BTreeMap::new() }
    }
}

/// What a rule says of itself.
#[derive(Debug, Clone)]
pub(crate) struct RuleText {
    /// What it finds, in one sentence.
    pub(crate) summary: String,
    /// Why it matters.
    pub(crate) why: String,
}

/// The map of a checkpoint of the run.
#[derive(Debug, Clone)]
pub(crate) struct CheckpointMap {
    /// What it shows.
    pub(crate) title: String,
    /// The map.
    pub(crate) map: ModuleMap,
}

impl Report {
    /// Puts a report together: adds up the counts and states the verdict.
    #[must_use]
    pub fn new(checkpoints: Vec<CheckpointReport>, merge: Option<MergeReport>) -> Self {
        let counts = checkpoints.iter().fold(Counts::default(), |sum, c| sum.plus(c.counts));
        let seams = merge.as_ref().is_some_and(|m| !m.seams.is_empty());
        let verdict = if seams { Verdict::Error } else { counts.verdict() };
        let suppressed = checkpoints.iter().map(|c| c.suppressed.len()).sum();
        let summary = Summary { checkpoints: checkpoints.len(), verdict, counts, suppressed, unchecked: 0, hidden: 0 };
        Self {
            schema: 3,
            tool: ToolInfo::this(),
            checkpoints,
            merge,
            unchecked: Vec::new(),
            summary,
            maps: Vec::new(),
            terms: ReportTerms::default(),
        }
        .graded()
    }

    /// Adds the paths that could not be checked; without findings of severity error, they determine the verdict.
    #[doc(hidden)]
    #[must_use]
    pub fn with_unchecked(mut self, unchecked: Vec<UncheckedPath>) -> Self {
        self.summary.unchecked = unchecked.len();
        self.unchecked = unchecked;
        self.graded()
    }

    /// Adds what formats for other programs say of the run: the lowest severity that fails it, `None` for none, and the texts of
    /// its rules. Called by the program before it renders.
    #[cfg(feature = "cli")]
    #[must_use]
    pub(crate) fn with_terms(mut self, knowledge: &Knowledge, fail_on: Option<Severity>) -> Self {
        let findings =
            self.checkpoints.iter().flat_map(|c| c.findings.iter().chain(c.suppressed.iter().map(|s| &s.finding)));
        let codes: BTreeSet<&str> = findings.map(|finding| finding.code.as_str()).collect();
        let known = knowledge.rules.rules.iter().filter(|rule| codes.contains(rule.code.as_str()));
        let text = |rule: &Rule| RuleText { summary: rule.summary.clone(), why: rule.why.clone() };
        let rules = known.map(|rule| (rule.code.clone(), text(rule))).collect();
        self.terms = ReportTerms { fail_on, rules };
        self
    }

    /// Sets the number of findings that `--min-severity` removed from `findings`.
    #[must_use]
    pub(crate) const fn with_hidden(mut self, hidden: usize) -> Self {
        self.summary.hidden = hidden;
        self
    }

    /// Sets the verdict of a check that checked nothing, or not everything: it is never clean.
    fn graded(mut self) -> Self {
        let is_partial = !self.unchecked.is_empty() || (self.checkpoints.is_empty() && self.merge.is_none());
        if is_partial && self.summary.verdict != Verdict::Error {
            self.summary.verdict = Verdict::NotChecked;
        }
        self
    }
}

/// A path that could not be checked.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct UncheckedPath {
    /// The path, as the user wrote it, or a folder below it.
    pub path: String,
    /// Why it could not be checked: it is missing, contains no checkpoint, or cannot be read.
    pub reason: String,
}

/// Name and version of the program.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct ToolInfo {
    /// Always `ckpt-doctor`.
    pub name: &'static str,
    /// Its version.
    pub version: &'static str,
}

impl ToolInfo {
    /// This program.
    #[must_use]
    pub(crate) const fn this() -> Self {
        Self { name: env!("CARGO_PKG_NAME"), version: env!("CARGO_PKG_VERSION") }
    }
}

/// The report of one checkpoint.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct CheckpointReport {
    /// The path, as the user wrote it.
    pub path: String,
    /// Its role in a merge: `donor vision`, `planned`, `written`; missing for `check`.
    #[serde(skip_serializing_if = "Option::is_none", skip_deserializing)]
    pub role: Option<Role>,
    /// The class that config.json names: the first of `architectures`, or `_class_name` of diffusers.
    pub class: Option<String>,
    /// The architecture of the predicted loads; null if it is unknown.
    pub architecture: Option<String>,
    /// Number of tensors in the shards, also of a checkpoint that is too large to be read whole.
    pub tensors: usize,
    /// Elements as stored of the tensors that were read; a quantised tensor may hold several parameters in one.
    pub parameters: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Clean, or the worst severity.
    pub verdict: Verdict,
    /// Findings by severity.
    pub counts: Counts,
    /// The settings file that applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub settings: Option<String>,
    /// What settings and options changed about the rules; missing when nothing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub overrides: Option<Overrides>,
    /// Findings, sorted by severity (errors first), file, place and code.
    pub findings: Vec<Finding>,
    /// Findings that settings or a baseline accept; `counts` does not include them.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub suppressed: Vec<Suppressed>,
    /// Will it load? One entry for each version of transformers of the run, those that the checkpoint must load with first.
    pub loads: Vec<PredictedLoad>,
    /// What each tensor contains, with `--deep`: by file, then in the order of the bytes. Tensors that could not be read are
    /// missing, and so are those that share the bytes of another.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub contents: Vec<TensorContents>,
    /// Findings whose fixes were applied; `findings` has the remaining ones.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub fixed: Vec<Fixed>,
    /// Fixes that were tried and rolled back.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub withdrawn: Vec<Withdrawn>,
    /// The fix options of the run, for renderers that offer fixes.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub fixing: Option<Fixing>,
    /// Text of the documents findings point into, by file name; for renderers that show source.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub sources: BTreeMap<String, Arc<str>>,
}

/// The verdict over one checkpoint, or over all of a run: clean, or the worst severity of its findings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// No findings.
    Clean,
    /// Information at most.
    Info,
    /// Warnings at most.
    Warning,
    /// For a run without errors: a path could not be checked, or no checkpoint was found.
    NotChecked,
    /// Errors.
    Error,
}

impl Verdict {
    /// The word for it in reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Clean => "clean",
            Self::Info => "info",
            Self::Warning => "warning",
            Self::NotChecked => "not checked",
            Self::Error => "error",
        }
    }
}

impl From<Severity> for Verdict {
    fn from(worst: Severity) -> Self {
        match worst {
            Severity::Info => Self::Info,
            Severity::Warning => Self::Warning,
            Severity::Error => Self::Error,
        }
    }
}

/// Changes to the rules by a settings file and by options; a verdict under them differs from the one without.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Overrides {
    /// Rules that did not run.
    pub rules_off: usize,
    /// Rules with another severity.
    pub regraded: usize,
    /// Paths with ignored rules or severities of their own.
    pub paths: usize,
    /// Whether weights may be missing.
    pub metadata_only: bool,
}

impl Overrides {
    /// The changes; `None` when nothing is changed.
    #[must_use]
    pub fn of(knowledge: &Knowledge, policy: &Policy) -> Option<Self> {
        let overrides = Self {
            rules_off: knowledge.rules.unselected.len(),
            regraded: knowledge.rules.rules.iter().filter(|rule| rule.regraded.is_some()).count(),
            paths: policy.paths(),
            metadata_only: policy.metadata_only,
        };
        (overrides != Self::default()).then_some(overrides)
    }
}

/// Fix options of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fixing {
    /// Whether unsafe fixes count as well.
    pub unsafe_fixes: bool,
    /// Whether fixes were made, or only offered.
    pub made: bool,
}

/// The number of findings of each severity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Counts {
    /// Errors.
    pub error: usize,
    /// Warnings.
    pub warning: usize,
    /// Findings of severity info.
    pub info: usize,
}

impl Counts {
    /// Counts findings.
    #[must_use]
    pub fn new(findings: &[Finding]) -> Self {
        let n = |s| findings.iter().filter(|f| f.severity == s).fold(0, |n: usize, f| n.saturating_add(f.count()));
        Self { error: n(Severity::Error), warning: n(Severity::Warning), info: n(Severity::Info) }
    }

    /// Both together.
    #[must_use]
    pub(crate) const fn plus(self, other: Self) -> Self {
        Self {
            error: self.error.saturating_add(other.error),
            warning: self.warning.saturating_add(other.warning),
            info: self.info.saturating_add(other.info),
        }
    }

    /// Clean, or the worst severity present.
    #[must_use]
    pub fn verdict(self) -> Verdict {
        self.worst().map_or(Verdict::Clean, Verdict::from)
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
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct Summary {
    /// Number of checkpoints.
    pub checkpoints: usize,
    /// Clean, or the worst severity.
    pub verdict: Verdict,
    /// Findings by severity.
    pub counts: Counts,
    /// Number of suppressed findings; `counts` does not include them.
    #[serde(skip_serializing_if = "is_zero")]
    pub suppressed: usize,
    /// Number of paths that could not be checked.
    #[serde(skip_serializing_if = "is_zero")]
    pub unchecked: usize,
    /// Number of findings below `--min-severity`, which are in `counts` and not in `findings`.
    #[serde(skip_serializing_if = "is_zero")]
    pub hidden: usize,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands fields by reference")]
const fn is_zero(n: &usize) -> bool {
    *n == 0
}
