//! Parses a document in one pass, into a value and faults.

use crate::checkpoint::files;
use std::ops::Range;

use serde_json::Value;

use super::encoding::{self, Decoded};
use super::{Document, explain};
use crate::checkpoint::fault::Faults;
use crate::checkpoint::lfs::LfsPointer;
use crate::checkpoint::scan::{MAX_DEPTH, ScanError, ScanErrorKind, Scanner, SlipKind, Token};
use crate::checkpoint::sniff::looks_like;
use crate::checkpoint::text::escape;
use crate::checkpoint::{Fault, FaultKind, Place};

mod build;
mod duplicates;
mod spelling;

use build::{ValueBuilder, is_huge};
use duplicates::Duplicates;

/// Pointers of containers whose members a value omits, because the tokenizer holds them in less space.
fn to_omit(name: &str) -> Vec<&'static str> {
    match name {
        files::TOKENIZER => vec!["/model/vocab", "/model/merges"],
        files::VOCAB_JSON => vec![""],
        _ => Vec::new(),
    }
}

impl Document {
    /// Parses a document. Never fails: every problem becomes a fault.
    #[must_use]
    pub fn parse(name: impl Into<String>, bytes: &[u8]) -> Self {
        parse(name.into(), bytes)
    }
}

fn parse(name: String, bytes: &[u8]) -> Document {
    let mut faults = Faults::default();
    if let Some(fault) = not_json_at_all(&name, bytes) {
        let text = std::str::from_utf8(bytes).ok().map(Into::into);
        return Document { name, text, faults: vec![fault], ..Document::default() };
    }
    let Decoded { text, verbatim, faults: of_encoding } = encoding::decode(&name, bytes);
    faults.extend(of_encoding);

    let mut reader = DocumentReader { name: &name, verbatim, faults, left_out: Vec::new() };
    let body = reader.cut_nul_bytes(&text);
    let value = reader.read(body);
    if let Some(value) = &value
        && !value.is_object()
        && to_omit(&name) != [""]
        // The list of modules of sentence-transformers.
        && name != files::MODULES
    {
        let found = kind_of(value);
        reader.faults.push(Fault::new(FaultKind::NotAnObject).at(Place::file(&*name)).with("found", found));
    }
    let DocumentReader { faults, left_out, .. } = reader;
    let text = verbatim.then(|| text.into());
    Document { name, text, value, left_out, not_read: None, faults: faults.into_vec() }
}

/// Recognises files that are not JSON documents: empty, LFS pointers, NUL bytes, other formats.
fn not_json_at_all(name: &str, bytes: &[u8]) -> Option<Fault> {
    let place = Place::file(name);
    if bytes.trim_ascii().is_empty() {
        return Some(Fault::new(FaultKind::EmptyDocument).at(place).with("size", bytes.len()));
    }
    if let Some(pointer) = LfsPointer::parse(bytes) {
        return Some(Fault::new(FaultKind::LfsPointer).at(place).with("oid", pointer.oid).with("size", pointer.size));
    }
    if bytes.iter().all(|b| *b == 0) {
        return Some(Fault::new(FaultKind::NulBytes).at(place).with("count", bytes.len()).with("all", true));
    }
    let what = looks_like(bytes)?;
    Some(Fault::new(FaultKind::HtmlInstead).at(place).with("looks_like", what))
}

fn kind_of(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "a boolean",
        Value::Number(_) => "a number",
        Value::String(_) => "a string",
        Value::Array(_) => "an array",
        Value::Object(_) => "an object",
    }
}

struct DocumentReader<'n> {
    name: &'n str,
    verbatim: bool,
    faults: Faults,
    left_out: Vec<Range<usize>>,
}

