//! Layout of a document, so that inserted text looks like its neighbours.

use std::io;
use std::ops::Range;

use serde::Serialize as _;
use serde_json::Value;
use serde_json::ser::{Formatter, PrettyFormatter, Serializer};

use super::container::{Container, DocumentMember};
use super::splice::Splice;

/// Layout: line ends and indentation.
pub(super) struct Layout {
    /// Line end; `None` when the document is a single line.
    line: Option<&'static str>,
    /// One level of indentation.
    unit: String,
}

impl Layout {
    /// Derives the layout from the first line break and the indentation that follows.
    pub(super) fn from_text(text: &str) -> Self {
        let body = text.trim();
        let line = match body.find('\n').and_then(|at| body.get(..at)) {
            Some(first) if first.ends_with('\r') => Some("\r\n"),
            Some(_) => Some("\n"),
            None => None,
        };
        let indent = body.lines().skip(1).map(indent_of).find(|indent| !indent.is_empty());
        Self { line, unit: indent.unwrap_or("  ").to_owned() }
    }

    /// Replaces the text at `range` with the value.
    pub(super) fn replaced(&self, text: &str, range: Range<usize>, value: &Value) -> Splice {
        let was_inline = text.get(range.clone()).is_some_and(|old| old.len() > 2 && !old.contains('\n'));
        let container = text.get(range.clone()).is_some_and(|old| old.starts_with(['{', '[']));
        let rendered = if self.line.is_none() || (was_inline && container) {
            one_line(value, ": ", ", ")
        } else {
            self.lines(value, line_indent(text, range.start))
        };
        Splice { range, text: rendered }
    }

    /// Appends a member after the last one.
    pub(super) fn inserted(&self, text: &str, container: &Container, name: &str, value: &Value) -> Splice {
        let Some(last) = container.members.last() else { return self.first(text, container, name, value) };
        let before = container.members.iter().rev().nth(1);
        let gap_start = before.map_or(container.range.start.saturating_add(1), |m| m.value.end);
        let gap = text.get(gap_start..last.start()).unwrap_or_default();
        let colon = colon_of(text, last);
        let key = if container.is_object { format!("{}{colon}", quoted(name)) } else { String::new() };
        let lead = if gap.contains('\n') {
            format!("{}{}", self.line.unwrap_or("\n"), line_indent(text, last.start()))
        } else if before.is_some() {
            gap.rsplit(',').next().filter(|g| g.trim().is_empty()).unwrap_or(" ").to_owned()
        } else {
            if colon.ends_with(' ') { " " } else { "" }.to_owned()
        };
        let value = if gap.contains('\n') {
            self.lines(value, line_indent(text, last.start()))
        } else {
            one_line(value, colon, if colon.ends_with(' ') { ", " } else { "," })
        };
        let at = last.value.end;
        Splice { range: at..at, text: format!(",{lead}{key}{value}") }
    }

    /// Adds the first member of an empty container.
    fn first(&self, text: &str, container: &Container, name: &str, value: &Value) -> Splice {
        let key = if container.is_object { format!("{}: ", quoted(name)) } else { String::new() };
        let (open, close) = if container.is_object { ('{', '}') } else { ('[', ']') };
        let text = match self.line {
            Some(line) => {
                let indent = line_indent(text, container.range.start);
                let inner = format!("{indent}{}", self.unit);
                format!("{open}{line}{inner}{key}{}{line}{indent}{close}", self.lines(value, &inner))
            }
            None => format!("{open}{key}{}{close}", one_line(value, ": ", ", ")),
        };
        Splice { range: container.range.clone(), text }
    }

    /// The value over several lines if it is a container; all lines but the first are indented.
    fn lines(&self, value: &Value, indent: &str) -> String {
        let mut out = Vec::new();
        let mut serializer = Serializer::with_formatter(&mut out, PrettyFormatter::with_indent(self.unit.as_bytes()));
        // Serialising a JSON value to a Vec cannot fail.
        let _infallible = value.serialize(&mut serializer);
        let text = String::from_utf8(out).unwrap_or_default();
        text.replace('\n', &format!("{}{indent}", self.line.unwrap_or("\n")))
    }
}

/// The indentation of the line that contains byte `at`.
fn line_indent(text: &str, at: usize) -> &str {
    let start = text.get(..at).and_then(|before| before.rfind('\n')).map_or(0, |n| n.saturating_add(1));
    text.get(start..).map_or("", indent_of)
}

fn indent_of(line: &str) -> &str {
    let end = line.find(|c| c != ' ' && c != '\t').unwrap_or(line.len());
    line.get(..end).unwrap_or_default()
}

/// The text between a member's key and its value.
fn colon_of<'t>(text: &'t str, member: &DocumentMember) -> &'t str {
    let between = member.key.as_ref().and_then(|key| text.get(key.end..member.value.start));
    between.filter(|b| b.trim() == ":" && !b.contains('\n')).unwrap_or(": ")
}

fn quoted(name: &str) -> String {
    Value::from(name).to_string()
}

/// The value on one line.
fn one_line(value: &Value, colon: &str, comma: &str) -> String {
    let mut out = Vec::new();
    let mut serializer = Serializer::with_formatter(&mut out, OneLine { colon, comma });
    let _infallible = value.serialize(&mut serializer);
    String::from_utf8(out).unwrap_or_default()
}

struct OneLine<'a> {
    colon: &'a str,
    comma: &'a str,
}

impl Formatter for OneLine<'_> {
    fn begin_array_value<W: io::Write + ?Sized>(&mut self, out: &mut W, first: bool) -> io::Result<()> {
        if first { Ok(()) } else { out.write_all(self.comma.as_bytes()) }
    }

    fn begin_object_key<W: io::Write + ?Sized>(&mut self, out: &mut W, first: bool) -> io::Result<()> {
        if first { Ok(()) } else { out.write_all(self.comma.as_bytes()) }
    }

    fn begin_object_value<W: io::Write + ?Sized>(&mut self, out: &mut W) -> io::Result<()> {
        out.write_all(self.colon.as_bytes())
    }
}
