//! Messages with `{expression}` placeholders.

use std::fmt;

use serde::{Deserialize, Deserializer};

use super::compiled::{EvalError, Expression, ParseError};
use super::limits;
use super::scope::{Scope, plain};
use crate::knowledge::source::Text;

/// A text with `{expression}` placeholders; `{{` and `}}` are literal braces.
#[derive(Clone, PartialEq, Eq)]
pub struct Template {
    source: String,
    pieces: Vec<Piece>,
}

#[derive(Clone, PartialEq, Eq)]
enum Piece {
    Text(String),
    Value(Expression),
}

impl Template {
    /// The text with `0` for each placeholder.
    #[must_use]
    pub fn outline(&self) -> String {
        self.with_placeholders("0")
    }

    /// The text with `…` for each placeholder, for documentation.
    #[must_use]
    pub fn prose(&self) -> String {
        self.with_placeholders("…")
    }

    fn with_placeholders(&self, placeholder: &str) -> String {
        self.pieces.iter().map(|piece| if let Piece::Text(text) = piece { text } else { placeholder }).collect()
    }

    /// Parses `source`.
    ///
    /// # Errors
    /// When a brace is unmatched, or a placeholder is not an expression.
    #[cfg(any(test, feature = "internals"))]
    pub fn parse(source: &str) -> Result<Self, ParseError> {
        super::compile_eagerly(|| Self::from_data_file(source))
    }

    fn from_data_file(source: &str) -> Result<Self, ParseError> {
        let mut pieces = Vec::new();
        let mut text = String::new();
        let mut rest = source;
        let unpaired = |brace| ParseError {
            source_text: source.to_owned(),
            cause: format!("unmatched `{brace}`; double it for a literal brace"),
        };
        while let Some(at) = rest.find(['{', '}']) {
            let (before, tail) = rest.split_at(at);
            text.push_str(before);
            if let Some(after) = tail.strip_prefix("{{") {
                text.push('{');
                rest = after;
            } else if let Some(after) = tail.strip_prefix("}}") {
                text.push('}');
                rest = after;
            } else if let Some(body) = tail.strip_prefix('{') {
                let end = closing_brace(body).ok_or_else(|| unpaired('{'))?;
                if !text.is_empty() {
                    pieces.push(Piece::Text(std::mem::take(&mut text)));
                }
                let (expression, after) = body.split_at(end);
                pieces.push(Piece::Value(Expression::from_data_file(expression)?));
                rest = after.strip_prefix('}').unwrap_or(after);
            } else {
                return Err(unpaired('}'));
            }
        }
        text.push_str(rest);
        if !text.is_empty() {
            pieces.push(Piece::Text(text));
        }
        Ok(Self { source: source.to_owned(), pieces })
    }

    /// The source text.
    #[must_use]
    pub fn source(&self) -> &str {
        &self.source
    }

    /// The expressions of its placeholders, in order.
    pub fn expressions(&self) -> impl Iterator<Item = &Expression> {
        self.pieces.iter().filter_map(|piece| match piece {
            Piece::Value(expression) => Some(expression),
            Piece::Text(_) => None,
        })
    }

    /// The text with evaluated placeholders: strings without quotes, lists as `[2304, 1152]`. A placeholder that fails
    /// becomes `?`, and so does a text of more than a mebibyte.
    #[must_use]
    pub fn render(&self, scope: &Scope<'_>) -> String {
        self.fill(|expression| Ok(expression.eval(scope).map_or_else(|_| "?".to_owned(), |v| plain(&v))))
            .unwrap_or_else(|_| "?".to_owned())
    }

    /// As [`Self::render`], but fails when a placeholder fails.
    ///
    /// # Errors
    /// When a placeholder cannot be evaluated.
    pub fn try_render(&self, scope: &Scope<'_>) -> Result<String, EvalError> {
        self.fill(|expression| expression.eval(scope).map(|v| plain(&v)))
    }

    fn fill(&self, value: impl Fn(&Expression) -> Result<String, EvalError>) -> Result<String, EvalError> {
        let mut out = String::new();
        for piece in &self.pieces {
            match piece {
                Piece::Text(text) => out.push_str(text),
                Piece::Value(expression) => out.push_str(&value(expression)?),
            }
            if out.len() > limits::TEXT {
                let cause = format!("the text is longer than {} bytes", limits::TEXT);
                return Err(EvalError { source_text: self.source.chars().take(80).collect(), cause, expression: None });
            }
        }
        Ok(out)
    }
}

/// Position of the brace that ends the placeholder at the start of `body`, skipping nested braces and quoted strings.
fn closing_brace(body: &str) -> Option<usize> {
    let mut open = 0_usize;
    let mut quote = None;
    let mut escaped = false;
    for (at, c) in body.char_indices() {
        match (quote, c) {
            (Some(_), _) if escaped => escaped = false,
            (Some(_), '\\') => escaped = true,
            (Some(q), c) if c == q => quote = None,
            (None, '"' | '\'') => quote = Some(c),
            (None, '{') => open = open.saturating_add(1),
            (None, '}') => match open.checked_sub(1) {
                Some(less) => open = less,
                None => return Some(at),
            },
            _ => {}
        }
    }
    None
}

impl fmt::Display for Template {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.source)
    }
}

impl fmt::Debug for Template {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.source)
    }
}

impl<'de> Deserialize<'de> for Template {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let Text(source) = Text::deserialize(deserializer)?;
        Self::from_data_file(&source).map_err(serde::de::Error::custom)
    }
}
