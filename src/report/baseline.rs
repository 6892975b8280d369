//! A baseline: a file with known findings, which are not counted.
//!
//! A finding is identified by its fingerprint. It is the fingerprint of SARIF and GitLab reports, except that the path
//! is relative to the folder of the baseline, so that both can be moved together.

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

/// Version of the file format.
const SCHEMA: u32 = 1;

/// A baseline file.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    schema: u32,
    /// Sorted by checkpoint, rule and message.
    findings: Vec<BaselineEntry>,
    /// Path or URL of a JSON Schema, for editors; the program keeps it and ignores it.
    #[serde(default, rename = "$schema", skip_serializing_if = "Option::is_none")]
    for_editors: Option<String>,
}

/// One finding. Only the fingerprint is compared; the other keys are for readers.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct BaselineEntry {
    /// Path of the checkpoint, relative to the folder of the baseline.
    pub path: String,
    /// Rule code.
    pub code: String,
    /// Message of the finding.
    pub message: String,
    /// Fingerprint that identifies the finding.
    fingerprint: String,
}

impl Baseline {
    /// Parses a baseline; `file` is used in messages.
    ///
    /// # Errors
    /// [`DataError`] with the position in `text`.
    pub fn parse(file: &str, text: &str) -> Result<Self, DataError> {
        let baseline: Self = source::parse(file, text)?;
        if baseline.schema == SCHEMA {
            return Ok(baseline);
        }
        Err(DataError::new(file, format!("baseline version {} is unknown; expected {SCHEMA}", baseline.schema)))
    }

    /// A baseline of the findings of these checkpoints, for a file in `folder`.
    pub fn from_reports<'r>(reports: impl Iterator<Item = &'r CheckpointReport>, folder: &Path) -> Self {
        let mut findings: Vec<BaselineEntry> = reports.flat_map(|report| entries(report, folder)).collect();
        findings.sort();
        Self { schema: SCHEMA, findings, for_editors: None }
    }

    /// Adds findings of an older baseline that this run did not check: those of other checkpoints, and of rules that
    /// did not run.
    pub fn keep(&mut self, older: Self, reports: &[&CheckpointReport], folder: &Path, rules: &BTreeSet<&str>) {
        let paths: BTreeSet<String> = reports.iter().map(|report| below(folder, report)).collect();
        let other = |e: &BaselineEntry| !paths.contains(&e.path) || !rules.contains(e.code.as_str());
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

    /// Number of findings.
    #[must_use]
    pub(crate) fn len(&self) -> usize {
        self.findings.len()
    }

    /// Moves findings that the baseline contains to the suppressed ones. Returns findings of the baseline that the
    /// checkpoint no longer has, for the `rules` that ran.
    pub fn accept(
        &self,
        report: &mut CheckpointReport,
        file: &str,
        folder: &Path,
        rules: &BTreeSet<&str>,
    ) -> Vec<&BaselineEntry> {
        let here = entries(report, folder);
        let known: BTreeSet<&str> = self.findings.iter().map(|e| e.fingerprint.as_str()).collect();
        let is_known =
            |number| here.get(number).is_some_and(|e: &BaselineEntry| known.contains(e.fingerprint.as_str()));
        report.accept(|number, _| is_known(number).then(|| Accepted { by: file.to_owned(), reason: None }));
        let path = below(folder, report);
        let still: BTreeSet<&str> = here.iter().map(|e| e.fingerprint.as_str()).collect();
        let gone = |e: &&BaselineEntry| {
            e.path == path && rules.contains(e.code.as_str()) && !still.contains(e.fingerprint.as_str())
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

/// Path of a checkpoint, relative to `folder`.
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
