//! `check`.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::Arc;

use anyhow::{Context, bail};

use super::args::CheckArgs;
use super::exit::{CLEAN, FINDINGS};
use super::settings::{Resolved, SettingsResolver, Typed};
use super::{baseline, fix, output, signals, skipped};
use crate::check::{Outcome, check_for, unused_suppressions};
use crate::checkpoint::{Checkpoint, find_checkpoints, owner};
use crate::report::model::{CheckpointReport, Fixed, Fixing, Withdrawn};
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
    let mut seen = BTreeSet::new();
    let mut dirs = Vec::new();
    for path in &args.paths {
        for dir in directories(path)? {
            // pre-commit passes several files of one checkpoint; it is checked once.
            if !seen.insert(dir.canonicalize().unwrap_or_else(|_| dir.clone())) {
                continue;
            }
            dirs.push(dir);
        }
    }
    args.fix.refuse(dirs.len())?;
    if args.fix.writes() {
        signals::install()?;
    }
    let mut looked = dirs.into_iter().map(|dir| look(dir, args, &mut settings)).collect::<anyhow::Result<Vec<_>>>()?;
    if args.fix.diff {
        let changes = looked.iter().map(|l| fix::show(&args.fix, &l.dir, &l.checkpoint, &l.outcome, &check_by(&l.by)));
        let changes = changes.sum::<anyhow::Result<usize>>()?;
        return Ok(if changes > 0 { FINDINGS } else { CLEAN });
    }
    report_unused_suppressions(&mut looked, &settings, &args.paths);
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
        return Ok(if fixed { FINDINGS } else { CLEAN });
    }
    let by: Vec<Rc<Resolved>> = looked.iter().map(|l| Rc::clone(&l.by)).collect();
    baseline::apply_baselines(&mut reports, &by, args.baseline.write_baseline)?;
    let fails =
        |(report, by): (&CheckpointReport, &Rc<Resolved>)| report.counts.worst().is_some_and(|w| w >= by.fail_on);
    let failed = reports.iter().zip(&by).any(fails);
    output::finish(&Report::new(reports, None), &args.report, args.statistics)?;
    if args.verbose {
        for l in &looked {
            skipped::print(&l.dir, &l.outcome, &l.by.knowledge.rules);
        }
    }
    Ok(if fixed || failed && !args.report.exit_zero { FINDINGS } else { CLEAN })
}

/// The checkpoints for a path. A file may belong to no checkpoint: pre-commit passes all files of a commit. A deleted
/// file stands for the checkpoint that contained it.
fn directories(path: &Path) -> anyhow::Result<Vec<PathBuf>> {
    if !path.exists() {
        let Some(owner) = owner(path) else { bail!("{}: no such file or directory", path.display()) };
        return Ok(vec![owner]);
    }
    let found = find_checkpoints(path);
    if found.is_empty() && path.is_dir() {
        bail!("{}: no checkpoint found (no config.json, adapter_config.json, index or *.safetensors)", path.display());
    }
    Ok(found)
}

/// Checks a checkpoint under its settings.
fn check_by(by: &Resolved) -> impl Fn(&Arc<Checkpoint>) -> Outcome {
    |checkpoint| check_for(checkpoint, &by.knowledge, &by.versions)
}

fn look(dir: PathBuf, args: &CheckArgs, settings: &mut SettingsResolver) -> anyhow::Result<Checked> {
    let by = settings.resolve(&dir)?;
    let open = |dir: &Path| {
        let mut checkpoint = Checkpoint::open(dir).with_context(|| dir.display().to_string())?;
        if args.deep {
            checkpoint.read_contents();
        }
        Ok(Arc::new(checkpoint))
    };
    fix::recover(&args.fix, &dir)?;
    let checkpoint = open(&dir)?;
    let outcome = check_by(&by)(&checkpoint);
    if let Some(rule) = outcome.unusable.first() {
        let origin = by.knowledge.rules.find(&rule.code)?.origin.as_deref().unwrap_or_default();
        bail!("{origin}: {} on {}: {}", rule.code, dir.display(), rule.why);
    }
    if !args.fix.writes() {
        return Ok(Checked { dir, checkpoint, outcome, by, repaired: Default::default() });
    }
    let fix::Repaired { dir, checkpoint, outcome, fixed, withdrawn } =
        fix::repair(&args.fix, dir, &checkpoint, outcome, &open, &check_by(&by))?;
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
