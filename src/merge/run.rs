//! State of a merge: the checkpoints checked so far, and the record for the report.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::draft::MergeDraft;
use super::dry_run::PlanDocument;
use super::parts::DonorParts;
use super::tokenizer::{opened_otherwise, tokens_used};
use super::training::{name_in_models, training};
use super::usage::Usage;
use crate::check::inspect::ModuleMap;
use crate::check::load::targets;
use crate::check::options::RunOptions;
use crate::check::{Finding, Outcome, Severity, check_for};
use crate::checkpoint::{Checkpoint, HashAlgorithm, files};
use crate::knowledge::parts::ModelParts;
use crate::knowledge::recipe::Recipe;
use crate::knowledge::{Knowledge, Loader};
use crate::report::Report;
use crate::report::model::{
    ChangedTensor, CheckpointMap, CheckpointReport, MergeReport, MergeStage, Role, StageOutcome,
};
use crate::surgery::Leftover;
use crate::surgery::expr::TensorTransform;
use crate::surgery::plan::Plan;
use crate::surgery::planned_tensor::PlannedTensor;
use crate::surgery::transform::ValueFacts;
use crate::surgery::written::WrittenShard;

/// A request for a merge.
#[derive(Debug, Clone)]
pub struct MergeRequest {
    /// The recipe; selected by the donors' architectures when `None`.
    pub recipe: Option<Recipe>,
    /// Directories of the donors, by role, as given.
    pub donors: BTreeMap<String, PathBuf>,
    /// Options, as given.
    pub options: BTreeMap<String, String>,
    /// Versions of transformers that the result is for; empty: any.
    pub versions: Vec<String>,
    /// Rules whose errors do not stop the merge, by code or name.
    pub tolerate: Vec<String>,
    /// Directory to create.
    pub out: PathBuf,
    /// Whether to stop before writing.
    pub dry_run: bool,
    /// Algorithm of the digests of the tensors in the manifest.
    pub hash: HashAlgorithm,
    /// Whether to hash all bytes of the donors for the manifest, not only documents and headers.
    pub hash_donors: bool,
}

/// A checkpoint that the merge has checked.
#[derive(Debug, Clone)]
pub struct CheckedCheckpoint {
    /// Role in this merge.
    pub role: Role,
    /// The path as given by the user.
    pub path: PathBuf,
    /// The checkpoint.
    pub checkpoint: Arc<Checkpoint>,
    /// The result of checking it.
    pub outcome: Outcome,
    /// The parts of a donor's model.
    pub(super) parts: Option<DonorParts>,
}

impl CheckedCheckpoint {
    /// The role of a donor, with the donor.
    fn donor(&self) -> Option<(&str, &Self)> {
        match &self.role {
            Role::Donor(role) => Some((role, self)),
            Role::Planned | Role::Written => None,
        }
    }
}

/// A merge run: the checked checkpoints and the record for the reports.
#[derive(Debug, Clone, Default)]
pub struct MergeRun {
    /// Checkpoints in the order they were checked.
    pub checked: Vec<CheckedCheckpoint>,
    /// The record for the reports.
    pub record: MergeReport,
    /// Temporary files of an earlier run that were removed, and those of this run that were not; for standard error.
    pub notices: Vec<String>,
    /// The plan; only of a dry run.
    pub(crate) plan: Option<PlanDocument>,
    /// Versions of transformers that the result is for; empty: any.
    pub(super) versions: Vec<String>,
    /// How the result is loaded.
    usage: Usage,
    /// Where the tensors of the result come from.
    origins: Vec<PlannedOrigin>,
}

/// Where a tensor of the result comes from.
#[derive(Debug, Clone)]
struct PlannedOrigin {
    /// Its name in the result.
    name: String,
    /// Roles and names of the donors' tensors that it is made of; it stands for the first.
    sources: Vec<[String; 2]>,
    transform: TensorTransform,
}

impl MergeRun {
    /// A run before its first stage.
    pub(super) fn new(request: &MergeRequest) -> Self {
        let donors = request.donors.iter().map(|(role, dir)| (role.clone(), dir.display().to_string())).collect();
        let record = MergeReport { out: request.out.display().to_string(), donors, ..MergeReport::default() };
        Self { record, versions: request.versions.clone(), ..Self::default() }
    }

    /// The donor in a role of the recipe; `None` before it was checked.
    pub(super) fn donor(&self, role: &str) -> Option<&CheckedCheckpoint> {
        self.checked.iter().find(|c| matches!(&c.role, Role::Donor(own) if own == role))
    }

    /// Records the outcome of one stage.
    pub(super) fn note(&mut self, name: &str, outcome: &str) {
        self.record.stages.push(StageOutcome { name: name.to_owned(), outcome: outcome.to_owned() });
    }

