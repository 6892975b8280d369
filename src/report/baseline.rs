//! A baseline: findings that were there when it was written, and are not counted since.
//!
//! A finding is known by its fingerprint, the same as in SARIF and for GitLab but for the path, which starts at the
//! baseline's folder: the file travels with what it is about.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use serde::{Deserialize, Serialize};

use super::ci::{of_finding, tidy};
use super::format::{name, sentence};
use super::json;
use super::model::CheckpointReport;
use crate::check::finding::Accepted;
use crate::knowledge::settings::absolute;
use crate::knowledge::source::{self, DataError};

/// Version of the form of the file.
const SCHEMA: u32 = 1;

/// The file.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    schema: u32,
    /// By checkpoint, rule and message.
    findings: Vec<BaselineEntry>,
    /// Path or URL of a JSON Schema, for editors; the program keeps it and ignores it.
    #[serde(default, rename = "$schema", skip_serializing_if = "Option::is_none")]
    for_editors: Option<String>,
}

/// One finding. All but the fingerprint is for people.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BaselineEntry {
    /// The checkpoint, from the baseline's folder.
    pub path: String,
    /// Rule code.
    pub code: String,
    /// What was said of it.
    pub message: String,
    /// What it is known by.
    fingerprint: String,
}

impl Baseline {
    /// Reads one; `file` is for messages.
    ///
    /// # Errors
    /// Says what is wrong with `text`, and where.
    pub fn parse(file: &str, text: &str) -> Result<Self, DataError> {
        let baseline: Self = source::parse(file, text)?;
        if baseline.schema == SCHEMA {
            return Ok(baseline);
        }
        Err(DataError::new(file, format!("a baseline of version {}; {SCHEMA} is known here", baseline.schema)))
    }

    /// What was found in these checkpoints, for a file in `folder`.
    pub fn from_reports<'r>(reports: impl Iterator<Item = &'r CheckpointReport>, folder: &Path) -> Self {
        let mut findings: Vec<BaselineEntry> = reports.flat_map(|report| entries(report, folder)).collect();
        findings.sort();
        Self { schema: SCHEMA, findings, for_editors: None }
    }

    /// Keeps of an older baseline what this one cannot speak of: other checkpoints, and rules that were not asked.
    pub fn keep(&mut self, older: Self, reports: &[&CheckpointReport], folder: &Path, asked: &BTreeSet<&str>) {
        let paths: BTreeSet<String> = reports.iter().map(|report| below(folder, report)).collect();
        let other = |e: &BaselineEntry| !paths.contains(&e.path) || !asked.contains(e.code.as_str());
        self.findings.extend(older.findings.into_iter().filter(other));
        self.findings.sort();
        self.findings.dedup();
        self.for_editors = older.for_editors;
    }

    /// The text of the file.
    #[must_use]
    pub fn text(&self) -> String {
        json::pretty(self)
    }

    /// How many findings it has.
    #[must_use]
    pub fn len(&self) -> usize {
        self.findings.len()
    }

    /// Whether it has none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.findings.is_empty()
    }

    /// Sets the findings aside that are in it; returns those in it that are gone from this checkpoint, of the rules that
    /// were asked.
    pub fn accept(
        &self,
        report: &mut CheckpointReport,
        file: &str,
        folder: &Path,
        asked: &BTreeSet<&str>,
    ) -> Vec<&BaselineEntry> {
        let here = entries(report, folder);
        let known: BTreeSet<&str> = self.findings.iter().map(|e| e.fingerprint.as_str()).collect();
        let is_known =
            |number| here.get(number).is_some_and(|e: &BaselineEntry| known.contains(e.fingerprint.as_str()));
        report.accept(|number, _| is_known(number).then(|| Accepted { by: file.to_owned(), reason: None }));
        let path = below(folder, report);
        let still: BTreeSet<&str> = here.iter().map(|e| e.fingerprint.as_str()).collect();
        let gone = |e: &&BaselineEntry| {
            e.path == path && asked.contains(e.code.as_str()) && !still.contains(e.fingerprint.as_str())
        };
        self.findings.iter().filter(gone).collect()
    }
}

fn entries(report: &CheckpointReport, folder: &Path) -> Vec<BaselineEntry> {
    let path = below(folder, report);
    let mut seen = BTreeMap::new();
    let entry = |finding| {
        let fingerprint = of_finding(finding, &path, "", &mut seen);
        BaselineEntry {
            path: path.clone(),
            code: name(&finding.code),
            message: sentence(&finding.message),
            fingerprint,
        }
    };
    report.findings.iter().map(entry).collect()
}

/// Where a checkpoint is, from `folder`.
fn below(folder: &Path, report: &CheckpointReport) -> String {
    let (folder, path) = (absolute(folder), absolute(Path::new(&report.path)));
    let (mut from, mut to) = (folder.components().peekable(), path.components().peekable());
    while from.peek().is_some() && from.peek() == to.peek() {
        from.next();
        to.next();
    }
    let relative = from.map(|_| Component::ParentDir).chain(to);
    tidy(&relative.map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/"))
}
