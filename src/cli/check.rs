//! `check`.

use std::path::{Path, PathBuf};

use super::args::CheckArgs;
use super::exit::{CLEAN, FAILED, FINDINGS};
use super::fix::Preview;
use super::look::{Answer, CheckRun, Looked, Stop};
use super::paths::{self, Targets};
use super::{baseline, fix, interpreter, output, pins, signals, skipped, workers};
use crate::check::unused_suppressions;
use crate::checkpoint::parallel;
use crate::checkpoint::platform::shown;
use crate::report::model::{CheckpointReport, UncheckedPath};
use crate::report::{Report, fixes};

/// Runs `check`.
pub fn run(mut args: CheckArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    args.versions = pins::programs(&args.versions)?;
    let Targets { mut dirs, unchecked } = paths::targets(&args.paths, args.quiet)?;
    if let Some(python) = args.for_python.take() {
        args.versions.extend(interpreter::versions(&python, &dirs)?);
    }
    let args = &args;
    // One output takes the given checkpoint, without those in its folders.
    if args.fix.output.is_some() && dirs.iter().any(|dir| args.paths.contains(dir)) {
        dirs.retain(|dir| args.paths.contains(dir));
    }
    let run = CheckRun::new(args, rules, &dirs)?;
    args.fix.refuse(dirs.len())?;
    if args.fix.writes() {
        signals::install()?;
    }
    let mut results = Results { looked: Vec::new(), unchecked };
    if args.fix.diff {
        return run.show_diffs(&dirs, results.unchecked);
    }
    for (dir, look) in dirs.iter().zip(run.ask(&dirs)) {
        let looked = results.had(args, dir, look)?.map(|looked| (dir.clone(), looked));
        results.looked.extend(looked);
    }
    note_unchecked(&results.unchecked);
    run.report(results)
}

/// What a run found.
struct Results {
    looked: Vec<(PathBuf, Looked)>,
    unchecked: Vec<UncheckedPath>,
}

impl Results {
    /// The answer on a directory, or `None` where it has none and is noted instead. Fails with what ends the run.
    fn had<T>(&mut self, args: &CheckArgs, dir: &Path, answer: Result<T, Stop>) -> anyhow::Result<Option<T>> {
        match answer {
            Ok(answer) => return Ok(Some(answer)),
            Err(Stop::Directory(reason)) => self.unchecked.push(UncheckedPath { path: shown(dir), reason }),
            Err(Stop::Run(reason)) => return Err(anyhow::Error::msg(reason)),
            Err(Stop::Interrupted) => return Err(fix::interrupted(args.fix.output.as_deref().unwrap_or(dir))),
        }
        Ok(None)
    }

    /// Adds a finding for each suppression that suppressed nothing.
    fn report_unused_suppressions(&mut self, run: &CheckRun<'_>) {
        // A suppression in a path that was not checked may still suppress something.
        let is_checked = |path: &&PathBuf| !self.unchecked.iter().any(|u| Path::new(&u.path).starts_with(path));
        let searched: Vec<PathBuf> = run.args.paths.iter().filter(is_checked).cloned().collect();
        let uses: Vec<_> = self.looked.iter().map(|(dir, looked)| (dir.as_path(), looked.uses.as_slice())).collect();
        for (at, finding) in unused_suppressions(&run.by.knowledge, &run.by.options.policy, &uses, &searched) {
            if let Some((_, looked)) = self.looked.get_mut(at) {
                looked.report.add(finding);
            }
        }
    }

    /// The exit code, if there is nothing else that fails the run.
    const fn exit(&self, found: bool) -> u8 {
        match (self.unchecked.is_empty(), found) {
            (false, _) => FAILED,
            (true, true) => FINDINGS,
            (true, false) => CLEAN,
        }
    }
}

impl CheckRun<'_> {
    /// Asks for each directory; the answers in their order.
    fn ask<'d, T: Answer + 'd>(&'d self, dirs: &'d [PathBuf]) -> Box<dyn Iterator<Item = Result<T, Stop>> + 'd> {
        let threads = self.args.jobs.map_or_else(parallel::threads, |jobs| jobs.get().into());
        match dirs {
            [_] | [] => Box::new(dirs.iter().map(|dir| T::of(self, dir))),
            // A repair that was interrupted stops the run before the next one begins.
            _ if self.args.fix.writes() => workers::ask_in_turn(self, dirs),
            _ => Box::new(workers::ask(self, dirs, if self.is_long() { 1 } else { threads }).into_iter()),
        }
    }

    /// Whether reading one checkpoint takes all cores, and shows its progress.
    pub fn is_long(&self) -> bool {
        self.args.deep || self.args.stats || self.args.hash
    }

    /// Shows what the fixes would change.
    fn show_diffs(&self, dirs: &[PathBuf], unchecked: Vec<UncheckedPath>) -> anyhow::Result<u8> {
        let mut results = Results { looked: Vec::new(), unchecked };
        let mut previews: Vec<Preview> = Vec::new();
        for (dir, preview) in dirs.iter().zip(self.ask(dirs)) {
            previews.extend(results.had(self.args, dir, preview)?);
        }
        note_unchecked(&results.unchecked);
        let mut changes = 0_usize;
        for Preview { diff, fixes, files } in previews {
            output::print(&diff)?;
            output::note(&fixes::would(fixes, files));
            changes = changes.saturating_add(files);
        }
        Ok(results.exit(changes > 0))
    }

    /// Prints and writes the reports; the exit code.
    fn report(&self, mut results: Results) -> anyhow::Result<u8> {
        let Self { args, by, .. } = self;
        results.report_unused_suppressions(self);
        let looked = std::mem::take(&mut results.looked);
        let (mut reports, mut skips): (Vec<CheckpointReport>, Vec<_>) = (Vec::new(), Vec::new());
        for (dir, Looked { report, skipped, .. }) in looked {
            reports.push(report);
            skips.push((dir, skipped));
        }
        let fixed = args.fix.exit_non_zero_on_fix && reports.iter().any(|r| !r.fixed.is_empty());
        if args.fix.fix_only {
            output::print(&fixes::made(&reports))?;
            return Ok(results.exit(fixed));
        }
        baseline::apply_baseline(&mut reports, by, args.baseline.write_baseline)?;
        let failed = reports.iter().any(|report| report.counts.worst().is_some_and(|w| w >= by.fail_on));
        let code = results.exit(fixed || failed && !args.report.exit_zero);
        let hidden = reports.iter_mut().map(|report| report.hide_below(by.min_severity)).sum();
        let fail_on = (!args.report.exit_zero).then_some(by.fail_on);
        let report = Report::new(reports, None).with_unchecked(results.unchecked).with_hidden(hidden);
        let report = report.with_terms(&by.knowledge, fail_on);
        output::finish(&report, &args.report, args.statistics, args.quiet)?;
        if args.verbose {
            for (dir, skipped) in &skips {
                skipped::print(dir, skipped, &by.knowledge.rules);
            }
        }
        Ok(code)
    }
}

/// Names the directories without a report.
fn note_unchecked(unchecked: &[UncheckedPath]) {
    for path in unchecked {
        output::note(&output::safe(&format!("error: {}: {}", path.path, path.reason)));
    }
}
