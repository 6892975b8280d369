//! Checks one directory of a run, in this process or in a worker.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::args::CheckArgs;
use super::fix::Preview;
use super::progress::Meter;
use super::settings::{Resolved, Typed, resolve};
use super::{fix, output};
use crate::check::finding::Skipped;
use crate::check::{Outcome, SuppressionUse, check_for, suppression_uses};
use crate::checkpoint::adapter::BaseSearch;
use crate::checkpoint::journal::StateFolder;
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, HashedFiles, ReadOptions, Source};
use crate::knowledge::settings::Surroundings;
use crate::report::model::{CheckpointReport, Fixed, Fixing, Overrides, Withdrawn};
use crate::surgery::repair::tried;

/// A checkpoint, and the result of checking it.
struct Checked {
    dir: PathBuf,
    checkpoint: Arc<Checkpoint>,
    outcome: Outcome,
    /// Applied fixes, and fixes that were rolled back.
    repaired: (Vec<Fixed>, Vec<Withdrawn>),
}

/// What a run keeps of a directory that was checked. A worker sends it.
#[derive(Serialize, Deserialize)]
pub struct Looked {
    pub report: CheckpointReport,
    pub uses: Vec<SuppressionUse>,
    pub skipped: Vec<Skipped>,
}

/// What a run asks for each directory, of itself or of a worker.
pub trait Answer: Serialize + DeserializeOwned + Send {
    /// Looks at the directory.
    fn of(run: &CheckRun<'_>, dir: &Path) -> Result<Self, Stop>;
}

impl Answer for Looked {
    fn of(run: &CheckRun<'_>, dir: &Path) -> Result<Self, Stop> {
        run.look(dir)
    }
}

impl Answer for Preview {
    fn of(run: &CheckRun<'_>, dir: &Path) -> Result<Self, Stop> {
        let Checked { dir, checkpoint, outcome, .. } = run.check(dir)?;
        Ok(fix::preview(&run.args.fix, &dir, &checkpoint, outcome, &judge_by(run.by)))
    }
}

/// Why a directory has no report.
#[derive(Serialize, Deserialize)]
pub enum Stop {
    /// It could not be checked; the other directories are still checked.
    Directory(String),
    /// The run cannot go on: a rule of the user is unusable.
    Run(String),
    /// A signal ended the run while it repaired this directory.
    Interrupted,
}

impl From<anyhow::Error> for Stop {
    fn from(error: anyhow::Error) -> Self {
        if super::interrupted(&error) { Self::Interrupted } else { Self::Directory(super::causes(&error)) }
    }
}

/// Options of a run, and what surrounds the directories that it checks.
pub struct CheckRun<'a> {
    pub args: &'a CheckArgs,
    /// It lives until the process ends, as the run does, so that nothing is freed value by value.
    pub by: &'static Resolved,
    surroundings: Surroundings,
    /// Real paths of `--follow-links`.
    followed: Arc<[PathBuf]>,
    /// Where base models of adapters are searched for.
    bases: BaseSearch,
}

impl<'a> CheckRun<'a> {
    /// The options of a run on these directories.
    pub fn new(args: &'a CheckArgs, rules: Option<&Path>, dirs: &[PathBuf]) -> anyhow::Result<Self> {
        let surroundings = Surroundings::new(args.paths.iter().chain(dirs).map(PathBuf::as_path));
        let by = Box::leak(Box::new(resolve(&Typed::check(args, rules), &surroundings)?));
        let real = |dir: &PathBuf| dir.canonicalize().with_context(|| format!("--follow-links {}", dir.display()));
        let followed = args.follow_links.iter().map(real).collect::<anyhow::Result<_>>()?;
        if let Some(base) = &args.base {
            Source::open(base).context("--base")?;
        }
        let caches = BaseSearch::cache_of_user().into_iter().collect();
        let bases = BaseSearch::new(args.base.clone(), dirs.to_vec(), caches);
        Ok(Self { args, by, surroundings, followed, bases })
    }