    /// Records that the staging directory of an ended run was removed, and that the own one could not be.
    ///
    /// Called after writing: the report in the merged directory must not depend on what an earlier run left.
    pub(super) fn note_files(&mut self, cleared: Option<&Path>, leftover: Option<&Leftover>) {
        let cleared = cleared.map(|path| format!("{}, which an ended run had left, was removed", path.display()));
        for line in cleared.into_iter().chain(leftover.map(Leftover::to_string)) {
            self.note("clean up", &line);
            self.notices.push(line);
        }
    }

    /// Ends the run at `stage`.
    pub(super) fn end(mut self, stage: MergeStage) -> Self {
        self.record.stage = Some(stage);
        self
    }

    /// Copies the facts of the draft into the record.
    pub(super) fn record_draft(&mut self, draft: &MergeDraft) {
        let record = &mut self.record;
        record.seams.clone_from(&draft.seams);
        record.changed.clone_from(&draft.changed);
        record.training = Some(training(draft.plan.tensors().map(|(_, tensor)| tensor), &draft.train));
        self.usage = Usage::find(draft);
        let record = &mut self.record;
        record.usage = self.usage.statements(&record.out);
        record.dropped.clone_from(&draft.dropped);
        record.repairs.clone_from(&draft.repairs);
        record.notes.clone_from(&draft.notes);
        record.files.clone_from(&draft.files);
        record.tensors = draft.plan.tensors().count();
        record.bytes = draft.plan.tensor_bytes();
        record.transforms.clear();
        self.origins.clear();
        for (_, tensor) in draft.plan.tensors() {
            let transform = tensor.transform();
            let count = record.transforms.entry(transform).or_default();
            *count = count.saturating_add(1);
            let sources = tensor.source.sources().into_iter().map(|of| [of.donor.clone(), of.name.clone()]).collect();
            self.origins.push(PlannedOrigin { name: tensor.name.clone(), sources, transform });
        }
    }

    /// Adds to the record what the files of the planned checkpoint say to the next user.
    pub(super) fn record_preview(&mut self, planned: &Checkpoint, draft: &MergeDraft, knowledge: &Knowledge) {
        let record = &mut self.record;
        record.tokens_used = tokens_used(planned, draft.opened.as_ref());
        let names: Vec<&str> = planned.tensors().map(|(_, tensor)| tensor.name.as_str()).collect();
        let config = planned.document(files::CONFIG).and_then(|document| document.value.as_ref());
        let classes =
            config.map(|config| targets(&knowledge.library, config, &names, &self.versions)).unwrap_or_default();
        // Processors of all versions have the same turn, so that a class is enough that another version has.
        let named = |loader| Some(knowledge.library.find(config?, names.iter().copied(), loader)?.name());
        let known = classes.iter().map(|(_, class)| class.name()).chain(Loader::ALL.into_iter().filter_map(named));
        let host = known.into_iter().find_map(|name| ModelParts::of(&knowledge.parts, name, config?));
        record.prompt = self.usage.prompt(host.and_then(|model| model.image_turn.as_deref()));
        if let Some(training) = &mut record.training {
            name_in_models(training, planned, &classes);
        }
        if let Some(donor) = draft.tokenizer_of.as_ref().and_then(|role| self.donor(role)) {
            let loaders = classes.iter().map(|(target, _)| target.loader);
            let notes = opened_otherwise(&donor.checkpoint, planned, knowledge, loaders);
            self.record.notes.extend(notes);
        }
    }

    /// Adds to the record what scaling, casting and sampling did to values, as known after writing.
    pub(super) fn record_values(&mut self, plan: &Plan, written: &[WrittenShard]) {
        let tensors = || plan.tensors().zip(written.iter().flat_map(|shard| &shard.tensors));
        let facts: HashMap<&str, ValueFacts> = tensors().map(|((_, t), w)| (t.name.as_str(), w.facts)).collect();
        for changed in self.record.changed.iter_mut().filter(|c| c.cast.is_some() || c.scale.is_some()) {
            changed.losses = facts.get(changed.name.as_str()).map(|facts| facts.losses);
        }
        self.record.notes.extend(sampled(tensors().map(|((_, tensor), written)| (tensor, written.facts))));
        let overflows = |changed: &&ChangedTensor| changed.losses.is_some_and(|losses| losses.overflow > 0);
        let affected: Vec<&ChangedTensor> = self.record.changed.iter().filter(overflows).collect();
        if let Some(first) = affected.first() {
            let has_option = self.record.options.contains_key("dtype");
            let advice = if has_option { " Set dtype=bfloat16 or dtype=float32." } else { "" };
            self.record.notes.push(format!(
                "{} values that became infinite because they are too large for the type, the first one {}: the model computes NaN.{advice}",
                count(affected.len(), "tensor has", "tensors have"),
                first.name,
            ));
        }
    }

