//! What observers see of a checkpoint, and what they return.

use std::collections::BTreeSet;

use serde_json::Value;

use super::load::{LoadReport, Target};
use crate::checkpoint::files::Object;
use crate::checkpoint::{Checkpoint, Fault};
use crate::knowledge::names::{LoaderNames, NameKind};
use crate::knowledge::processor::Processor;
use crate::knowledge::program::AskedProgram;
use crate::knowledge::{Knowledge, Scope};

/// The targets of a run.
#[derive(Clone, Copy)]
pub(super) struct Asked<'t> {
    pub(super) targets: &'t [Target],
    /// Whether the user named them.
    pub(super) named: bool,
}

impl<'t> Asked<'t> {
    /// The targets that do not know a name. The version that config.json states is no evidence against a name that it
    /// uses and a known version has: models are published with the version of a development build.
    pub(super) fn lacking(self, names: &LoaderNames, kind: NameKind, name: &str) -> Vec<&'t Target> {
        let is_stated = |target: &Target| target.leads && !self.named || target.version().contains("dev");
        let lacks = |target: &&Target| {
            names.lacks(target.version(), kind, name) && !(is_stated(target) && names.contains(kind, name))
        };
        self.targets.iter().filter(lacks).collect()
    }
}

/// What observers see of a run, whichever versions of transformers it judges.
#[derive(Clone, Copy)]
pub(super) struct FilesView<'v> {
    pub(super) checkpoint: &'v Checkpoint,
    pub(super) knowledge: &'v Knowledge,
    /// The other programs of the run.
    pub(super) programs: &'v [AskedProgram<'v>],
    /// The versions of PEFT that the user named.
    pub(super) peft: &'v [String],
    /// Rows of the largest token embedding, which every token id must stay below; `None` without one.
    pub(super) rows: Option<u64>,
}

/// What observers see of a reading for some versions of transformers, when their loads are predicted.
#[derive(Clone, Copy)]
pub(super) struct VersionsView<'v> {
    pub(super) checkpoint: &'v Checkpoint,
    pub(super) knowledge: &'v Knowledge,
    pub(super) asked: Asked<'v>,
    /// The whole predicted load reports.
    pub(super) loads: &'v [LoadReport],
    /// The versions of PEFT that the user named.
    pub(super) peft: &'v [String],
    /// Faults of the predicted loads.
    pub(super) of_loads: &'v [Fault],
    /// config.json with the defaults of the class; null when no class was built.
    pub(super) filled: &'v Value,
    /// The same, or config.json as it is when no class was built.
    pub(super) model: &'v Value,
    /// The processor of the class.
    pub(super) of_class: Option<&'v Processor>,
    /// The variables of rules, all but `program`.
    pub(super) scope: &'v Scope<'static>,
}

/// Facts of observers by which faults of others are explained.
#[derive(Default)]
pub(super) struct ExplainingFacts {
    /// The fault that tells the kind of a directory that is no checkpoint of transformers.
    pub(super) directory: Option<Fault>,
    /// Pointers of config values that a class refuses under some version.
    pub(super) refused: BTreeSet<String>,
}

/// Whether an object beside the model was judged under a version.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct JudgedObject {
    /// The object.
    pub(super) object: Object,
    /// The version.
    pub(super) loader: &'static str,
    /// Why it was not judged; `None` where it was, and faults tell what does not fit.
    pub(super) not_judged: Option<String>,
}

/// The result of an observer.
#[derive(Default)]
pub(super) struct Observation {
    pub(super) faults: Vec<Fault>,
    pub(super) facts: ExplainingFacts,
    /// For each version, the objects beside the model that were judged.
    pub(super) objects: Vec<JudgedObject>,
}

impl<F: IntoIterator<Item = Fault>> From<F> for Observation {
    fn from(faults: F) -> Self {
        Self { faults: faults.into_iter().collect(), ..Self::default() }
    }
}
