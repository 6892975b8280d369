//! The Code Quality report of GitLab: an array of findings.
//!
//! <https://docs.gitlab.com/ci/testing/code_quality/#code-quality-report-format>

use serde::Serialize;
use sha2::{Digest as _, Sha256};

use super::{file, groups};
use crate::check::Severity;
use crate::checkpoint::hex;
use crate::report::Report;
use crate::report::format::name;
use crate::report::json;

#[derive(Serialize)]
struct QualityEntry {
    description: String,
    check_name: String,
    fingerprint: String,
    severity: &'static str,
    location: QualityLocation,
}

#[derive(Serialize)]
struct QualityLocation {
    path: String,
    lines: Lines,
}

#[derive(Serialize)]
struct Lines {
    begin: usize,
}

pub fn render(report: &Report) -> String {
    let mut entries = Vec::new();
    for group in groups(report) {
        if let Some(governed) = &group.governed {
            // The format has no other place for it.
            entries.push(QualityEntry {
                description: format!("Checked under changed rules: {governed}"),
                check_name: "settings".to_owned(),
                fingerprint: hex(&Sha256::digest(format!("settings {} {governed}", group.path))),
                severity: "info",
                location: QualityLocation { path: group.path.clone(), lines: Lines { begin: 1 } },
            });
        }
        for item in group.items {
            let first = item.locations.first();
            let path = first.and_then(|l| file(&group.path, l)).unwrap_or_else(|| group.path.clone());
            // A line is required; files without lines and directories get line 1.
            let begin = first.and_then(|l| l.line).unwrap_or(1);
            let severity = match item.severity {
                Severity::Error => "major",
                Severity::Warning => "minor",
                Severity::Info => "info",
            };
            entries.push(QualityEntry {
                description: item.message,
                check_name: name(item.code),
                fingerprint: item.fingerprint,
                severity,
                location: QualityLocation { path, lines: Lines { begin } },
            });
        }
    }
    json::pretty(&entries)
}
