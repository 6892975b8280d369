//! The merge from donors to a written checkpoint, stage by stage.
//!
//! check donors → recipe → plan → check what is planned → write → reopen and check. Each stage can be the
//! last; before `write` nothing exists.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::record::{MergeReport, Stage};
use super::{Donor, Draft, MergeError, Options, draft, manifest, resolve_options};
use crate::check::{Knowledge, Outcome, Severity, check};
use crate::checkpoint::tokenizer::VOCABULARY_FILES;
use crate::checkpoint::{Checkpoint, Document, Entry, Module, OpenError, Parts, Vocabulary};
use crate::knowledge::recipe::Recipe;
use crate::surgery::apply::{ApplyError, apply, check_target, interrupted};
use crate::surgery::donor::AtRest;
use crate::surgery::plan::PlannedFile;

/// What a merge is asked to do.
#[derive(Debug, Clone)]
pub struct Request {
    /// The recipe; chosen by the donors' architectures when absent.
    pub recipe: Option<Recipe>,
    /// Role to directory, as given.
    pub donors: BTreeMap<String, PathBuf>,
    /// Options as given.
    pub options: BTreeMap<String, String>,
    /// Directory to make.
    pub out: PathBuf,
    /// Stop before anything is written.
    pub dry_run: bool,
    /// Hash every byte of the donors for the manifest, not only documents and headers.
    pub hash: bool,
}

/// A checkpoint that was looked at on the way.
#[derive(Debug, Clone)]
pub struct Looked {
    /// `donor vision`, `planned`, `written`.
    pub role: String,
    /// As the user named it.
    pub path: PathBuf,
    /// What was there.
    pub checkpoint: Arc<Checkpoint>,
    /// What was found.
    pub outcome: Outcome,
}

/// How far a merge came, and what every stage said.
#[derive(Debug, Clone, Default)]
pub struct Run {
    /// Checkpoints in the order they were looked at.
    pub looked: Vec<Looked>,
    /// The record for the reports.
    pub record: MergeReport,
}

