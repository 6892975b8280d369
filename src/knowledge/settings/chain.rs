//! A settings file together with the files that it extends.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::SettingsSource;
use super::policy::Policy;
use crate::knowledge::loader::{expanded, parse_program};
use crate::knowledge::pins::read_pins;
use crate::knowledge::rule::{RuleSet, Severity};
use crate::knowledge::selection::{Choice, UnknownRule};
use crate::knowledge::source::DataError;

/// Most files that extend one another; more are a mistake, or an attempt to keep the program busy.
const MAX_FILES: usize = 16;

/// A settings file and the files that it extends, in order of increasing precedence.
#[derive(Debug, Clone, Default)]
pub struct Chain(pub Vec<SettingsSource>);

impl Chain {
    /// Reads a settings file and the files that it extends.
    ///
    /// # Errors
    /// A file that is unreadable or malformed, and a cycle of files that extend each other.
    pub fn load(path: &Path) -> Result<Self, DataError> {
        let mut chain: Vec<SettingsSource> = Vec::new();
        let mut seen = BTreeSet::new();
        let mut next = Some(path.to_owned());
        while let Some(path) = next {
            let source = SettingsSource::read(&path)?;
            if !seen.insert(path.canonicalize().unwrap_or(path)) {
                let circle: Vec<&str> = chain.iter().map(|s| s.name.as_str()).collect();
                let circle = format!("extends itself: {} → {}", circle.join(" → "), source.name);
                return Err(DataError::new(&source.name, circle));
            }
            if chain.len() >= MAX_FILES {
                return Err(DataError::new(
                    &source.name,
                    format!("is extended by {MAX_FILES} files, one after another"),
                ));
            }
            next = source.settings.extend.as_ref().map(|extended| source.dir.join(extended));
            chain.push(source);
        }
        chain.reverse();
        Ok(Self(chain))
    }

    /// The value from the file with the highest precedence that sets it.
    fn last<'s, T>(&'s self, value: impl Fn(&'s SettingsSource) -> Option<T>) -> Option<T> {
        self.0.iter().rev().find_map(value)
    }

    /// Lowest severity that makes the exit code 1.
    #[must_use]
    pub fn fail_on(&self) -> Option<Severity> {
        self.last(|s| s.settings.fail_on)
    }

    /// Lowest severity that is reported.
    #[must_use]
    pub fn min_severity(&self) -> Option<Severity> {
        self.last(|s| s.settings.min_severity)
    }

    /// Folder with the user's rules.
    #[must_use]
    pub fn rules(&self) -> Option<PathBuf> {
        self.last(|s| s.settings.rules.as_ref().map(|rules| s.dir.join(rules)))
    }

    /// Path of the baseline.
    #[must_use]
    pub fn baseline(&self) -> Option<PathBuf> {
        self.last(|s| s.settings.baseline.as_ref().map(|baseline| s.dir.join(baseline)))
    }

    /// Versions to predict the load for.
    ///
    /// # Errors
    /// A text that is neither a requirement such as `transformers==4.47.0` nor `all`, and a file `@FILE` that pins no version.
    pub fn versions(&self) -> Result<Vec<String>, DataError> {
        let Some((source, versions)) = self.last(|s| Some((s, s.settings.versions.as_ref()?))) else {
            return Ok(Vec::new());
        };
        let read = |text: &String| match text.strip_prefix('@') {
            Some(file) => Ok(read_pins(&source.dir.join(file))?.texts()),
            None => {
                parse_program(text).map(|text| vec![text]).map_err(|e| source.wrong(text, format!("for: {text}: {e}")))
            }
        };
        Ok(expanded(versions.iter().map(read).collect::<Result<Vec<_>, _>>()?.concat()))
    }

    /// Selects rules and sets their severities; the command line, `typed`, takes precedence over the files. Returns the
    /// policy for single findings.
    ///
    /// # Errors
    /// An unknown rule, an invalid glob, or a suppression without a reason.
    pub fn govern(&self, rules: &mut RuleSet, typed: Choice) -> Result<Policy, DataError> {
        let mut choices = Vec::new();
        for source in &self.0 {
            let settings = &source.settings;
            let places = settings.per_path.iter().flat_map(|(_, p)| p.ignore.iter().chain(words(&p.severity)));
            let choosing = settings.select.iter().flatten().chain(&settings.extend_select).chain(&settings.ignore);
            let others = words(&settings.severity).chain(settings.suppress.iter().map(|s| &s.rule));
            for word in choosing.chain(others).chain(places) {
                rules.codes(word).map_err(|e| source.wrong(word, e.to_string()))?;
            }
            choices.push(Choice {
                select: settings.select.clone(),
                extend_select: settings.extend_select.clone(),
                ignore: settings.ignore.clone(),
            });
        }
        choices.push(typed);
        let typed = |e: UnknownRule| DataError::new("command line", e.to_string());
        let grades = self.0.iter().flat_map(|s| &s.settings.severity).map(|(word, to)| (word.as_str(), *to));
        rules.regrade(&grades.collect::<Vec<_>>()).map_err(typed)?;
        rules.choose(&choices).map_err(typed)?;
        Policy::from_sources(&self.0, rules)
    }
}

fn words(severity: &[(String, Severity)]) -> impl Iterator<Item = &String> {
    severity.iter().map(|(word, _)| word)
}
