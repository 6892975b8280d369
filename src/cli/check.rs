//! `check`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, bail};

use super::args::CheckArgs;
use super::exit::{CLEAN, FAILED, FINDINGS};
use super::paths::{self, Targets};
use super::progress::Meter;
use super::settings::{Resolved, Typed, resolve};
use super::{baseline, fix, output, signals, skipped};
use crate::check::{Outcome, check_for, unused_suppressions};
use crate::checkpoint::journal::StateFolder;
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, HashedFiles, ReadOptions, Source, parallel};
use crate::knowledge::settings::Surroundings;
use crate::report::model::{CheckpointReport, Fixed, Fixing, Overrides, UncheckedPath, Withdrawn};
use crate::report::{Report, fixes};
use crate::surgery::repair::tried;

/// A checkpoint, and the result of checking it.
struct Checked {
    dir: PathBuf,
    checkpoint: Arc<Checkpoint>,
    outcome: Outcome,
    /// Applied fixes, and fixes that were rolled back.
    repaired: (Vec<Fixed>, Vec<Withdrawn>),
}

/// Runs `check`.
pub fn run(args: &CheckArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let Targets { mut dirs, mut unchecked } = paths::targets(&args.paths, args.quiet)?;
    // One output takes the given checkpoint, without those in its folders.
    if args.fix.output.is_some() && dirs.iter().any(|dir| args.paths.contains(dir)) {
        dirs.retain(|dir| args.paths.contains(dir));
    }
    let surroundings = Surroundings::new(args.paths.iter().chain(&dirs).map(PathBuf::as_path));
    // Never freed: the process ends with the run.
    let by: &Resolved = Box::leak(Box::new(resolve(&Typed::check(args, rules), &surroundings)?));
    let real = |dir: &PathBuf| dir.canonicalize().with_context(|| format!("--follow-links {}", dir.display()));
    let followed = args.follow_links.iter().map(real).collect::<anyhow::Result<_>>()?;
    let run = CheckRun { args, by, surroundings: &surroundings, followed };
    args.fix.refuse(dirs.len())?;
    if args.fix.writes() {
        signals::install()?;
    }
    // Reading contents uses all cores for one checkpoint, and what is written to one may be read from another.
    let alone = args.deep || args.stats || args.hash || args.fix.writes();
    let look = |dir: &PathBuf| (shown(dir), run.look(dir.clone()));
    let looks: Box<dyn Iterator<Item = (String, anyhow::Result<Checked>)>> = if alone {
        Box::new(dirs.iter().map(look))
    } else {
        Box::new(parallel::map(parallel::threads(), &dirs, || (), |(), dir| look(dir)).into_iter())
    };
    let mut looked = Vec::new();
    for (path, look) in looks {
        let checked = match look {
            Ok(checked) => {
                run.refuse_unusable(&checked)?;
                run.repaired(checked)
            }
            failed => failed,
        };
        match checked {
            Ok(checked) => looked.push(checked),
            Err(error) if super::interrupted(&error) => return Err(error),
            // The other checkpoints are still checked.
            Err(error) => unchecked.push(UncheckedPath { path, reason: super::causes(&error) }),
        }
    }
    for path in &unchecked {
        output::note(&output::safe(&format!("error: {}: {}", path.path, path.reason)));
    }
    let exit = |found: bool| match (unchecked.is_empty(), found) {
        (false, _) => FAILED,
        (true, true) => FINDINGS,
        (true, false) => CLEAN,
    };
    if args.fix.diff {
        let changes = looked.iter().map(|l| fix::show(&args.fix, &l.dir, &l.checkpoint, &l.outcome, &judge_by(by)));
        let changes = changes.sum::<anyhow::Result<usize>>()?;
        return Ok(exit(changes > 0));
    }
    // A suppression in a path that was not checked may still suppress something.
    let is_checked = |path: &&PathBuf| !unchecked.iter().any(|u| Path::new(&u.path).starts_with(path));
    let searched: Vec<PathBuf> = args.paths.iter().filter(is_checked).cloned().collect();
    report_unused_suppressions(&mut looked, by, &searched);
    let reports = looked.iter().map(|l| {
        let mut report = CheckpointReport::new(shown(&l.dir), None, &l.checkpoint, &l.outcome);
        report.settings = by.file.as_ref().map(|file| shown(file));
        report.overrides = Overrides::of(&by.knowledge);
        (report.fixed, report.withdrawn) = l.repaired.clone();
        report.fixing = Some(Fixing { unsafe_fixes: args.fix.unsafe_fixes, made: args.fix.writes() });
        report
    });
    let mut reports: Vec<CheckpointReport> = reports.collect();
    let fixed = args.fix.exit_non_zero_on_fix && reports.iter().any(|r| !r.fixed.is_empty());
    if args.fix.fix_only {
        output::print(&fixes::made(&reports))?;
        return Ok(exit(fixed));
    }
    baseline::apply_baseline(&mut reports, by, args.baseline.write_baseline)?;
    let failed = reports.iter().any(|report| report.counts.worst().is_some_and(|w| w >= by.fail_on));
    let code = exit(fixed || failed && !args.report.exit_zero);
    let hidden = reports.iter_mut().map(|report| report.hide_below(by.min_severity)).sum();
    let report = Report::new(reports, None).with_unchecked(unchecked).with_hidden(hidden);
    output::finish(&report, &args.report, args.statistics, args.quiet)?;
    if args.verbose {
        for l in &looked {
            skipped::print(&l.dir, &l.outcome, &by.knowledge.rules);
        }
    }
    // Not freed, like the rules.
    std::mem::forget(looked);
    Ok(code)
}