impl DocumentReader<'_> {
    /// A place at `span`; the file alone when spans of the text are not offsets of the file.
    fn place(&self, span: Range<usize>) -> Place {
        let place = Place::file(self.name);
        if self.verbatim { place.span(span) } else { place }
    }

    /// Reports NUL bytes, and returns the text before them if only NUL bytes follow.
    fn cut_nul_bytes<'t>(&mut self, text: &'t str) -> &'t str {
        let Some(first) = text.find('\0') else { return text };
        let count = text.bytes().filter(|b| *b == 0).count();
        let place = self.place(first..first.saturating_add(1));
        self.faults.push(Fault::new(FaultKind::NulBytes).at(place).with("count", count).with("all", false));
        text.get(..first).filter(|_| text.trim_end_matches('\0').len() == first).unwrap_or(text)
    }

    /// Parses the text, or the rest of it without conflict markers.
    fn read(&mut self, text: &str) -> Option<Value> {
        let (value, error) = self.pass(text);
        let Some(error) = error else { return value };
        let markers = explain::conflict_markers(text);
        if error.kind != ScanErrorKind::TooDeep && !markers.is_empty() {
            for (span, marker) in &markers {
                let fault = Fault::new(FaultKind::MergeConflictMarker).at(self.place(span.clone()));
                self.faults.push(fault.with("marker", *marker));
            }
            // The second pass only produces the value; its faults would be consequences of the markers.
            let faults = std::mem::take(&mut self.faults);
            let (value, error) = self.pass(&explain::blank(text, &markers));
            self.faults = faults;
            return value.filter(|_| error.is_none());
        }
        self.push_scan_fault(text, &error);
        value.filter(|_| error.kind == ScanErrorKind::Trailing)
    }

    /// Scans the text once: returns the value, if complete, and the error that ended the pass early.
    fn pass(&mut self, text: &str) -> (Option<Value>, Option<ScanError>) {
        let start = if text.starts_with('\u{feff}') { '\u{feff}'.len_utf8() } else { 0 };
        let mut scanner = Scanner::lenient(text, start);
        let mut builder = ValueBuilder::new(to_omit(self.name), build::most_nodes(self.name));
        let mut duplicates = Duplicates::new(text);
        let error = loop {
            let (token, span) = match scanner.next() {
                Ok(Some(step)) => step,
                Ok(None) => break None,
                Err(error) => break Some(error),
            };
            duplicates.on_token(&token, &span, &builder);
            self.on_token(&token, &span, &builder);
            builder.on_token(&token, &span);
        };
        for slip in &scanner.slips {
            let kind = match slip.kind {
                SlipKind::TrailingComma => FaultKind::TrailingComma,
                SlipKind::MissingComma => FaultKind::MissingComma,
                SlipKind::Comment => FaultKind::CommentInJson,
                SlipKind::SingleQuotes => FaultKind::SingleQuotedString,
            };
            let fault = Fault::new(kind).at(self.place(slip.span.clone()));
            self.faults.push(fault);
        }
        for found in duplicates.into_found() {
            let mut place = self.place(found.later);
            place.pointer = found.pointer;
            let first = self.place(found.first);
            let fault = Fault::new(FaultKind::DuplicateJsonKey).at(place).at(first);
            self.faults.push(fault.with("key", escape(&found.key, 200)).with("equal", found.equal));
        }
        if builder.overflowed() {
            let fault = Fault::new(FaultKind::JsonTooManyValues).at(Place::file(self.name));
            self.faults.push(fault.with("cap", build::most_nodes(self.name)));
        }
        let value;
        (value, self.left_out) = builder.finish();
        (value, error)
    }

    /// Faults of single tokens.
    fn on_token(&mut self, token: &Token<'_>, span: &Range<usize>, builder: &ValueBuilder) {
        let fault = match token {
            Token::NonFinite(literal) => Fault::new(FaultKind::NonFiniteNumber).with("literal", *literal),
            Token::Number(literal) if is_huge(literal) => {
                Fault::new(FaultKind::HugeNumber).with("literal", escape(literal, 24)).with("digits", literal.len())
            }
            Token::String(text) | Token::Key(text) if text.decode().1 => Fault::new(FaultKind::LoneSurrogate),
            _ => return,
        };
        let mut place = self.place(span.clone());
        place.pointer = builder.pointer();
        self.faults.push(fault.at(place));
    }

    /// Turns the error that ended a pass into a fault.
    fn push_scan_fault(&mut self, text: &str, error: &ScanError) {
        let found = text.get(error.span.clone()).unwrap_or_default().trim_end();
        let place = self.place(error.span.start..error.span.start.saturating_add(found.len()));
        self.faults.push(match error.kind {
            ScanErrorKind::TooDeep => Fault::new(FaultKind::JsonTooDeep).at(place).with("cap", MAX_DEPTH),
            ScanErrorKind::Syntax(reason) => {
                Fault::new(FaultKind::JsonSyntax).at(place).with("reason", reason).with("found", escape(found, 40))
            }
            ScanErrorKind::Trailing => {
                if let Some(section) = explain::ini_section(found) {
                    Fault::new(FaultKind::AppendedSection).at(place).with("section", escape(section, 80))
                } else {
                    let what = explain::trailing(found);
                    Fault::new(FaultKind::TrailingContent).at(place).with("what", what).with("bytes", found.len())
                }
            }
        });
    }
}
