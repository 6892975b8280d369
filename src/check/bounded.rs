//! Findings within the size of a report.

use super::Finding;

/// Maximum number of bytes of the findings of one checkpoint, as JSON. Beyond it, findings are counted.
const BYTES: usize = 6 << 20;
/// Longest message of a finding beyond it, in characters.
const MESSAGE: usize = 1000;

/// The findings, in their order. One beyond [`BYTES`] is counted by the finding before it that has its code and severity; the
/// first of a code and severity is listed with its message and file alone. Called by the engine for each checkpoint.
pub(super) fn bounded(findings: Vec<Finding>) -> Vec<Finding> {
    let mut kept: Vec<Finding> = Vec::new();
    let mut bytes = 0_usize;
    for finding in findings {
        bytes = bytes.saturating_add(serde_json::to_vec(&finding).map_or(0, |json| json.len()));
        if bytes <= BYTES {
            kept.push(finding);
            continue;
        }
        match kept.iter_mut().rev().find(|other| (&other.code, other.severity) == (&finding.code, finding.severity)) {
            Some(other) => {
                let count = u64::try_from(finding.count()).unwrap_or(u64::MAX);
                other.hidden = other.hidden.saturating_add(count);
            }
            None => kept.push(reduced(finding)),
        }
    }
    kept
}

/// A finding with its message and its first file alone.
fn reduced(mut finding: Finding) -> Finding {
    finding.message = finding.message.chars().take(MESSAGE).collect();
    finding.details.clear();
    finding.evidence.clear();
    finding.locations.truncate(1);
    for location in &mut finding.locations {
        (location.pointer, location.tensor) = (None, None);
    }
    for effect in &mut finding.effects {
        effect.text = effect.text.chars().take(MESSAGE).collect();
    }
    finding.fix = finding.fix.map(super::FixHint::without_edits);
    finding
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::{Location, Severity};

    #[test]
    fn every_finding_is_listed_or_counted() {
        let finding = |code: &str, text: usize| Finding {
            code: code.to_owned(),
            name: String::new(),
            severity: Severity::Error,
            message: "x".repeat(text),
            details: Vec::new(),
            effects: Vec::new(),
            locations: vec![Location { tensor: Some("x".repeat(text)), ..Location::default() }],
            evidence: serde_json::Map::new(),
            fix: None,
            hidden: 2,
            note: false,
        };
        let all: Vec<Finding> =
            ["A", "B", "C"].into_iter().flat_map(|code| (0..50).map(move |_| finding(code, 60_000))).collect();
        let kept = bounded(all.clone());
        let count = |findings: &[Finding]| findings.iter().map(Finding::count).sum::<usize>();
        assert_eq!((count(&kept), count(&all)), (450, 450));
        assert!(kept.len() < 60 && kept.iter().any(|f| f.code == "C" && f.locations[0].tensor.is_none()));
        assert!(serde_json::to_vec(&kept).unwrap().len() <= BYTES + 3 * 2 * MESSAGE);
    }
}
