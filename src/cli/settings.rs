//! Combines the command line and settings files into the options of each checkpoint.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::args::{CheckArgs, SettingsArgs};
use super::{library, output};
use crate::check::Severity;
use crate::knowledge::Knowledge;
use crate::knowledge::loader::expanded;
use crate::knowledge::selection::Choice;
use crate::knowledge::settings::{Chain, nearest};

/// Resolved options for the checkpoints under one settings file.
pub struct Resolved {
    /// The settings file, if any.
    pub file: Option<PathBuf>,
    /// Rules, architectures and policy of the checks.
    pub knowledge: Knowledge,
    /// Versions to predict the load for.
    pub versions: Vec<String>,
    /// Lowest severity that fails.
    pub fail_on: Severity,
    /// Lowest severity that is reported.
    pub min_severity: Severity,
    /// The baseline.
    pub baseline: Option<PathBuf>,
}

/// Options of the command line. They override every settings file.
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

/// Finds the settings of checkpoints, and reads each file once.
pub struct SettingsResolver {
    typed: Typed,
    resolved: BTreeMap<Option<PathBuf>, Rc<Resolved>>,
    reported: BTreeSet<PathBuf>,
}

impl SettingsResolver {
    pub fn new(typed: Typed) -> Self {
        Self { typed, resolved: BTreeMap::new(), reported: BTreeSet::new() }
    }

    /// The options for the checkpoint in this directory.
    pub fn resolve(&mut self, checkpoint: &Path) -> anyhow::Result<Rc<Resolved>> {
        let file = if self.typed.isolated {
            None
        } else if let Some(config) = &self.typed.config {
            Some(config.clone())
        } else {
            let found = nearest(checkpoint);
            if let Some(ignored) = found.ignored
                && self.reported.insert(ignored.clone())
            {
                let file = output::safe(&ignored.display().to_string());
                output::note(&format!(
                    "note: {file} is inside a checkpoint and is ignored; pass --config {file} to use it"
                ));
            }
            found.file
        };
        if let Some(resolved) = self.resolved.get(&file) {
            return Ok(Rc::clone(resolved));
        }
        let resolved = Rc::new(self.read(file.clone())?);
        self.resolved.insert(file, Rc::clone(&resolved));
        Ok(resolved)
    }

    /// The options of every settings file found so far.
    pub fn all(&self) -> impl Iterator<Item = &Rc<Resolved>> {
        self.resolved.values()
    }

    fn read(&self, file: Option<PathBuf>) -> anyhow::Result<Resolved> {
        let typed = &self.typed;
        let chain = file.as_deref().map(Chain::load).transpose()?.unwrap_or_default();
        let folder = typed.rules.clone().or_else(|| chain.rules());
        let mut rules = library::rules(folder.as_deref())?;
        let mut policy = chain.govern(&mut rules, typed.choice.clone())?;
        policy.metadata_only |= typed.metadata_only;
        let library = library::with(folder.as_deref())?;
        let versions = if typed.versions.is_empty() { chain.versions()? } else { expanded(typed.versions.clone()) };
        Ok(Resolved {
            knowledge: Knowledge { policy, ..Knowledge::with(rules, library)? },
            versions,
            fail_on: typed.fail_on.or_else(|| chain.fail_on()).unwrap_or(Severity::Error),
            min_severity: typed.min_severity.or_else(|| chain.min_severity()).unwrap_or(Severity::Info),
            baseline: typed.baseline.clone().or_else(|| chain.baseline()),
            file,
        })
    }
}