/// Why a merge could not be tried, or failed while writing.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// A donor's directory cannot be read.
    #[error("donor {role}: {error}")]
    Open {
        /// Role.
        role: String,
        /// What the system said.
        error: OpenError,
    },
    /// The request does not fit the recipe.
    #[error(transparent)]
    Merge(#[from] MergeError),
    /// The target is in the way, or writing failed.
    #[error(transparent)]
    Apply(#[from] ApplyError),
    /// A data file inside the program or given by the user is not right.
    #[error(transparent)]
    Data(#[from] crate::knowledge::source::DataError),
}

/// Runs a merge as far as it goes.
///
/// `report` renders the record for `merge-report.md`; `progress` hears of bytes written and of the total.
/// A donor with errors, a seam that does not fit and a planned checkpoint with errors are no failure of the
/// run: its record's `stage` says where it stopped.
///
/// # Errors
/// A [`PipelineError`]; nothing was written then.
pub fn run(
    request: &Request,
    knowledge: &Knowledge,
    report: &dyn Fn(&Run) -> String,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Run, PipelineError> {
    let mut run = Run::default();
    run.record.out = request.out.display().to_string();
    run.record.donors = request.donors.iter().map(|(role, dir)| (role.clone(), dir.display().to_string())).collect();
    let dirs: Vec<&Path> = request.donors.values().map(PathBuf::as_path).collect();
    let out = check_target(&request.out, &dirs)?;

    let mut donors = Vec::new();
    let mut at_rest = Vec::new();
    for (role, dir) in &request.donors {
        interrupted()?;
        let seen = AtRest::see(dir);
        let checkpoint = Checkpoint::open(dir).map_err(|error| PipelineError::Open { role: role.clone(), error })?;
        at_rest.push(seen?);
        let checkpoint = Arc::new(checkpoint);
        let outcome = check(&checkpoint, knowledge);
        donors.push(Donor { role: role.clone(), checkpoint: Arc::clone(&checkpoint), config: outcome.config.clone() });
        run.looked.push(Looked { role: format!("donor {role}"), path: dir.clone(), checkpoint, outcome });
    }
    let recipe = match &request.recipe {
        Some(recipe) => recipe.clone(),
        None => choose(&run)?,
    };
    run.record.recipe.clone_from(&recipe.recipe);
    roles(&recipe, request)?;
    let options = resolve_options(&recipe, &request.options)?;
    run.record.options.clone_from(&options);
    if !sound(&recipe, &mut run) {
        return Ok(run);
    }
    note(&mut run, "recipe", &format!("{}: {}", recipe.recipe, recipe.summary));

    fits(&recipe, &run)?;
    let mut drafted = draft(&recipe, &donors, &options, &knowledge.library)?;
    record(&mut run.record, &drafted);
    if !drafted.seams.is_empty() {
        "seam".clone_into(&mut run.record.stage);
        note(&mut run, "plan", &count(drafted.seams.len(), "seam does not fit", "seams do not fit"));
        return Ok(run);
    }
    let planned = format!(
        "{} tensors, {} bytes in {}",
        run.record.tensors,
        run.record.bytes,
        count(drafted.plan.shards.len(), "shard", "shards")
    );
    note(&mut run, "plan", &planned);

    let preview = Arc::new(preview(&drafted, &out));
    if !judged(&mut run, "planned", &request.out, preview, knowledge) {
        "planned".clone_into(&mut run.record.stage);
        return Ok(run);
    }
    if request.dry_run {
        "dry-run".clone_into(&mut run.record.stage);
        note(&mut run, "write", "not asked for (--dry-run)");
        return Ok(run);
    }

    accompany(&mut drafted, &mut run, &recipe, &options, &donors, request, report)?;
    let total = drafted.plan.len();
    let mut done = 0_u64;
    apply(&drafted.plan, &at_rest, &out, &mut |bytes| {
        done = done.saturating_add(bytes);
        progress(done, total);
    })?;
    note(&mut run, "write", &format!("{total} bytes, published as one rename"));
    "written".clone_into(&mut run.record.stage);

    let written = Checkpoint::open(&out).map_err(|error| PipelineError::Open { role: "written".to_owned(), error })?;
    judged(&mut run, "written", &request.out, Arc::new(written), knowledge);
    Ok(run)
}

fn note(run: &mut Run, name: &str, outcome: &str) {
    run.record.stages.push(Stage { name: name.to_owned(), outcome: outcome.to_owned() });
}

fn count(n: usize, one: &str, many: &str) -> String {
    format!("{n} {}", if n == 1 { one } else { many })
}

/// The one recipe whose roles the donors' architectures can play.
fn choose(run: &Run) -> Result<Recipe, PipelineError> {
    let fitting: Vec<Recipe> = Recipe::embedded()?
        .into_iter()
        .filter(|recipe| {
            let plays = |spec: &crate::knowledge::recipe::DonorSpec| {
                let donor = run.looked.iter().find(|l| l.role == format!("donor {}", spec.role));
                donor.map_or(spec.optional, |l| {
                    spec.architectures.is_empty()
                        || l.outcome.architecture.as_ref().is_some_and(|a| spec.architectures.contains(a))
                })
            };
            recipe.donors.iter().all(plays)
        })
        .collect();
    let names: Vec<&str> = fitting.iter().map(|r| r.recipe.as_str()).collect();
    match fitting.as_slice() {
        [one] => Ok(one.clone()),
        [] => {
            let are: Vec<String> = run
                .looked
                .iter()
                .map(|l| {
                    format!(
                        "{} is {}",
                        l.role,
                        l.outcome.architecture.as_deref().unwrap_or("of an unknown architecture")
                    )
                })
                .collect();
            Err(MergeError::Donor(format!("no recipe fits these donors: {}; give one with --recipe", are.join(", ")))
                .into())
        }
        _ => Err(MergeError::Donor(format!(
            "several recipes fit these donors: {}; choose one with --recipe",
            names.join(", ")
        ))
        .into()),
    }
}

/// Whether the donors given are those the recipe asks for.
fn roles(recipe: &Recipe, request: &Request) -> Result<(), MergeError> {
    for role in request.donors.keys() {
        if !recipe.donors.iter().any(|d| d.role == *role) {
            let known: Vec<&str> = recipe.donors.iter().map(|d| d.role.as_str()).collect();
            return Err(MergeError::Option(format!(
                "recipe {} has no donor {role}; it has {}",
                recipe.recipe,
                known.join(", ")
            )));
        }
    }
    for spec in recipe.donors.iter().filter(|d| !d.optional) {
        if !request.donors.contains_key(&spec.role) {
            return Err(MergeError::Option(format!(
                "recipe {} needs a {} donor, {}: --donor {}=DIR",
                recipe.recipe, spec.role, spec.what, spec.role
            )));
        }
    }
    Ok(())
}

/// Whether each donor's architecture can play its role.
fn fits(recipe: &Recipe, run: &Run) -> Result<(), MergeError> {
    for spec in recipe.donors.iter().filter(|s| !s.architectures.is_empty()) {
        let Some(looked) = run.looked.iter().find(|l| l.role == format!("donor {}", spec.role)) else { continue };
        let is = looked.outcome.architecture.as_deref();
        if !is.is_some_and(|a| spec.architectures.iter().any(|s| s == a)) {
            return Err(MergeError::Donor(format!(
                "{}: the {} donor has to be {} ({}), this is {}",
                looked.path.display(),
                spec.role,
                spec.architectures.join(" or "),
                spec.what,
                is.unwrap_or("of an unknown architecture")
            )));
        }
    }
    Ok(())
}

/// Whether no donor has an error that the recipe does not tolerate.
fn sound(recipe: &Recipe, run: &mut Run) -> bool {
    let mut bad = Vec::new();
    for looked in &run.looked {
        let spec = recipe.donors.iter().find(|d| format!("donor {}", d.role) == looked.role);
        // A directory that only lends Python modules is not judged as a checkpoint.
        if spec.is_some_and(|s| s.architectures.is_empty()) {
            continue;
        }
        let stops = |f: &&crate::check::Finding| {
            f.severity == Severity::Error && !spec.is_some_and(|s| s.tolerates.contains(&f.code))
        };
        let errors = looked.outcome.findings.iter().filter(stops).count();
        if errors > 0 {
            bad.push(format!("{} has {}", looked.role, count(errors, "error", "errors")));
        }
    }
    if bad.is_empty() {
        note(run, "donors", &count(run.looked.len(), "donor is sound", "donors are sound"));
        return true;
    }
    "donors".clone_into(&mut run.record.stage);
    note(run, "donors", &bad.join(", "));
    false
}

/// Checks a checkpoint and notes the verdict; false when it has errors.
fn judged(run: &mut Run, role: &str, path: &Path, checkpoint: Arc<Checkpoint>, knowledge: &Knowledge) -> bool {
    let outcome = check(&checkpoint, knowledge);
    let errors = outcome.findings.iter().filter(|f| f.severity == Severity::Error).count();
    let warnings = outcome.findings.iter().filter(|f| f.severity == Severity::Warning).count();
    let verdict = match (errors, warnings) {
        (0, 0) => "clean".to_owned(),
        (0, n) => count(n, "warning", "warnings"),
        (n, _) => count(n, "error", "errors"),
    };
    note(run, &format!("check {role}"), &verdict);
    run.looked.push(Looked { role: role.to_owned(), path: path.to_owned(), checkpoint, outcome });
    errors == 0
}

fn record(record: &mut MergeReport, drafted: &Draft) {
    record.seams.clone_from(&drafted.seams);
    record.changed.clone_from(&drafted.changed);
    record.dropped.clone_from(&drafted.dropped);
    record.repairs.clone_from(&drafted.repairs);
    record.notes.clone_from(&drafted.notes);
    record.files.clone_from(&drafted.files);
    record.tensors = drafted.plan.tensors().count();
    record.bytes = drafted.plan.tensor_bytes();
    record.transforms.clear();
    for (_, tensor) in drafted.plan.tensors() {
        let n = record.transforms.entry(tensor.source.word().to_owned()).or_default();
        *n = n.saturating_add(1);
    }
}

/// The planned checkpoint as a reader would see it.
fn preview(drafted: &Draft, out: &Path) -> Checkpoint {
    let mut parts = Parts { documents: drafted.documents.clone(), ..Parts::default() };
    parts.shards = drafted.plan.shards.iter().map(crate::surgery::plan::PlannedShard::preview).collect();
    for file in &drafted.plan.files {
        if file.name.ends_with(".py") {
            parts.modules.push(Module::parse(file.name.as_str(), &file.bytes));
        } else if !drafted.documents.iter().any(|d| d.name == file.name) {
            if file.name.ends_with(".json") {
                parts.documents.push(Document::parse(file.name.as_str(), &file.bytes));
            } else if VOCABULARY_FILES.contains(&file.name.as_str())
                && let Ok(vocabulary) = Vocabulary::parse(&file.name, &file.bytes)
            {
                parts.vocabularies.insert(file.name.clone(), Arc::new(vocabulary));
            }
            parts.entries.insert(file.name.clone(), Entry { size: file.bytes.len() as u64, ..Entry::default() });
        }
    }
    Checkpoint::planned(out, parts)
}

/// Adds the manifest and the report to the plan.
fn accompany(
    drafted: &mut Draft,
    run: &mut Run,
    recipe: &Recipe,
    options: &Options,
    donors: &[Donor],
    request: &Request,
    report: &dyn Fn(&Run) -> String,
) -> Result<(), PipelineError> {
    let manifest = manifest::manifest(recipe, options, donors, drafted, request.hash)?;
    let mut text = serde_json::to_string_pretty(&manifest).unwrap_or_default();
    text.push('\n');
    let origin = "made by the merge";
    let add = |files: &mut Vec<PlannedFile>, name: &str, bytes: Vec<u8>| {
        files.insert(0, PlannedFile { name: name.to_owned(), bytes: bytes.into(), origin: origin.to_owned() });
    };
    add(&mut drafted.plan.files, manifest::NAME, text.into_bytes());
    for name in [manifest::NAME, REPORT] {
        run.record.files.push(super::record::MergedFile { name: name.to_owned(), origin: origin.to_owned() });
    }
    let report = report(run);
    add(&mut drafted.plan.files, REPORT, report.into_bytes());
    Ok(())
}

/// File name of the report in the merged directory.
pub const REPORT: &str = "merge-report.md";
