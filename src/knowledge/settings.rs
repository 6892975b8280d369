//! Settings: which rules are asked, how bad their findings are, and what is accepted, as a `ckpt-doctor.json5` says.

mod chain;
mod find;
mod policy;

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::ordered::ordered;
use super::rule::Severity;
use super::source::{self, DataError};
use crate::checkpoint::open::{MODULE_CAP, read_capped};
pub use chain::Chain;
pub use find::{FILE, Nearest, absolute, nearest};
pub use policy::{Policy, Suppression};

/// A settings file. Paths in it start at its own folder.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// A settings file that this one builds on, and may overrule.
    #[serde(default)]
    pub extend: Option<PathBuf>,
    /// Only these rules: codes, starts of codes, or names.
    #[serde(default)]
    pub select: Option<Vec<String>>,
    /// These rules as well: what `select` leaves out, here or in the file this one extends.
    #[serde(default, rename = "extend-select")]
    pub extend_select: Vec<String>,
    /// All but these rules; where two words name a rule, the longer one wins.
    #[serde(default)]
    pub ignore: Vec<String>,
    /// Severities that rules have here: `{ "JSN001": "error" }`.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Severity>"))]
    pub severity: Vec<(String, Severity)>,
    /// What is different in some places, by a glob from this file's folder: a folder means all that is in it, `*` stays
    /// within a name, `**` does not.
    #[serde(default, rename = "per-path", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, PerPath>"))]
    pub per_path: Vec<(String, PerPath)>,
    /// Findings that are accepted, each with the reason.
    #[serde(default)]
    pub suppress: Vec<Suppress>,
    /// Least severity that makes the exit code 1.
    #[serde(default, rename = "fail-on")]
    pub fail_on: Option<Severity>,
    /// Versions to predict the load for: `["transformers==4.47.0"]`.
    #[serde(default, rename = "for")]
    pub versions: Option<Vec<String>>,
    /// A folder with rules (`checks/`) and architectures (`architectures/`) of your own.
    #[serde(default)]
    pub rules: Option<PathBuf>,
    /// A baseline, written by `--write-baseline`: findings in it are not counted.
    #[serde(default)]
    pub baseline: Option<PathBuf>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    pub schema: Option<String>,
}

/// What is different in a place.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PerPath {
    /// Rules that are silent there.
    #[serde(default)]
    pub ignore: Vec<String>,
    /// Severities that rules have there.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Severity>"))]
    pub severity: Vec<(String, Severity)>,
}

/// A finding that is accepted.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Suppress {
    /// The rule: a code, the start of one, or a name.
    pub rule: String,
    /// Where: a glob, as in `per-path`, of the checkpoint or of a file in it; everywhere when absent.
    #[serde(default)]
    pub path: Option<String>,
    /// Why this is accepted. A suppression says so, or the file is refused.
    pub reason: String,
}

/// A settings file that was read.
#[derive(Debug, Clone)]
pub struct SettingsSource {
    /// As messages name it.
    pub name: String,
    /// Its folder, absolute.
    pub dir: PathBuf,
    /// What it says.
    pub settings: Settings,
    text: String,
}

impl SettingsSource {
    /// Settings from their text, as if it were a file in `dir`; `name` is for messages.
    ///
    /// # Errors
    /// Says what is wrong with `text`, and where.
    pub fn parse(name: &str, dir: &Path, text: &str) -> Result<Self, DataError> {
        let settings = source::parse(name, text)?;
        Ok(Self { name: name.to_owned(), dir: absolute(dir), settings, text: text.to_owned() })
    }

    pub(super) fn read(path: &Path) -> Result<Self, DataError> {
        let name = path.display().to_string();
        let bytes = read_capped(path, MODULE_CAP).map_err(|e| DataError::new(&name, e.to_string()))?;
        let text = String::from_utf8(bytes).map_err(|_| DataError::new(&name, "not UTF-8"))?;
        Self::parse(&name, absolute(path).parent().unwrap_or(path), &text)
    }

    /// An error about a word of this file.
    pub(super) fn wrong(&self, word: &str, reason: String) -> DataError {
        DataError::about(&self.name, &self.text, word, reason)
    }
}
