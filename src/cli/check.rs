//! `check`.

use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::Arc;

use anyhow::bail;

use super::args::CheckArgs;
use super::exit::{CLEAN, FAILED, FINDINGS};
use super::paths::{self, Targets};
use super::settings::{Resolved, SettingsResolver, Typed};
use super::{baseline, fix, output, signals, skipped};
use crate::check::{Outcome, check_for, unused_suppressions};
use crate::checkpoint::Checkpoint;
use crate::report::model::{CheckpointReport, Fixed, Fixing, UncheckedPath, Withdrawn};
use crate::report::{Report, fixes};

/// A checkpoint, the result of checking it and the settings it was checked under.
struct Checked {
    dir: PathBuf,
    checkpoint: Arc<Checkpoint>,
    outcome: Outcome,
    by: Rc<Resolved>,
    /// Applied fixes, and fixes that were rolled back.
    repaired: (Vec<Fixed>, Vec<Withdrawn>),
}

/// Runs `check`.
pub fn run(args: &CheckArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let mut settings = SettingsResolver::new(Typed::check(args, rules));
    let Targets { dirs, mut unchecked } = paths::targets(&args.paths, args.quiet);
    args.fix.refuse(dirs.len())?;
    if args.fix.writes() {
        signals::install()?;
    }
    let mut looked = Vec::new();
    for dir in dirs {
        let by = settings.resolve(&dir)?;
        let path = dir.display().to_string();
        let checked = match look(dir, args, by) {
            Ok(checked) => {
                refuse_unusable(&checked)?;
                repaired(checked, args)
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
        let changes = looked.iter().map(|l| fix::show(&args.fix, &l.dir, &l.checkpoint, &l.outcome, &check_by(&l.by)));
        let changes = changes.sum::<anyhow::Result<usize>>()?;
        return Ok(exit(changes > 0));
    }
    // A suppression in a path that was not checked may still suppress something.
    let is_checked = |path: &&PathBuf| !unchecked.iter().any(|u| Path::new(&u.path).starts_with(path));
    let searched: Vec<PathBuf> = args.paths.iter().filter(is_checked).cloned().collect();
    report_unused_suppressions(&mut looked, &settings, &searched);
    let reports = looked.iter().map(|l| {
        let mut report = CheckpointReport::new(l.dir.display().to_string(), None, &l.checkpoint, &l.outcome);
        report.settings = l.by.file.as_ref().map(|file| file.display().to_string());
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
    let by: Vec<Rc<Resolved>> = looked.iter().map(|l| Rc::clone(&l.by)).collect();
    baseline::apply_baselines(&mut reports, &by, args.baseline.write_baseline)?;
    let fails =
        |(report, by): (&CheckpointReport, &Rc<Resolved>)| report.counts.worst().is_some_and(|w| w >= by.fail_on);
    let failed = reports.iter().zip(&by).any(fails);
    let code = exit(fixed || failed && !args.report.exit_zero);
    let hidden = reports.iter_mut().zip(&by).map(|(report, by)| report.hide_below(by.min_severity)).sum();
    let report = Report::new(reports, None).with_unchecked(unchecked).with_hidden(hidden);
    output::finish(&report, &args.report, args.statistics, args.quiet)?;
    if args.verbose {
        for l in &looked {
            skipped::print(&l.dir, &l.outcome, &l.by.knowledge.rules);
        }
    }
    Ok(code)
}

/// Checks a checkpoint under its settings.
fn check_by(by: &Resolved) -> impl Fn(&Arc<Checkpoint>) -> Outcome {
    |checkpoint| check_for(checkpoint, &by.knowledge, &by.versions)
}

fn open(dir: &Path, args: &CheckArgs) -> anyhow::Result<Arc<Checkpoint>> {
    let mut checkpoint = Checkpoint::open(dir)?;
    if args.deep {
        checkpoint.read_contents();
    }
    Ok(Arc::new(checkpoint))
}

/// Reads and checks a checkpoint.
fn look(dir: PathBuf, args: &CheckArgs, by: Rc<Resolved>) -> anyhow::Result<Checked> {
    fix::recover(&args.fix, &dir)?;
    let checkpoint = open(&dir, args)?;
    let outcome = check_by(&by)(&checkpoint);
    Ok(Checked { dir, checkpoint, outcome, by, repaired: Default::default() })
}

/// Fails when a rule of the user cannot be used.
fn refuse_unusable(checked: &Checked) -> anyhow::Result<()> {
    let Some(rule) = checked.outcome.unusable.first() else { return Ok(()) };
    let origin = checked.by.knowledge.rules.find(&rule.code)?.origin.as_deref().unwrap_or_default();
    bail!("{origin}: {} on {}: {}", rule.code, checked.dir.display(), rule.why);
}

/// Applies the fixes, if the arguments ask for it.
fn repaired(checked: Checked, args: &CheckArgs) -> anyhow::Result<Checked> {
    if !args.fix.writes() {
        return Ok(checked);
    }
    let Checked { dir, checkpoint, outcome, by, .. } = checked;
    let fix::Repaired { dir, checkpoint, outcome, fixed, withdrawn } =
        fix::repair(&args.fix, dir, &checkpoint, outcome, &|dir| open(dir, args), &check_by(&by))?;
    Ok(Checked { dir, checkpoint, outcome, by, repaired: (fixed, withdrawn) })
}

/// Adds a finding for each suppression that suppressed nothing.
fn report_unused_suppressions(looked: &mut [Checked], settings: &SettingsResolver, searched: &[PathBuf]) {
    for resolved in settings.all() {
        let here: Vec<usize> =
            looked.iter().enumerate().filter(|(_, l)| Rc::ptr_eq(&l.by, resolved)).map(|(at, _)| at).collect();
        let outcomes: Vec<_> =
            here.iter().filter_map(|at| looked.get(*at)).map(|l| (Arc::clone(&l.checkpoint), &l.outcome)).collect();
        let unused = unused_suppressions(&resolved.knowledge, &outcomes, searched);
        for (at, finding) in unused {
            if let Some(looked) = here.get(at).and_then(|at| looked.get_mut(*at)) {
                looked.outcome.findings.push(finding);
            }
        }
    }
}
