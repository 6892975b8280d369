//! Settings: which rules are asked, how bad their findings are, and what is accepted, as a `ckpt-doctor.json5` says.

mod find;
mod policy;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::loader::asked;
use super::ordered::ordered;
use super::rule::{RuleSet, Severity};
use super::selection::Choice;
use super::source::{self, DataError};
use crate::checkpoint::open::{MODULE_CAP, read_capped};
pub use find::{FILE, Nearest, absolute, nearest};
pub use policy::{Policy, Suppression};

/// A settings file. Paths in it are relative to its folder.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Settings file that this one extends; the values here take precedence.
    #[serde(default)]
    pub extend: Option<PathBuf>,
    /// Rules to run, all others are off: codes, starts of codes, or names.
    #[serde(default)]
    pub select: Option<Vec<String>>,
    /// Rules to run in addition to `select`, here or in the extended file.
    #[serde(default, rename = "extend-select")]
    pub extend_select: Vec<String>,
    /// Rules to skip; if two selectors match a rule, the longer one takes precedence.
    #[serde(default)]
    pub ignore: Vec<String>,
    /// Other severities for rules: `{ "JSN001": "error" }`.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Severity>"))]
    pub severity: Vec<(String, Severity)>,
    /// Other settings for some paths, by a glob relative to the folder of this file: a folder matches everything in it, `*`
    /// matches within a name, `**` across folders.
    #[serde(default, rename = "per-path", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, PerPath>"))]
    pub per_path: Vec<(String, PerPath)>,
    /// Suppressed findings, each with a reason.
    #[serde(default)]
    pub suppress: Vec<Suppress>,
    /// Lowest severity that makes the exit code 1.
    #[serde(default, rename = "fail-on")]
    pub fail_on: Option<Severity>,
    /// Versions of transformers to predict the load for: `["transformers==4.47.0"]`.
    #[serde(default, rename = "for")]
    pub versions: Option<Vec<String>>,
    /// Folder with additional rules (`checks/`) and architectures (`architectures/`).
    #[serde(default)]
    pub rules: Option<PathBuf>,
    /// Baseline from `--write-baseline`; its findings are not counted.
    #[serde(default)]
    pub baseline: Option<PathBuf>,
}

/// Settings for some paths.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PerPath {
    /// Rules to skip.
    #[serde(default)]
    pub ignore: Vec<String>,
    /// Other severities for rules.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Severity>"))]
    pub severity: Vec<(String, Severity)>,
}

/// A suppression.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Suppress {
    /// Rule: a code, the start of a code, or a name.
    pub rule: String,
    /// Path of the checkpoint or of a file in it, as a glob like those of `per-path`; everywhere when missing.
    #[serde(default)]
    pub path: Option<String>,
    /// Reason for the suppression; a settings file without it is rejected.
    pub reason: String,
}

/// A settings file that was read.
#[derive(Debug, Clone)]
pub struct Source {
    /// As messages name it.
    pub name: String,
    /// Its folder, absolute.
    pub dir: PathBuf,
    /// What it says.
    pub settings: Settings,
    text: String,
}

/// A settings file and those it extends; the one that has the last word comes last.
#[derive(Debug, Clone, Default)]
pub struct Chain(pub Vec<Source>);

impl Chain {
    /// Reads a settings file and what it extends.
    ///
    /// # Errors
    /// A file that cannot be read or is no settings file, and files that extend one another in a circle.
    pub fn load(path: &Path) -> Result<Self, DataError> {
        let mut chain: Vec<Source> = Vec::new();
        let mut seen = BTreeSet::new();
        let mut next = Some(path.to_owned());
        while let Some(path) = next {
            let source = Source::read(&path)?;
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
    fn last<'s, T>(&'s self, of: impl Fn(&'s Source) -> Option<T>) -> Option<T> {
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
        let typed = |e: super::selection::UnknownRule| DataError::new("command line", e.to_string());
        let grades = self.0.iter().flat_map(|s| &s.settings.severity).map(|(word, to)| (word.as_str(), *to));
        rules.regrade(&grades.collect::<Vec<_>>()).map_err(typed)?;
        rules.choose(&choices).map_err(typed)?;
        Policy::of(&self.0, rules)
    }
}

fn words(severity: &[(String, Severity)]) -> impl Iterator<Item = &String> {
    severity.iter().map(|(word, _)| word)
}

impl Source {
    /// Settings from their text, as if it were a file in `dir`; `name` is for messages.
    ///
    /// # Errors
    /// Says what is wrong with `text`, and where.
    pub fn parse(name: &str, dir: &Path, text: &str) -> Result<Self, DataError> {
        let settings = source::parse(name, text)?;
        Ok(Self { name: name.to_owned(), dir: absolute(dir), settings, text: text.to_owned() })
    }

    fn read(path: &Path) -> Result<Self, DataError> {
        let name = path.display().to_string();
        let bytes = read_capped(path, MODULE_CAP).map_err(|e| DataError::new(&name, e.to_string()))?;
        let text = String::from_utf8(bytes).map_err(|_| DataError::new(&name, "not UTF-8"))?;
        Self::parse(&name, absolute(path).parent().unwrap_or(path), &text)
    }

    /// An error about a word of this file.
    fn wrong(&self, word: &str, reason: String) -> DataError {
        DataError::about(&self.name, &self.text, word, reason)
    }
}