/// Checks a checkpoint under its settings. Every fix that it offers was tried.
fn check_by(by: &Resolved) -> impl Fn(&Arc<Checkpoint>) -> Outcome {
    |checkpoint| tried(checkpoint, judge_by(by)(checkpoint), &judge_by(by))
}

/// Checks a checkpoint without a try of its fixes.
fn judge_by(by: &Resolved) -> impl Fn(&Arc<Checkpoint>) -> Outcome {
    |checkpoint| check_for(checkpoint, &by.knowledge, &by.versions)
}

/// Options of a run, and what surrounds the directories that it checks.
struct CheckRun<'a> {
    args: &'a CheckArgs,
    by: &'a Resolved,
    surroundings: &'a Surroundings,
    /// Real paths of `--follow-links`.
    followed: Arc<[PathBuf]>,
}

impl CheckRun<'_> {
    fn open(&self, dir: &Path) -> anyhow::Result<Arc<Checkpoint>> {
        let mut checkpoint = Checkpoint::read(Source::open(dir)?.following(&self.followed))?;
        checkpoint.recognise_journal(&StateFolder::of_user());
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

    /// Reads and checks a checkpoint.
    fn look(&self, dir: PathBuf) -> anyhow::Result<Checked> {
        fix::recover(&self.args.fix, &dir)?;
        let checkpoint = self.open(&dir)?;
        let outcome = if self.args.fix.writes() || self.args.fix.diff {
            check_for(&checkpoint, &self.by.knowledge, &self.by.versions)
        } else {
            check_by(self.by)(&checkpoint)
        };
        Ok(Checked { dir, checkpoint, outcome, repaired: Default::default() })
    }

    /// Fails when a rule of the user cannot be used.
    fn refuse_unusable(&self, checked: &Checked) -> anyhow::Result<()> {
        let Some(rule) = checked.outcome.unusable.first() else { return Ok(()) };
        let origin = self.by.knowledge.rules.find(&rule.code)?.origin.as_deref().unwrap_or_default();
        bail!("{origin}: {} on {}: {}", rule.code, checked.dir.display(), rule.why);
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

/// Tells how many files were compared with recorded hashes: without a record, a changed file is not found.
fn note_hashed(dir: &Path, hashed: HashedFiles) {
    let HashedFiles { compared, others } = hashed;
    let files = if compared == 1 { "file" } else { "files" };
    let text = format!("{}: {compared} {files} compared with recorded hashes, {others} not", shown(dir));
    output::note(&output::safe(&format!("note: {text}")));
}

/// Adds a finding for each suppression that suppressed nothing.
fn report_unused_suppressions(looked: &mut [Checked], by: &Resolved, searched: &[PathBuf]) {
    let outcomes: Vec<_> = looked.iter().map(|l| (Arc::clone(&l.checkpoint), &l.outcome)).collect();
    for (at, finding) in unused_suppressions(&by.knowledge, &outcomes, searched) {
        if let Some(looked) = looked.get_mut(at) {
            looked.outcome.findings.push(finding);
        }
    }
}
