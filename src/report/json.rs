//! The JSON contract: complete and indented, or a line for each finding.

use std::fmt::Write as _;

use serde::Serialize;

use super::Report;
use super::format::hostile;
use super::model::{Role, Summary, ToolInfo};

pub fn render(report: &Report) -> String {
    pretty(report)
}

/// Any JSON, indented and safe to show.
pub fn pretty<T: Serialize>(value: &T) -> String {
    harmless(&written(serde_json::to_string_pretty(value)))
}

/// A finding in a line of its own; the summary is the last line.
///
/// Every line is an object, and `type` says of what: `finding`, `seam` or `summary`. Keys are those of the contract.
pub fn lines(report: &Report) -> String {
    let mut lines = Vec::new();
    for checkpoint in &report.checkpoints {
        let (path, role) = (&checkpoint.path, checkpoint.role.as_ref());
        let line = |finding| JsonLine { r#type: LineKind::Finding, path, role, said: finding };
        lines.extend(checkpoint.findings.iter().map(|f| written(serde_json::to_string(&line(f)))));
    }
    if let Some(merge) = &report.merge {
        let line = |seam| JsonLine { r#type: LineKind::Seam, path: &merge.out, role: None, said: seam };
        lines.extend(merge.seams.iter().map(|s| written(serde_json::to_string(&line(s)))));
    }
    let summary =
        SummaryLine { r#type: LineKind::Summary, schema: report.schema, tool: &report.tool, summary: &report.summary };
    lines.push(written(serde_json::to_string(&summary)));
    harmless(&lines.join("\n"))
}

/// What a line tells of.
#[derive(Serialize)]
#[serde(rename_all = "lowercase")]
enum LineKind {
    Finding,
    Seam,
    Summary,
}

#[derive(Serialize)]
struct JsonLine<'a, T> {
    r#type: LineKind,
    /// The checkpoint, as the user named it; for a seam, where the merge was to go.
    path: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    role: Option<&'a Role>,
    #[serde(flatten)]
    said: &'a T,
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
        // Maps here have string keys and every number is finite, so this is for readers only.
        Err(error) => format!("{{\"error\": \"{}\"}}", error.to_string().escape_default()),
    }
}

/// Spells characters that steer a terminal or reorder text as `\u` escapes: the same JSON, safe to show.
fn harmless(json: &str) -> String {
    let mut out = String::with_capacity(json.len().saturating_add(1));
    for c in json.chars() {
        // serde_json has escaped everything below U+0020, so a line break here is layout.
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
