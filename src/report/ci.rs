//! Data shared by the formats for other programs.
//!
//! They ignore `Style`: a program that reads a report needs all of it.

pub mod github;
pub mod gitlab;
pub mod junit;
pub mod sarif;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

use sha2::{Digest as _, Sha256};

use super::format::{advice, governed, headline, sentence};
use super::model::{CheckpointReport, MergeReport, MergeStage, Report, Role, UncheckedPath};
use crate::check::finding::Accepted;
use crate::check::{Finding, FixHint, Location, Severity};
use crate::checkpoint::hex;

/// Longest path in a report, in characters; the limit of Linux.
const PATH: usize = 4_096;

/// The findings on one checkpoint, the seams of a merge, or a path that could not be checked.
pub struct Group<'a> {
    /// The checkpoint or merge, with its role in a merge.
    pub title: String,
    /// Path of the checkpoint or merge, see [`tidy`].
    pub path: String,
    /// The verdicts in one line; empty for a merge.
    pub headline: String,
    /// The settings that changed the verdict, see [`governed`].
    pub governed: Option<String>,
    /// Texts of the documents; `None` for a merge.
    pub sources: Option<&'a BTreeMap<String, Arc<str>>>,
    /// Items in report order.
    pub items: Vec<Item<'a>>,
    /// Whether findings that are not among `items`, because of `--min-severity`, make the run fail.
    pub hides_failure: bool,
    /// Suppressed findings, each with the origin and reason of the suppression.
    pub suppressed: Vec<(Item<'a>, &'a Accepted)>,
}

/// Rule code of a seam.
pub const SEAM: &str = "seam";

/// Rule code of a path that could not be checked.
pub const UNCHECKED: &str = "unchecked";

/// A finding, a seam mismatch, or a path that could not be checked.
pub struct Item<'a> {
    /// Rule code; [`SEAM`] for a seam, [`UNCHECKED`] for a path.
    pub code: &'a str,
    /// Rule name.
    pub name: &'a str,
    /// Severity.
    pub severity: Severity,
    /// Message, escaped for display.
    pub message: String,
    /// Places; may be empty.
    pub locations: &'a [Location],
    /// Whether it makes the run fail.
    pub fails: bool,
    /// The fix, if any.
    pub fix: Option<&'a FixHint>,
    /// The next step, escaped for display.
    pub help: Option<String>,
    /// SHA-256 in hexadecimal. It does not change when the finding moves within its file; unique within a report.
    pub fingerprint: String,
}

/// All items of a report: one group for each checkpoint, for a merge, and for each path that could not be checked.
pub fn groups(report: &Report) -> Vec<Group<'_>> {
    let mut seen = BTreeMap::new();
    // Once a merge has a result, or a plan that was asked for, its donors do not matter.
    let has_result = report
        .merge
        .as_ref()
        .is_some_and(|merge| matches!(merge.stage, Some(MergeStage::Written | MergeStage::DryRun)));
    let fails = |c: &CheckpointReport, severity: Severity| {
        let counts = !has_result || !matches!(c.role, Some(Role::Donor(_)));
        counts && report.terms.fail_on.is_some_and(|least| severity >= least)
    };
    let mut groups: Vec<Group<'_>> = Vec::new();
    for checkpoint in &report.checkpoints {
        groups.push(findings(checkpoint, &|severity| fails(checkpoint, severity), &mut seen));
    }
    groups.extend(report.merge.as_ref().map(|m| seams(m, &mut seen)));
    groups.extend(report.unchecked.iter().map(|u| unchecked(u, &mut seen)));
    groups
}

fn findings<'a>(
    checkpoint: &'a CheckpointReport,
    fails: &dyn Fn(Severity) -> bool,
    seen: &mut BTreeMap<String, usize>,
) -> Group<'a> {
    let path = tidy(&checkpoint.path);
    let role = checkpoint.role.as_ref().map(ToString::to_string).unwrap_or_default();
    let title = if role.is_empty() { path.clone() } else { format!("{path} ({role})") };
    let mut item = |finding: &'a Finding| Item {
        code: &finding.code,
        name: &finding.name,
        severity: finding.severity,
        message: sentence(&finding.message),
        locations: &finding.locations,
        fails: fails(finding.severity),
        fix: finding.fix.as_ref(),
        help: finding.fix.as_ref().map(|hint| advice(hint).join("; ")),
        fingerprint: of_finding(finding, &path, &role, seen),
    };
    let items: Vec<Item<'_>> = checkpoint.findings.iter().map(&mut item).collect();
    let hides_failure = checkpoint.counts.worst().is_some_and(fails) && !items.iter().any(|item| item.fails);
    let suppressed = checkpoint.suppressed.iter().map(|s| (item(&s.finding), &s.accepted)).collect();
    Group {
        title,
        path,
        headline: headline(&checkpoint.loads),
        governed: governed(checkpoint).filter(|_| checkpoint.is_governed()),
        sources: Some(&checkpoint.sources),
        items,
        hides_failure,
        suppressed,
    }
}

