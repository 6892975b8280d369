//! The JSON contract, complete and indented.

use std::fmt::Write as _;

use super::Report;
use super::words::hostile;

pub fn render(report: &Report) -> String {
    let text = match serde_json::to_string_pretty(report) {
        Ok(text) => text,
        // Maps here have string keys and every number is finite, so this is for readers only.
        Err(error) => format!("{{\"error\": \"{}\"}}", error.to_string().escape_default()),
    };
    harmless(&text)
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
