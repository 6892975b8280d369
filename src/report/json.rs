//! The JSON contract: complete and indented, or one line per finding.

use std::fmt::Write as _;

use serde::Serialize;

use super::Report;
use super::format::hostile;
use super::model::{Overrides, Role, Summary, ToolInfo, UncheckedPath};

pub fn render(report: &Report) -> String {
    pretty(report)
}

/// Serialises a value as indented JSON, escaped for display.
pub fn pretty<T: Serialize>(value: &T) -> String {
    harmless(&written(serde_json::to_string_pretty(value)))
}

/// One predicted load or finding per line, with the summary last.
///
/// Every line is an object whose `type` is `settings`, `load`, `finding`, `seam`, `unchecked` or `summary`. The other keys are
/// those of the JSON contract.
pub fn lines(report: &Report) -> String {
    let mut lines = Vec::new();
    for checkpoint in &report.checkpoints {
        let (path, role) = (&checkpoint.path, checkpoint.role.as_ref());
        let line = |finding| JsonLine { r#type: LineKind::Finding, path, role, content: finding };
        let load = |load| JsonLine { r#type: LineKind::Load, path, role, content: load };
        let settings = SettingsContent { settings: checkpoint.settings.as_deref(), overrides: checkpoint.overrides };
        if checkpoint.is_governed() {
            let line = JsonLine { r#type: LineKind::Settings, path, role, content: &settings };
            lines.push(written(serde_json::to_string(&line)));
        }
        lines.extend(checkpoint.loads.iter().map(|l| written(serde_json::to_string(&load(l)))));
        lines.extend(checkpoint.findings.iter().map(|f| written(serde_json::to_string(&line(f)))));
    }
    if let Some(merge) = &report.merge {
        let line = |seam| JsonLine { r#type: LineKind::Seam, path: &merge.out, role: None, content: seam };
        lines.extend(merge.seams.iter().map(|s| written(serde_json::to_string(&line(s)))));
    }
    for unchecked in &report.unchecked {
        let line = UncheckedLine { r#type: LineKind::Unchecked, content: unchecked };
        lines.push(written(serde_json::to_string(&line)));
    }
    let summary =
        SummaryLine { r#type: LineKind::Summary, schema: report.schema, tool: &report.tool, summary: &report.summary };
    lines.push(written(serde_json::to_string(&summary)));
    harmless(&lines.join("\n"))
}

/// Type of a line.
#[derive(Serialize)]
#[serde(rename_all = "lowercase")]
enum LineKind {
    Settings,
    Load,
    Finding,
    Seam,
    Unchecked,
    Summary,
}

#[derive(Serialize)]
struct JsonLine<'a, T> {
    r#type: LineKind,
    /// The checkpoint, as given by the user; for a seam, the output directory of the merge.
    path: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    role: Option<&'a Role>,
    #[serde(flatten)]
    content: &'a T,
}

/// What changed the verdict on a checkpoint; its suppressed findings are counted in the summary.
#[derive(Serialize)]
struct SettingsContent<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    settings: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    overrides: Option<Overrides>,
}

#[derive(Serialize)]
struct UncheckedLine<'a> {
    r#type: LineKind,
    #[serde(flatten)]
    content: &'a UncheckedPath,
}

#[derive(Serialize)]
struct SummaryLine<'a> {
    r#type: LineKind,
    schema: u32,
    tool: &'a ToolInfo,
    #[serde(flatten)]
    summary: &'a Summary,
}

fn written(json: serde_json::Result<String>) -> String {
    match json {
        Ok(text) => text,
        // Cannot happen: maps in reports have string keys, and all numbers are finite.
        Err(error) => format!("{{\"error\": \"{}\"}}", error.to_string().escape_default()),
    }
}

/// Writes characters that control a terminal or reorder text as `\u` escapes; the JSON value does not change.
fn harmless(json: &str) -> String {
    let mut out = String::with_capacity(json.len().saturating_add(1));
    for c in json.chars() {
        // serde_json escapes line breaks in strings, so a line break here is layout.
        if c != '\n' && hostile(c) {
            for unit in c.encode_utf16(&mut [0; 2]) {
                let _infallible = write!(out, "\\u{unit:04x}");
            }
        } else {
            out.push(c);
        }
    }
    out.push('\n');
    out
}