    fn open(&self, dir: &Path) -> anyhow::Result<Arc<Checkpoint>> {
        let mut checkpoint = Checkpoint::read(Source::open(dir)?.following(&self.followed))?;
        checkpoint.recognise_journal(&StateFolder::of_user());
        checkpoint.find_base(&self.bases);
        checkpoint.expect_lfs_pointers(&|top| self.surroundings.distrust(top, ".git").is_none());
        if self.args.deep || self.args.stats {
            let meter = Meter::new("reading");
            let options = ReadOptions { stats: self.args.stats, ..ReadOptions::default() };
            checkpoint.read_contents(options, &|read| meter.add(read.file, read.bytes, read.total));
        }
        if self.args.hash {
            let meter = Meter::new("hashing");
            let hashed = checkpoint.check_hashes(&|read| meter.add(read.file, read.bytes, read.total));
            drop(meter);
            note_hashed(dir, hashed);
        }
        Ok(Arc::new(checkpoint))
    }

    /// Reads, checks and, if the arguments ask for it, repairs a checkpoint; its report.
    fn look(&self, dir: &Path) -> Result<Looked, Stop> {
        let checked = self.repaired(self.check(dir)?)?;
        let Checked { dir, checkpoint, outcome, repaired } = &checked;
        let mut report = CheckpointReport::new(shown(dir), None, checkpoint, outcome);
        report.settings = self.by.file.as_ref().map(|file| shown(file));
        report.overrides = Overrides::of(&self.by.knowledge, &self.by.options.policy);
        (report.fixed, report.withdrawn) = repaired.clone();
        let fix = &self.args.fix;
        report.fixing = Some(Fixing { unsafe_fixes: fix.unsafe_fixes, made: fix.writes() });
        let uses = suppression_uses(&self.by.knowledge, &self.by.options.policy, checkpoint, outcome);
        Ok(Looked { report, uses, skipped: outcome.skipped.clone() })
    }

    /// Reads and checks a checkpoint.
    fn check(&self, dir: &Path) -> Result<Checked, Stop> {
        let read = || {
            fix::recover(&self.args.fix, dir)?;
            self.open(dir)
        };
        let checkpoint = read()?;
        let outcome = if self.args.fix.writes() || self.args.fix.diff {
            check_for(&checkpoint, &self.by.knowledge, &self.by.options)
        } else {
            check_by(self.by)(&checkpoint)
        };
        let checked = Checked { dir: dir.to_owned(), checkpoint, outcome, repaired: Default::default() };
        self.refuse_unusable(&checked)?;
        Ok(checked)
    }

    /// Fails when a rule of the user cannot be used.
    fn refuse_unusable(&self, checked: &Checked) -> Result<(), Stop> {
        let Some(rule) = checked.outcome.unusable.first() else { return Ok(()) };
        let found = self.by.knowledge.rules.find(&rule.code).map_err(anyhow::Error::from);
        let origin = found.map_err(|error| Stop::Run(super::causes(&error)))?.origin.as_deref().unwrap_or_default();
        Err(Stop::Run(format!("{origin}: {} on {}: {}", rule.code, checked.dir.display(), rule.why)))
    }

    /// Applies the fixes, if the arguments ask for it.
    fn repaired(&self, checked: Checked) -> anyhow::Result<Checked> {
        if !self.args.fix.writes() {
            return Ok(checked);
        }
        let Checked { dir, checkpoint, outcome, .. } = checked;
        let repaired =
            fix::repair(&self.args.fix, dir, &checkpoint, outcome, &|dir| self.open(dir), &judge_by(self.by))?;
        let fix::Repaired { dir, checkpoint, outcome, fixed, withdrawn } = repaired;
        let outcome = outcome
            .map_or_else(|| check_by(self.by)(&checkpoint), |outcome| tried(&checkpoint, outcome, &judge_by(self.by)));
        Ok(Checked { dir, checkpoint, outcome, repaired: (fixed, withdrawn) })
    }
}

/// Checks a checkpoint under its settings. Every fix that it offers was tried.
fn check_by(by: &Resolved) -> impl Fn(&Arc<Checkpoint>) -> Outcome {
    |checkpoint| tried(checkpoint, judge_by(by)(checkpoint), &judge_by(by))
}

/// Checks a checkpoint without a try of its fixes.
fn judge_by(by: &Resolved) -> impl Fn(&Arc<Checkpoint>) -> Outcome {
    |checkpoint| check_for(checkpoint, &by.knowledge, &by.options)
}

/// Tells how many files were compared with recorded hashes: without a record, a changed file is not found.
fn note_hashed(dir: &Path, hashed: HashedFiles) {
    let HashedFiles { compared, others } = hashed;
    let files = if compared == 1 { "file" } else { "files" };
    let text = format!("{}: {compared} {files} compared with recorded hashes, {others} not", shown(dir));
    output::note(&output::safe(&format!("note: {text}")));
}
