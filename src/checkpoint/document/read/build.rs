//! Builds a value from tokens, without recursion and within bounds.

use std::ops::Range;

use serde_json::{Map, Number, Value};

use crate::checkpoint::pointer;
use crate::checkpoint::scan::Token;

/// Python refuses to convert an integer of more digits (`sys.set_int_max_str_digits`, default 4300).
const MAX_DIGITS: usize = 4300;

/// Bytes of text that take as much memory as one value.
const NODE_BYTES: usize = 100;

/// Maximum number of values kept of a document of this name; a long text counts as several.
///
/// A value takes at least 100 bytes, and some 1000 in expressions, so a `[0,0,0,…` of 64 MiB would take gigabytes. An
/// index has a value for each tensor, some hundred thousand in the largest models. The tokenizer files of speech models
/// list up to 65 536 added tokens of seven values; no other published config has a tenth of its limit.
pub(super) fn most_nodes(name: &str) -> usize {
    if name.ends_with(".index.json") {
        400_000
    } else if name.starts_with("tokenizer") {
        1_000_000
    } else {
        100_000
    }
}

/// Longest JSON pointer that a fault can have.
const MAX_POINTER: usize = 4096;

enum Open {
    /// The members so far, and the key of the next value.
    Object(Map<String, Value>, String),
    Array(Vec<Value>, usize),
}

pub(super) struct ValueBuilder {
    stack: Vec<Open>,
    root: Option<Value>,
    nodes: usize,
    most: usize,
    /// Pointers of the containers whose members the value omits.
    omit: Vec<&'static str>,
    /// Byte ranges of the omitted containers.
    omitted: Vec<Range<usize>>,
    /// Depth and first byte of the omitted container, when inside one.
    skipping: Option<(usize, usize)>,
}

impl ValueBuilder {
    pub(super) fn new(omit: Vec<&'static str>, most: usize) -> Self {
        Self { stack: Vec::new(), root: None, nodes: 0, most, omit, omitted: Vec::new(), skipping: None }
    }

    /// Whether the document has more values than the limit.
    pub(super) const fn overflowed(&self) -> bool {
        self.nodes > self.most
    }

    /// The whole value, and the byte ranges of the containers whose members it omits; no value when the document is empty
    /// or exceeds the limit.
    pub(super) fn finish(self) -> (Option<Value>, Vec<Range<usize>>) {
        (if self.overflowed() { None } else { self.root }, self.omitted)
    }

    /// JSON pointer of the next value.
    pub(super) fn pointer(&self) -> Option<String> {
        let mut pointer = String::new();
        for open in &self.stack {
            match open {
                Open::Object(_, key) => pointer::push(&mut pointer, key),
                Open::Array(_, index) => pointer::push(&mut pointer, &index.to_string()),
            }
            if pointer.len() > MAX_POINTER {
                return None;
            }
        }
        Some(pointer)
    }

    /// JSON pointer of the innermost open container; `None` when it is longer than [`MAX_POINTER`].
    pub(super) fn container(&self) -> Option<String> {
        self.pointer().map(|mut p| {
            p.truncate(p.rfind('/').unwrap_or(0));
            p
        })
    }

    /// Adds one token, with its bytes.
    pub(super) fn on_token(&mut self, token: &Token<'_>, span: &Range<usize>) {
        match token {
            Token::Key(key) => {
                if let Some(Open::Object(_, next)) = self.stack.last_mut() {
                    *next = key.decode().0.into_owned();
                    let weight =
                        if self.skipping.is_some() { 0 } else { next.len().checked_div(NODE_BYTES).unwrap_or(0) };
                    self.nodes = self.nodes.saturating_add(weight);
                }
            }
            Token::BeginObject => {
                self.begin(span.start);
                self.stack.push(Open::Object(Map::new(), String::new()));
            }
            Token::BeginArray => {
                self.begin(span.start);
                self.stack.push(Open::Array(Vec::new(), 0));
            }
            Token::EndObject | Token::EndArray => {
                let value = match self.stack.pop() {
                    Some(Open::Object(map, _)) => Value::Object(map),
                    Some(Open::Array(items, _)) => Value::Array(items),
                    None => return,
                };
                match self.skipping {
                    Some((depth, _)) if depth < self.stack.len() => self.advance(),
                    // Only the members of the container are omitted.
                    Some((_, start)) => {
                        self.skipping = None;
                        self.omitted.push(start..span.end);
                        self.push_value(value);
                    }
                    None => self.push_value(value),
                }
            }
            Token::String(text) => self.leaf(|| Value::String(text.decode().0.into_owned())),
            Token::Number(literal) => self.leaf(|| number(literal)),
            Token::NonFinite(_) | Token::Null => self.leaf(|| Value::Null),
            Token::Bool(value) => self.leaf(|| Value::Bool(*value)),
        }
    }

    fn begin(&mut self, start: usize) {
        if self.skipping.is_none() && !self.omit.is_empty() {
            let here = self.pointer();
            if self.omit.iter().any(|p| here.as_deref() == Some(p)) {
                self.skipping = Some((self.stack.len(), start));
            }
        }
    }

    fn leaf(&mut self, make: impl FnOnce() -> Value) {
        if self.skipping.is_some() { self.advance() } else { self.push_value(make()) }
    }

    fn push_value(&mut self, value: Value) {
        let weight = value.as_str().map_or(0, str::len).checked_div(NODE_BYTES).unwrap_or(0);
        self.nodes = self.nodes.saturating_add(weight).saturating_add(1);
        if !self.overflowed() {
            match self.stack.last_mut() {
                Some(Open::Object(map, key)) => {
                    map.insert(std::mem::take(key), value);
                }
                Some(Open::Array(items, _)) => items.push(value),
                None => self.root = Some(value),
            }
        }
        self.advance();
    }

    fn advance(&mut self) {
        if let Some(Open::Array(_, index)) = self.stack.last_mut() {
            *index = index.saturating_add(1);
        }
    }
}

/// A number as an integer or a double, whichever represents it; null when neither does.
pub(super) fn number(literal: &str) -> Value {
    if is_huge(literal) {
        return Value::Null;
    }
    let double = || Number::from_f64(literal.parse().ok()?);
    integer(literal).or_else(double).map_or(Value::Null, Value::Number)
}

/// The integer, if 64 bits hold it.
fn integer(literal: &str) -> Option<Number> {
    literal.parse::<u64>().map(Number::from).or_else(|_| literal.parse::<i64>().map(Number::from)).ok()
}

/// Whether the literal is an integer that only its text holds exactly.
pub(super) fn is_long_integer(literal: &str) -> bool {
    !literal.contains(['.', 'e', 'E']) && integer(literal).is_none()
}

/// Whether JSON readers cannot represent the number: Python refuses integers of more than [`MAX_DIGITS`] digits, and a
/// double becomes infinite.
pub(super) fn is_huge(literal: &str) -> bool {
    literal.len() > MAX_DIGITS
        || (literal.len() > 300 || literal.contains(['e', 'E'])) && !literal.parse::<f64>().is_ok_and(f64::is_finite)
}
