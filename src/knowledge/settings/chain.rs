//! A settings file together with those it extends.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::SettingsSource;
use super::policy::Policy;
use crate::knowledge::loader::asked;
use crate::knowledge::rule::{RuleSet, Severity};
use crate::knowledge::selection::{Choice, UnknownRule};
use crate::knowledge::source::DataError;

/// A settings file and those it extends; the one that has the last word comes last.
#[derive(Debug, Clone, Default)]
pub struct Chain(pub Vec<SettingsSource>);

impl Chain {
    /// Reads a settings file and what it extends.
    ///
    /// # Errors
    /// A file that cannot be read or is no settings file, and files that extend one another in a circle.
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
            next = source.settings.extend.as_ref().map(|extended| source.dir.join(extended));
            chain.push(source);
        }
        chain.reverse();
        Ok(Self(chain))
    }

    /// What the file with the last word says, of those that say anything.
    fn last<'s, T>(&'s self, of: impl Fn(&'s SettingsSource) -> Option<T>) -> Option<T> {
        self.0.iter().rev().find_map(of)
    }

    /// Least severity that fails.
    #[must_use]
    pub fn fail_on(&self) -> Option<Severity> {
        self.last(|s| s.settings.fail_on)
    }

    /// Folder of the user's own rules.
    #[must_use]
    pub fn rules(&self) -> Option<PathBuf> {
        self.last(|s| s.settings.rules.as_ref().map(|rules| s.dir.join(rules)))
    }

    /// The baseline.
    #[must_use]
    pub fn baseline(&self) -> Option<PathBuf> {
        self.last(|s| s.settings.baseline.as_ref().map(|baseline| s.dir.join(baseline)))
    }

    /// Versions to predict the load for.
    ///
    /// # Errors
    /// A word that is no version of transformers.
    pub fn versions(&self) -> Result<Vec<String>, DataError> {
        let Some((source, versions)) = self.last(|s| Some((s, s.settings.versions.as_ref()?))) else {
            return Ok(Vec::new());
        };
        let read = |text: &String| asked(text).map_err(|e| source.wrong(text, format!("for: {text}: {e}")));
        versions.iter().map(read).collect()
    }

    /// Chooses and grades the rules, `typed` having the last word, and says what becomes of single findings.
    ///
    /// # Errors
    /// A word that names no rule, a glob that is none, a suppression without a reason.
    pub fn govern(&self, rules: &mut RuleSet, typed: Choice) -> Result<Policy, DataError> {
        let mut choices = Vec::new();
        for source in &self.0 {
            let said = &source.settings;
            let places = said.per_path.iter().flat_map(|(_, p)| p.ignore.iter().chain(words(&p.severity)));
            let choosing = said.select.iter().flatten().chain(&said.extend_select).chain(&said.ignore);
            let others = words(&said.severity).chain(said.suppress.iter().map(|s| &s.rule));
            for word in choosing.chain(others).chain(places) {
                rules.codes(word).map_err(|e| source.wrong(word, e.to_string()))?;
            }
            choices.push(Choice {
                select: said.select.clone(),
                extend_select: said.extend_select.clone(),
                ignore: said.ignore.clone(),
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
