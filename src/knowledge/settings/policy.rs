//! Effect of settings on single findings: severities by path, rules ignored by path, and suppressions.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use globset::GlobSet;

use super::SettingsSource;
use super::find::absolute;
use crate::checkpoint::{escape, glob};
use crate::knowledge::rule::{RuleSet, Severity};
use crate::knowledge::source::DataError;

/// Severities and suppressions of findings, by rule and place.
#[derive(Debug, Clone, Default)]
pub struct Policy {
    places: Vec<AreaSettings>,
    /// Suppressions, in file order.
    pub suppressions: Vec<Suppression>,
    /// Whether weights may be missing, for copies of the documents alone.
    pub metadata_only: bool,
}

/// Severities and ignored rules for some paths.
#[derive(Debug, Clone)]
struct AreaSettings {
    area: Area,
    ignore: BTreeSet<String>,
    severity: BTreeMap<String, Severity>,
}

/// A suppression of findings.
#[derive(Debug, Clone)]
pub struct Suppression {
    /// Codes of its rules.
    pub codes: BTreeSet<String>,
    /// The rule as written in the file.
    pub rule: String,
    /// The path as written in the file.
    pub path: Option<String>,
    /// Reason for the suppression.
    pub reason: String,
    /// Position of the entry: `ckpt-doctor.json5: suppress[0]`.
    pub written: String,
    area: Area,
}

/// The files that a glob matches.
#[derive(Debug, Clone)]
struct Area {
    /// Folder at which the glob starts, absolute.
    dir: PathBuf,
    /// `None` for everything below `dir`.
    glob: Option<GlobSet>,
    /// The folders before the first wildcard, absolute.
    base: PathBuf,
}

impl Policy {
    /// Builds the policy from settings files in order of increasing precedence.
    pub(super) fn from_sources(sources: &[SettingsSource], rules: &RuleSet) -> Result<Self, DataError> {
        let mut policy = Self::default();
        for source in sources {
            policy.metadata_only = source.settings.metadata_only.unwrap_or(policy.metadata_only);
            let codes = |word: &String| rules.codes(word).map_err(|e| source.wrong(word, e.to_string()));
            for (glob, settings) in &source.settings.per_path {
                let mut place = AreaSettings {
                    area: Area::new(source, Some(glob))?,
                    ignore: BTreeSet::new(),
                    severity: BTreeMap::new(),
                };
                for word in &settings.ignore {
                    place.ignore.extend(codes(word)?);
                }
                // Shorter selectors first, so that a code overrides its family.
                let mut graded: Vec<&(String, Severity)> = settings.severity.iter().collect();
                graded.sort_by_key(|(word, _)| word.len());
                for (word, severity) in graded {
                    place.severity.extend(codes(word)?.into_iter().map(|code| (code, *severity)));
                }
                policy.places.push(place);
            }
            for (number, entry) in source.settings.suppress.iter().enumerate() {
                if entry.reason.trim().is_empty() {
                    let reason = format!("suppress[{number}] of {} has no reason; add one", entry.rule);
                    return Err(source.wrong(&entry.rule, reason));
                }
                policy.suppressions.push(Suppression {
                    codes: codes(&entry.rule)?.into_iter().collect(),
                    rule: entry.rule.clone(),
                    path: entry.path.clone(),
                    reason: entry.reason.clone(),
                    written: format!("{}: suppress[{number}]", source.name),
                    area: Area::new(source, entry.path.as_ref())?,
                });
            }
        }
        Ok(policy)
    }

    /// Number of paths with settings of their own.
    #[must_use]
    pub const fn paths(&self) -> usize {
        self.places.len()
    }

    /// Whether the policy leaves every finding unchanged.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.places.is_empty() && self.suppressions.is_empty()
    }

    /// The severity of a rule's finding in `file` of the checkpoint at `root`, which is `severity` unless settings
    /// change it; `None` when settings ignore the rule there.
    #[must_use]
    pub fn grade(&self, root: &Path, file: Option<&str>, code: &str, severity: Severity) -> Option<Severity> {
        let here = || self.places.iter().filter(|place| place.area.holds(root, file));
        if here().any(|place| place.ignore.contains(code)) {
            return None;
        }
        Some(here().filter_map(|place| place.severity.get(code)).next_back().copied().unwrap_or(severity))
    }

    /// Index in [`Self::suppressions`] of the first entry that matches a rule's finding in `file` of the checkpoint at
    /// `root`.
    #[must_use]
    pub fn suppression(&self, root: &Path, file: Option<&str>, code: &str) -> Option<usize> {
        self.suppressions.iter().position(|s| s.codes.contains(code) && s.area.holds(root, file))
    }
}

impl Suppression {
    /// Whether it matches the checkpoint at `root` or one of these files in it.
    pub fn concerns<'f>(&self, root: &Path, mut files: impl Iterator<Item = &'f str>) -> bool {
        self.area.holds(root, None) || files.any(|file| self.area.holds(root, Some(file)))
    }

    /// The folders before the first wildcard of its glob; all matches are below.
    #[must_use]
    pub fn base(&self) -> &Path {
        &self.area.base
    }
}

impl Area {
    fn new(source: &SettingsSource, glob: Option<&String>) -> Result<Self, DataError> {
        let mut dir = source.dir.clone();
        let Some(written) = glob else { return Ok(Self { base: dir.clone(), dir, glob: None }) };
        let mut rest = written.trim_end_matches('/');
        if written.starts_with('/') {
            dir = PathBuf::from("/");
            rest = rest.trim_start_matches('/');
        }
        loop {
            if let Some(below) = rest.strip_prefix("./") {
                rest = below;
            } else if let Some(above) = rest.strip_prefix("../") {
                dir.pop();
                rest = above;
            } else {
                break;
            }
        }
        if rest.is_empty() || rest == "." {
            return Ok(Self { base: dir.clone(), dir, glob: None });
        }
        let plain = |part: &&str| !part.contains(['*', '?', '[', '{', '\\']);
        let base = rest.split('/').take_while(plain).fold(dir.clone(), |base, part| base.join(part));
        let glob = glob::glob(rest);
        let glob =
            glob.map_err(|e| source.wrong(written, format!("`{}` is not a valid glob: {e}", escape(written, 80))))?;
        Ok(Self { dir, glob: Some(glob), base })
    }

    /// Whether the area contains the checkpoint at `root` or this file of it.
    fn holds(&self, root: &Path, file: Option<&str>) -> bool {
        let root = absolute(root);
        let Ok(below) = root.strip_prefix(&self.dir) else { return false };
        let Some(glob) = &self.glob else { return true };
        let folder = |path: &Path| path.ancestors().any(|path| glob.is_match(path));
        folder(below) || file.is_some_and(|file| glob.is_match(below.join(file)))
    }
}
