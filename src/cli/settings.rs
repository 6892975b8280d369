//! Combines the command line and the settings file into the options of a run.

use std::path::{Path, PathBuf};

use super::args::{CheckArgs, SettingsArgs};
use super::{library, output};
use crate::check::Severity;
use crate::check::options::RunOptions;
use crate::checkpoint::platform::{here, shown};
use crate::knowledge::Knowledge;
use crate::knowledge::loader::expanded;
use crate::knowledge::selection::Choice;
use crate::knowledge::settings::{Chain, Surroundings};

/// Resolved options of a run.
pub struct Resolved {
    /// The settings file, if any.
    pub file: Option<PathBuf>,
    /// The selected rules, architectures and tables.
    pub knowledge: Knowledge,
    /// Versions to predict the load for, and the policy of the settings file.
    pub options: RunOptions,
    /// Lowest severity that fails.
    pub fail_on: Severity,
    /// Lowest severity that is reported.
    pub min_severity: Severity,
    /// The baseline.
    pub baseline: Option<PathBuf>,
}

/// Options of the command line. They override the settings file.
#[derive(Default)]
pub struct Typed {
    config: Option<PathBuf>,
    isolated: bool,
    rules: Option<PathBuf>,
    choice: Choice,
    versions: Vec<String>,
    fail_on: Option<Severity>,
    min_severity: Option<Severity>,
    metadata_only: bool,
    baseline: Option<PathBuf>,
}

impl Typed {
    /// The options that all commands with settings share.
    pub fn new(settings: &SettingsArgs, rules: Option<&Path>) -> Self {
        Self {
            config: settings.config.clone(),
            isolated: settings.isolated,
            rules: rules.map(Path::to_owned),
            ..Self::default()
        }
    }

    /// The options of `check`.
    pub fn check(args: &CheckArgs, rules: Option<&Path>) -> Self {
        Self {
            choice: Choice {
                select: (!args.select.is_empty()).then(|| args.select.clone()),
                extend_select: args.extend_select.clone(),
                ignore: args.ignore.clone(),
            },
            versions: args.versions.clone(),
            fail_on: args.report.fail_on.map(super::args::SeverityName::severity),
            min_severity: args.min_severity.map(super::args::SeverityName::severity),
            metadata_only: args.metadata_only,
            baseline: args.baseline.baseline.clone(),
            ..Self::new(&args.settings, rules)
        }
    }
}

/// The options of a run on these directories, from the settings file that may decide and the command line.
///
/// # Errors
/// A settings file, rule, architecture or recipe that cannot be read.
pub fn resolve(typed: &Typed, surroundings: &Surroundings) -> anyhow::Result<Resolved> {
    let file = if typed.isolated {
        None
    } else if let Some(config) = &typed.config {
        Some(config.clone())
    } else {
        let found = surroundings.nearest();
        for (ignored, why) in &found.ignored {
            let file = output::safe(&shortened(ignored));
            output::note(&format!("note: {file} {} and is ignored; pass --config {file} to use it", why.reason()));
        }
        found.file
    };
    typed.read(file)
}

/// The path from the working directory, if it is below it.
fn shortened(path: &Path) -> String {
    let below = here().and_then(|here| path.strip_prefix(here).ok().map(Path::to_owned));
    shown(below.as_deref().unwrap_or(path))
}

impl Typed {
    fn read(&self, file: Option<PathBuf>) -> anyhow::Result<Resolved> {
        let chain = file.as_deref().map(Chain::load).transpose()?.unwrap_or_default();
        let folder = self.rules.clone().or_else(|| chain.rules());
        let mut rules = library::rules(folder.as_deref())?;
        let mut policy = chain.govern(&mut rules, self.choice.clone())?;
        policy.metadata_only |= self.metadata_only;
        let versions = if self.versions.is_empty() { chain.versions()? } else { expanded(self.versions.clone()) };
        Ok(Resolved {
            knowledge: library::knowledge(rules, folder.as_deref())?,
            options: RunOptions { versions, policy, ..RunOptions::default() },
            fail_on: self.fail_on.or_else(|| chain.fail_on()).unwrap_or(Severity::Error),
            min_severity: self.min_severity.or_else(|| chain.min_severity()).unwrap_or(Severity::Info),
            baseline: self.baseline.clone().or_else(|| chain.baseline()),
            file,
        })
    }
}