/// Fingerprint of a finding of the checkpoint at `path`.
pub fn of_finding(finding: &Finding, path: &str, role: &str, seen: &mut BTreeMap<String, usize>) -> String {
    let mut parts = vec![path, role, &finding.code];
    // Only the first place is hashed, so that an additional place does not change the fingerprint.
    if let Some(first) = finding.locations.first() {
        parts.extend([&first.file, &first.pointer, &first.tensor].map(|p| p.as_deref().unwrap_or_default()));
    }
    parts.push(&finding.message);
    fingerprint(&parts, seen)
}

fn seams<'a>(merge: &'a MergeReport, seen: &mut BTreeMap<String, usize>) -> Group<'a> {
    let path = tidy(&merge.out);
    let items = merge.seams.iter().map(|seam| Item {
        code: SEAM,
        name: "seam-does-not-fit",
        severity: Severity::Error,
        message: sentence(&seam.message),
        locations: &[],
        fails: true,
        fix: None,
        help: (!seam.options.is_empty()).then(|| sentence(&format!("Try {}", seam.options.join(" or ")))),
        fingerprint: fingerprint(&[&path, SEAM, &merge.recipe, &seam.message], seen),
    });
    let items = items.collect();
    Group {
        title: format!("merge {}", merge.recipe),
        path,
        headline: String::new(),
        governed: None,
        sources: None,
        items,
        hides_failure: false,
        suppressed: Vec::new(),
    }
}

fn unchecked<'a>(unchecked: &UncheckedPath, seen: &mut BTreeMap<String, usize>) -> Group<'a> {
    let path = tidy(&unchecked.path);
    let item = Item {
        code: UNCHECKED,
        name: "path-not-checked",
        severity: Severity::Error,
        message: sentence(&unchecked.reason),
        locations: &[],
        fails: true,
        fix: None,
        help: None,
        fingerprint: fingerprint(&[&path, UNCHECKED], seen),
    };
    Group {
        title: path.clone(),
        path,
        headline: String::new(),
        governed: None,
        sources: None,
        items: vec![item],
        hides_failure: false,
        suppressed: Vec::new(),
    }
}

/// Hashes the parts with their lengths, so that different parts give different hashes; repeated fingerprints are
/// numbered.
fn fingerprint(parts: &[&str], seen: &mut BTreeMap<String, usize>) -> String {
    let hash = |before: &str, nth: usize| {
        let mut hasher = Sha256::new();
        for part in [before].iter().chain(parts) {
            hasher.update(part.len().to_be_bytes());
            hasher.update(part);
        }
        hasher.update(nth.to_be_bytes());
        hex(&hasher.finalize())
    };
    let first = hash("finding", 0);
    let times = seen.entry(first.clone()).or_default();
    let nth = *times;
    *times = times.saturating_add(1);
    if nth == 0 { first } else { hash("again", nth) }
}

/// Removes empty and `.` components of a path, and cuts it at [`PATH`] characters.
pub fn tidy(path: &str) -> String {
    let parts: Vec<&str> = path.split('/').filter(|part| !part.is_empty() && *part != ".").collect();
    let root = if path.starts_with('/') { "/" } else { "" };
    let tidy: String = root.chars().chain(parts.join("/").chars()).take(PATH).collect();
    if tidy.is_empty() { ".".to_owned() } else { tidy }
}

/// The file of a location, below the directory `path`.
pub fn file(path: &str, location: &Location) -> Option<String> {
    location.file.as_deref().map(|file| tidy(&format!("{path}/{file}")))
}

/// `path/file:line:column`, without the parts that are missing.
pub fn spot(path: &str, location: &Location) -> String {
    let mut spot = file(path, location).unwrap_or_else(|| path.to_owned());
    for n in [location.line, location.column].into_iter().map_while(|n| n) {
        let _infallible = write!(spot, ":{n}");
    }
    spot
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::{PATH, fingerprint, tidy};

    #[test]
    fn paths_are_tidied_and_bounded() {
        let shown = ["", ".", "./a//b/", "/a/./b", "/", "../a", "//host/a"].map(tidy);
        assert_eq!(shown, [".", ".", "a/b", "/a/b", "/", "../a", "/host/a"]);
        assert_eq!(tidy(&"é".repeat(10_000)).chars().count(), PATH);
    }

    #[test]
    fn fingerprints_tell_parts_and_repetitions_apart() {
        let mut seen = BTreeMap::new();
        let shown: Vec<String> = [["ab", "c"], ["a", "bc"], ["ab", "c"], ["ab", "c"]]
            .iter()
            .map(|parts| fingerprint(parts, &mut seen))
            .collect();
        let distinct: std::collections::BTreeSet<&String> = shown.iter().collect();
        assert_eq!(distinct.len(), shown.len());
        assert_eq!(shown.first(), Some(&fingerprint(&["ab", "c"], &mut BTreeMap::new())));
    }
}
