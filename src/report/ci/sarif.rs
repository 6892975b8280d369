//! SARIF 2.1.0, the format of code scanning services.
//!
//! <https://docs.oasis-open.org/sarif/sarif/v2.1.0/sarif-v2.1.0.html>; numbers in comments refer to its sections.

mod fixes;
mod parts;

use std::collections::BTreeMap;

use serde::Serialize;

use super::{Group, Item, SEAM, UNCHECKED, file, groups};
use crate::check::finding::Accepted;
use crate::check::{Location, Severity};
use crate::checkpoint::line_column;
use crate::report::format::{name, sentence};
use crate::report::model::RuleText;
use crate::report::{Report, json};
use parts::{ArtifactLocation, ROOT, SarifText, artifact_at, text};

const SCHEMA: &str = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json";
/// Maximum number of locations of one result, a limit of GitHub.
const LOCATIONS: usize = 1_000;
#[derive(Serialize)]
struct SarifLog {
    #[serde(rename = "$schema")]
    schema: &'static str,
    version: &'static str,
    runs: [SarifRun; 1],
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct SarifRun {
    tool: SarifTool,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    original_uri_base_ids: BTreeMap<&'static str, SarifBase>,
    column_kind: &'static str,
    results: Vec<SarifResult>,
    /// A property bag (3.8): the verdicts, and the settings that changed them, by checkpoint.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    properties: BTreeMap<&'static str, BTreeMap<String, String>>,
}

#[derive(Serialize)]
struct SarifTool {
    driver: SarifDriver,
}

#[derive(Serialize)]
struct SarifDriver {
    name: &'static str,
    version: &'static str,
    rules: Vec<SarifRule>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct SarifRule {
    id: String,
    name: String,
    short_description: SarifText,
    #[serde(skip_serializing_if = "Option::is_none")]
    full_description: Option<SarifText>,
    help: SarifText,
}

#[derive(Serialize)]
struct SarifBase {
    uri: &'static str,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct SarifResult {
    rule_id: String,
    rule_index: usize,
    level: &'static str,
    message: SarifText,
    locations: Vec<SarifLocation>,
    partial_fingerprints: BTreeMap<&'static str, String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    suppressions: Vec<SarifSuppression>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    fixes: Vec<fixes::SarifFix>,
}

/// Reason for suppressing a result (3.35); `external`, because it is not in the checked file.
#[derive(Serialize)]
struct SarifSuppression {
    kind: &'static str,
    status: &'static str,
    justification: String,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct SarifLocation {
    physical_location: PhysicalLocation,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    logical_locations: Vec<LogicalLocation>,
}

#[derive(Serialize, PartialEq)]
#[serde(rename_all = "camelCase")]
struct PhysicalLocation {
    artifact_location: ArtifactLocation,
    #[serde(skip_serializing_if = "Option::is_none")]
    region: Option<Region>,
}

#[derive(Serialize, PartialEq)]
#[serde(rename_all = "camelCase")]
struct Region {
    start_line: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    start_column: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    end_line: Option<usize>,
    /// The column behind the last character.
    #[serde(skip_serializing_if = "Option::is_none")]
    end_column: Option<usize>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct LogicalLocation {
    fully_qualified_name: String,
    kind: &'static str,
}

pub fn render(report: &Report) -> String {
    let mut rules: Vec<SarifRule> = Vec::new();
    let mut known: BTreeMap<String, usize> = BTreeMap::new();
    let mut results = Vec::new();
    let (mut verdicts, mut settings) = (BTreeMap::new(), BTreeMap::new());
    for group in groups(report) {
        if !group.headline.is_empty() {
            verdicts.insert(name(&group.title), group.headline.clone());
        }
        settings.extend(group.governed.iter().map(|governed| (name(&group.title), governed.clone())));
        let accepted = group.suppressed.iter().map(|(item, accepted)| (item, Some(*accepted)));
        for (item, accepted) in group.items.iter().map(|item| (item, None)).chain(accepted) {
            let id = name(item.code);
            let rule_index = *known.entry(id.clone()).or_insert_with(|| {
                rules.push(rule(id.clone(), item, report.terms.rules.get(item.code)));
                rules.len().saturating_sub(1)
            });
            let partial_fingerprints = BTreeMap::from([("checkpointFinding/v1", item.fingerprint.clone())]);
            results.push(SarifResult {
                rule_id: id,
                rule_index,
                level: level(item.severity),
                message: message(item),
                locations: locations(&group, item),
                partial_fingerprints,
                suppressions: accepted.map(suppression).into_iter().collect(),
                fixes: item.fix.zip(group.sources).map_or_else(Vec::new, |(f, s)| fixes::fixes(f, &group.path, s)),
            });
        }
    }
    let absolute = |place: &SarifLocation| place.physical_location.artifact_location.uri_base_id == ROOT;
    let mut original_uri_base_ids = BTreeMap::new();
    if results.iter().flat_map(|r| &r.locations).any(absolute) {
        original_uri_base_ids.insert(ROOT, SarifBase { uri: "file:///" });
    }
    let tool = SarifTool { driver: SarifDriver { name: report.tool.name, version: report.tool.version, rules } };
    // Columns count characters (3.14.17).
    let bags = [("verdicts", verdicts), ("settings", settings)];
    let properties = bags.into_iter().filter(|(_, bag)| !bag.is_empty()).collect();
    let run = SarifRun { tool, original_uri_base_ids, column_kind: "unicodeCodePoints", results, properties };
    json::pretty(&SarifLog { schema: SCHEMA, version: "2.1.0", runs: [run] })
}

fn suppression(accepted: &Accepted) -> SarifSuppression {
    let reason = accepted.reason.iter().map(|reason| sentence(&format!("{reason} ({})", accepted.by)));
    let justification = reason.chain([sentence(&accepted.by)]).next().unwrap_or_default();
    SarifSuppression { kind: "external", status: "accepted", justification }
}

const fn level(severity: Severity) -> &'static str {
    match severity {
        Severity::Error => "error",
        Severity::Warning => "warning",
        Severity::Info => "note",
    }
}

/// What was found, and the next step.
fn message(item: &Item<'_>) -> SarifText {
    let step = item.help.iter().map(|help| format!("\n\nHelp: {help}"));
    text(&std::iter::once(item.message.clone()).chain(step).collect::<String>())
}

/// A rule in its own words; in those of its name where the report has no others.
fn rule(id: String, item: &Item<'_>, own: Option<&RuleText>) -> SarifRule {
    let more = if [SEAM, UNCHECKED].contains(&item.code) {
        String::new()
    } else {
        format!("`ckpt-doctor explain {id}` explains its meaning and the next step.")
    };
    let stated = own.map_or_else(|| sentence(&item.name.replace('-', " ")), |own| sentence(&own.summary));
    let why = own.map(|own| sentence(&own.why));
    let help = why.iter().cloned().chain([more]).filter(|part| !part.is_empty()).collect::<Vec<_>>().join("\n\n");
    let help = if help.is_empty() { stated.clone() } else { help };
    let full_description = why.as_deref().map(text);
    SarifRule { id, name: name(item.name), short_description: text(&stated), full_description, help: text(&help) }
}

/// The places of a finding, with tensors grouped by file position; the checkpoint if the finding has no place.
fn locations(group: &Group<'_>, item: &Item<'_>) -> Vec<SarifLocation> {
    let mut places: Vec<SarifLocation> = Vec::new();
    for location in item.locations.iter().take(LOCATIONS) {
        let place = physical(group, location);
        let named = [(&location.pointer, "value"), (&location.tensor, "tensor")].into_iter();
        let named = named.filter_map(|(what, kind)| Some((what.as_deref().filter(|w| !w.is_empty())?, kind)));
        let logical = named.map(|(what, kind)| LogicalLocation { fully_qualified_name: name(what), kind });
        match places.last_mut() {
            Some(last) if last.physical_location == place => last.logical_locations.extend(logical),
            _ => places.push(SarifLocation { physical_location: place, logical_locations: logical.collect() }),
        }
    }
    if places.is_empty() {
        places.push(SarifLocation {
            physical_location: physical(group, &Location::default()),
            logical_locations: Vec::new(),
        });
    }
    places
}

fn physical(group: &Group<'_>, location: &Location) -> PhysicalLocation {
    let found = file(&group.path, location);
    let region = location.line.filter(|_| found.is_some()).map(|start_line| {
        let source = || group.sources?.get(location.file.as_deref()?);
        let end = location.span.as_ref().filter(|_| location.column.is_some()).map(|span| span.end);
        let end = end.zip(source()).map(|(end, source)| line_column(source, end));
        let (end_line, end_column) = end.unzip();
        Region { start_line, start_column: location.column, end_line, end_column }
    });
    PhysicalLocation { artifact_location: artifact_at(found.as_deref().unwrap_or(&group.path)), region }
}
