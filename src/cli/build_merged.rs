//! `build-merged`.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::path::{Component, Path, PathBuf};

use anyhow::{Context, bail};
use ckpt_doctor::check::Severity;
use ckpt_doctor::checkpoint::open::{JSON_CAP, read_capped};
use ckpt_doctor::knowledge::recipe::{MergeFile, Recipe};
use ckpt_doctor::knowledge::rule::RuleSet;
use ckpt_doctor::knowledge::{Knowledge, source};
use ckpt_doctor::merge::{self, MergeRequest, MergeRun};
use ckpt_doctor::report::model::{MergeStage, Role};

use super::args::{BuildMergedArgs, FailOn};
use super::exit::{CLEAN, FINDINGS};
use super::{library, output, signals};

/// Runs `build-merged`.
pub fn run(args: &BuildMergedArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let knowledge = Knowledge::with(RuleSet::embedded()?, library::with(rules)?)?;
    let request = request(args, &knowledge.recipes)?;
    signals::install()?;
    let terminal = std::io::stderr().is_terminal();
    let mut last = 0;
    let mut progress = |done: u64, total: u64| {
        let percent = done.saturating_mul(100).checked_div(total).unwrap_or(100);
        if terminal && percent > last {
            last = percent;
            output::progress(percent);
        }
    };
    let run = merge::run(&request, &knowledge, &mut progress)?;
    let stage = run.record.stage;
    output::finish(&run.report(), &args.report, false).with_context(|| match stage {
        Some(MergeStage::Written) => format!("{} is written, but the report could not be", run.record.out),
        _ => "the report could not be written".to_owned(),
    })?;
    // What matters is the result; findings on a donor that the merge repaired are told, not counted.
    Ok(match stage {
        Some(MergeStage::Written | MergeStage::DryRun) if args.report.exit_zero || !result_fails(&run, args) => CLEAN,
        _ => FINDINGS,
    })
}

fn result_fails(run: &MergeRun, args: &BuildMergedArgs) -> bool {
    let least = args.report.fail_on.map_or(Severity::Error, FailOn::severity);
    let result = run.checked.iter().rfind(|c| !matches!(c.role, Role::Donor(_)));
    result.is_some_and(|c| c.outcome.findings.iter().any(|f| f.severity >= least))
}

fn request(args: &BuildMergedArgs, recipes: &[Recipe]) -> anyhow::Result<MergeRequest> {
    let mut options: BTreeMap<String, String> = BTreeMap::new();
    let mut donors: BTreeMap<String, PathBuf> = BTreeMap::new();
    let (mut recipe, mut out, mut base) = (args.recipe.clone(), args.out.clone(), PathBuf::new());
    if let Some(path) = &args.file {
        let file: MergeFile = source::parse(&path.display().to_string(), &text(path)?)?;
        path.parent().unwrap_or(Path::new("")).clone_into(&mut base);
        recipe = file.recipe;
        for (role, dir) in &file.donors {
            let dir =
                dir.as_str().with_context(|| format!("{}: donor {role}: the value must be a path", path.display()))?;
            donors.insert(role.clone(), tidy(base.join(dir)));
        }
        for (name, value) in &file.options {
            let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            options.insert(name.clone(), value);
        }
        out = out.or_else(|| Some(tidy(base.join(file.out))));
    }
    let short = [("vision", &args.vision), ("language", &args.language)];
    let typed = args.donor.iter().map(|(role, dir)| (role.clone(), PathBuf::from(dir)));
    for (role, dir) in typed.chain(short.into_iter().filter_map(|(r, d)| Some((r.to_owned(), d.clone()?)))) {
        if donors.insert(role.clone(), dir).is_some() {
            bail!("donor {role} is given twice");
        }
    }
    if donors.is_empty() {
        bail!("no donors given; pass --vision DIR and --language DIR, or a merge file");
    }
    // The command line has the last word over the file, but not over itself.
    let mut typed = BTreeMap::new();
    for (name, value) in &args.set {
        if typed.insert(name.clone(), value.clone()).is_some() {
            bail!("option {name} is given twice");
        }
    }
    options.extend(typed);
    let recipe = recipe.map(|name| find_recipe(recipes, &name, &base)).transpose()?;
    let out = out.context("no output directory given; pass --out DIR")?;
    Ok(MergeRequest { recipe, donors, options, out, dry_run: args.dry_run, hash: args.hash })
}

/// `fixtures/../merged` as `merged`, unless a symbolic link makes the two different places.
fn tidy(path: PathBuf) -> PathBuf {
    let mut short = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir if matches!(short.components().next_back(), Some(Component::Normal(_))) => {
                short.pop();
            }
            Component::CurDir => {}
            other => short.push(other),
        }
    }
    // The last component may be missing: it is the output directory.
    let parent = |path: &Path| {
        let parent = path.parent()?;
        if parent.as_os_str().is_empty() { Path::new(".") } else { parent }.canonicalize().ok()
    };
    match (parent(&path), parent(&short)) {
        (Some(long), Some(other)) if long == other && path.file_name() == short.file_name() => short,
        _ => path,
    }
}

/// A recipe by name, or from a file.
fn find_recipe(recipes: &[Recipe], name: &str, base: &Path) -> anyhow::Result<Recipe> {
    if let Some(recipe) = recipes.iter().find(|r| r.recipe == name) {
        return Ok(recipe.clone());
    }
    let path = base.join(name);
    if path.extension().is_some_and(|e| e == "json5" || e == "json") {
        return Ok(Recipe::parse(&path.display().to_string(), &text(&path)?)?);
    }
    let names: Vec<&str> = recipes.iter().map(|r| r.recipe.as_str()).collect();
    bail!("{name}: unknown recipe; pass one of {}, or the path of a .json5 file", names.join(", "));
}

fn text(path: &Path) -> anyhow::Result<String> {
    let bytes = read_capped(path, JSON_CAP).with_context(|| path.display().to_string())?;
    String::from_utf8(bytes).with_context(|| format!("{}: not UTF-8", path.display()))
}