    /// Checks the planned or written checkpoint, and records the verdict; returns false when it has errors of other rules than
    /// the `tolerated` ones.
    pub(super) fn check(
        &mut self,
        role: Role,
        path: &Path,
        checkpoint: Checkpoint,
        knowledge: &Knowledge,
        tolerated: &[String],
    ) -> bool {
        let checkpoint = Arc::new(checkpoint);
        let outcome = check_for(&checkpoint, knowledge, &RunOptions::for_versions(&self.versions));
        let found = |severity| outcome.findings.iter().filter(|f| f.severity == severity).count();
        let stops = |f: &&Finding| f.severity == Severity::Error && !tolerated.contains(&f.code);
        let stopping = outcome.findings.iter().filter(stops).count();
        let verdict = match (found(Severity::Error), found(Severity::Warning)) {
            (0, 0) => "clean".to_owned(),
            (0, n) => count(n, "warning", "warnings"),
            (n, _) if stopping == 0 => format!("{}, tolerated", count(n, "error", "errors")),
            (n, _) => count(n, "error", "errors"),
        };
        self.note(&format!("check {role}"), &verdict);
        self.checked.push(CheckedCheckpoint { role, path: path.to_owned(), checkpoint, outcome, parts: None });
        stopping == 0
    }

    /// The report of the run.
    #[must_use]
    pub fn report(&self) -> Report {
        self.report_with(self.record.clone(), |checked| checked.path.display().to_string())
    }

    /// The same with maps of the donors and of the result by origin, for a page.
    #[must_use]
    pub fn report_with_maps(&self) -> Report {
        let mut report = self.report();
        let donors: Vec<(&str, &CheckedCheckpoint)> =
            self.checked.iter().filter_map(CheckedCheckpoint::donor).collect();
        let told = |role: &str, transform: TensorTransform| format!("{role}: {}", transform.name());
        // All maps start with the same values, so that a donor has one colour in all of them.
        let values = |other: &str| {
            let copies = donors.iter().map(|(role, _)| told(role, TensorTransform::Copy));
            std::iter::once(other.to_owned()).chain(copies).collect()
        };
        for (role, checked) in &donors {
            // Of a tensor with several uses, the map shows the one for which a tensor of the result stands.
            let aside =
                self.origins.iter().flat_map(|origin| origin.sources.iter().skip(1).map(move |of| (of, origin)));
            let main = self.origins.iter().filter_map(|origin| Some((origin.sources.first()?, origin)));
            let used = aside.chain(main).filter(|([donor, _], _)| donor == role);
            let used = used.map(|([donor, name], origin)| (name.as_str(), told(donor, origin.transform)));
            report.maps.push(CheckpointMap {
                title: format!("{role}: what was taken"),
                map: ModuleMap::by_origin(&checked.checkpoint, values("left out"), used),
            });
        }
        if let Some(result) = self.checked.iter().rfind(|checked| checked.donor().is_none()) {
            let made = self.origins.iter().filter_map(|origin| {
                let [donor, _] = origin.sources.first()?;
                Some((origin.name.as_str(), told(donor, origin.transform)))
            });
            report.maps.push(CheckpointMap {
                title: result.role.to_string(),
                map: ModuleMap::by_origin(&result.checkpoint, values("unknown"), made),
            });
        }
        report
    }

    /// The report without the names of directories, for the file inside the result: the same merge of donors that lie
    /// elsewhere has the same bytes. The manifest identifies the donors by hashes.
    pub(super) fn portable_report(&self) -> Report {
        let usage = self.usage.statements("path/to/this/directory");
        let record = MergeReport { out: String::new(), donors: BTreeMap::new(), usage, ..self.record.clone() };
        self.report_with(record, |checked| checked.role.to_string())
    }

    fn report_with(&self, record: MergeReport, name: impl Fn(&CheckedCheckpoint) -> String) -> Report {
        let checkpoint =
            |c: &CheckedCheckpoint| CheckpointReport::new(name(c), Some(c.role.clone()), &c.checkpoint, &c.outcome);
        Report::new(self.checked.iter().map(checkpoint).collect(), Some(record))
    }
}

/// A note on how many values of sampled rows differ from their mean, by the type that they are stored in.
fn sampled<'p>(tensors: impl Iterator<Item = (&'p PlannedTensor, ValueFacts)>) -> Option<String> {
    let mut shares: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
    for (tensor, facts) in tensors {
        if let Some(values) = tensor.sampled_values() {
            let (distinct, all) = shares.entry(tensor.dtype.float_name().unwrap_or_default()).or_default();
            *distinct = distinct.saturating_add(facts.distinct);
            *all = all.saturating_add(values);
        }
    }
    let words = |(dtype, (distinct, all)): (&&str, &(u64, u64))| format!("{distinct} of {all} in {dtype}");
    let shares: Vec<String> = shares.iter().map(words).collect();
    (!shares.is_empty()).then(|| {
        format!(
            "Of the values in sampled rows, {} differ from the mean that all of the rows have: the noise of transformers is small, and rounding takes most of it in 16 bits. Rows start apart where some differ.",
            shares.join(", ")
        )
    })
}

/// `1 shard`, `2 shards`.
pub(super) fn count(n: usize, one: &str, many: &str) -> String {
    format!("{n} {}", if n == 1 { one } else { many })
}
