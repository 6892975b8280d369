//! Settings from `ckpt-doctor.json5`: selected rules, severities and suppressions.

mod chain;
mod find;
mod policy;

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::ordered::ordered;
use super::rule::Severity;
use super::source::{self, DataError};
use crate::checkpoint::open::{MODULE_CAP, read_capped};
use crate::checkpoint::platform::shown;
pub use chain::Chain;
pub use find::{FILE, Surroundings, absolute};
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
    /// Lowest severity that is reported; findings below it still count for `fail-on`.
    #[serde(default, rename = "min-severity")]
    pub min_severity: Option<Severity>,
    /// Whether weights may be missing, for copies of the documents alone; such a directory has no predicted load.
    #[serde(default, rename = "metadata-only")]
    pub metadata_only: Option<bool>,
    /// Versions of transformers to predict the load for: `["transformers==4.47.0"]`, or `["@uv.lock"]` for those that a file pins.
    #[serde(default, rename = "for")]
    pub versions: Option<Vec<String>>,
    /// Folder with additional rules (`checks/`) and architectures (`architectures/`).
    #[serde(default)]
    pub rules: Option<PathBuf>,
    /// Baseline from `--write-baseline`; its findings are not counted.
    #[serde(default)]
    pub baseline: Option<PathBuf>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    pub schema: Option<String>,
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

/// A parsed settings file.
#[derive(Debug, Clone)]
pub struct SettingsSource {
    /// The name used in messages.
    pub name: String,
    /// Folder of the file, absolute.
    pub dir: PathBuf,
    /// The parsed settings.
    pub settings: Settings,
    text: String,
}

impl SettingsSource {
    /// Parses settings from text, as a file in `dir`; `name` is used in messages.
    ///
    /// # Errors
    /// [`DataError`] with the position in `text`.
    pub fn parse(name: &str, dir: &Path, text: &str) -> Result<Self, DataError> {
        let settings = source::parse(name, text)?;
        Ok(Self { name: name.to_owned(), dir: absolute(dir), settings, text: text.to_owned() })
    }

    pub(super) fn read(path: &Path) -> Result<Self, DataError> {
        let name = shown(path);
        let bytes = read_capped(path, MODULE_CAP).map_err(|e| DataError::new(&name, e.to_string()))?;
        let text = String::from_utf8(bytes).map_err(|_| DataError::new(&name, "not UTF-8"))?;
        Self::parse(&name, absolute(path).parent().unwrap_or(path), &text)
    }

    /// An error about the value `word` in this file.
    pub(super) fn wrong(&self, word: &str, reason: String) -> DataError {
        DataError::about(&self.name, &self.text, word, reason)
    }
}
