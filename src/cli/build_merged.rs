//! `build-merged`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use clap::CommandFactory as _;

use super::args::{BuildMergedArgs, Cli, SeverityName};
use super::exit::{CLEAN, FAILED, FINDINGS};
use super::progress::Meter;
use super::{library, output, pins, signals};
use crate::check::Severity;
use crate::knowledge::Knowledge;
use crate::knowledge::loader::expanded;
use crate::knowledge::rule::RuleSet;
use crate::merge::{self, MergeRequest, MergeRun, ResolvedMergeFile};
use crate::report::json;
use crate::report::model::{MergeStage, Role};
use crate::report::{Format, recipes};

/// Runs `build-merged`.
pub fn run(args: &BuildMergedArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let knowledge = library::knowledge(RuleSet::embedded()?, rules)?;
    if args.help || args.print_recipe {
        output::print(&about(args, &knowledge)?)?;
        return Ok(CLEAN);
    }
    let request = request(args, &knowledge)?;
    signals::install()?;
    let meter = Meter::new("writing");
    let run = merge::run(&request, &knowledge, &|done, total| meter.reach(done, total))?;
    drop(meter);
    run.notices.iter().for_each(|notice| output::note(&output::safe(notice)));
    let stage = run.record.stage;
    if let (Some(file), Some(plan)) = (&args.how.plan, &run.plan) {
        output::write(file, &json::pretty(plan)).with_context(|| format!("writing {}", file.display()))?;
    }
    let report = if args.how.report.has(Format::Html) { run.report_with_maps() } else { run.report() };
    let report = report.with_terms(&knowledge, (!args.how.report.exit_zero).then_some(least(args)));
    output::finish(&report, &args.how.report, false, false).with_context(|| match stage {
        Some(MergeStage::Written) => format!("{} is written, but the report could not be", run.record.out),
        _ => "the report could not be written".to_owned(),
    })?;
    // Only the result counts: errors of a donor that the merge repaired are reported, but do not fail the run.
    Ok(match stage {
        Some(MergeStage::Written | MergeStage::DryRun) if args.how.report.exit_zero || !result_fails(&run, args) => {
            CLEAN
        }
        Some(MergeStage::Written | MergeStage::DryRun) => FINDINGS,
        _ => FAILED,
    })
}

/// The text of the recipe, its page, or without a recipe the help of the command.
fn about(args: &BuildMergedArgs, knowledge: &Knowledge) -> anyhow::Result<String> {
    let mut wanted = ResolvedMergeFile::default();
    wanted.recipe.clone_from(&args.recipe);
    let Some(recipe) = wanted.find_recipe(knowledge)? else {
        let mut cli = Cli::command();
        cli.build();
        let help = cli.find_subcommand_mut("build-merged").map(clap::Command::render_help);
        return Ok(help.map(|help| help.to_string()).unwrap_or_default());
    };
    if args.print_recipe {
        return Ok(recipe.origin.text.into_owned());
    }
    Ok(format!(
        "{}
Other options
  `ckpt-doctor build-merged --help` prints them\n",
        recipes::page(&recipe)
    ))
}

/// The lowest severity of a finding of the result that fails the run.
fn least(args: &BuildMergedArgs) -> Severity {
    args.how.report.fail_on.map_or(Severity::Error, SeverityName::severity)
}

fn result_fails(run: &MergeRun, args: &BuildMergedArgs) -> bool {
    let least = least(args);
    let result = run.checked.iter().rfind(|c| !matches!(c.role, Role::Donor(_)));
    result.is_some_and(|c| c.outcome.findings.iter().any(|f| f.severity >= least))
}

fn request(args: &BuildMergedArgs, knowledge: &Knowledge) -> anyhow::Result<MergeRequest> {
    let file = args.file.as_deref().map(ResolvedMergeFile::read).transpose()?;
    let out = args.out.clone().or_else(|| file.as_ref().map(|f| f.out.clone()));
    let mut file = file.unwrap_or_default();
    file.recipe = args.recipe.clone().or(file.recipe);
    let recipe = file.find_recipe(knowledge)?;
    let ResolvedMergeFile { mut donors, mut options, .. } = file;
    let short = [("vision", &args.vision), ("language", &args.language)];
    let typed = args.donor.iter().map(|(role, dir)| (role.clone(), PathBuf::from(dir)));
    for (role, dir) in typed.chain(short.into_iter().filter_map(|(r, d)| Some((r.to_owned(), d.clone()?)))) {
        if donors.insert(role.clone(), dir).is_some() {
            bail!("donor {role} is given more than once");
        }
    }
    if donors.is_empty() {
        bail!("no donors given; pass --vision DIR and --language DIR, or a merge file");
    }
    // Options of the command line override those of the file; duplicate options on the command line are errors.
    let mut typed = BTreeMap::new();
    for (name, value) in &args.how.set {
        if typed.insert(name.clone(), value.clone()).is_some() {
            bail!("option {name} is given more than once");
        }
    }
    options.extend(typed);
    let out = out.context("no output directory given; pass --out DIR")?;
    let versions = expanded(pins::transformers(&args.how.versions)?);
    let hash = args.how.hash.algorithm();
    let (dry_run, hash_donors) = (args.how.dry_run, args.how.hash_donors);
    let tolerate = args.how.tolerate.clone();
    Ok(MergeRequest { recipe, donors, options, versions, tolerate, out, dry_run, hash, hash_donors })
}
