//! Expressions of the data files: the Common Expression Language, wrapped so that no other room sees the crate.
//!
//! Every evaluation is total. Overflow, division by zero and missing keys are errors with a message,
//! whatever values a checkpoint's documents hold.

mod functions;
mod scope;
mod template;

use std::fmt;
use std::sync::{Arc, LazyLock};

use cel::{Env, Program};
use serde::{Deserialize, Deserializer};
use serde_json::Value;

pub use scope::Scope;
pub use template::Template;

/// Characters of an evaluation error that are kept: the crate prints whole operands.
const MESSAGE_CAP: usize = 300;

/// The standard CEL environment, built once.
static ENV: LazyLock<Arc<Env>> = LazyLock::new(|| Arc::new(Env::stdlib()));

/// An expression that could not be evaluated; it names the expression and the cause.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{source_text}`: {cause}")]
pub struct EvalError {
    /// The expression as written.
    pub source_text: String,
    /// What went wrong, capped.
    pub cause: String,
}

/// A text that is not an expression.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{source_text}` is not an expression: {cause}")]
pub struct ParseError {
    /// The text.
    pub source_text: String,
    /// The parser's message, with its place in the text.
    pub cause: String,
}

/// A CEL expression, parsed once. Cloning is cheap.
#[derive(Clone)]
pub struct Expression {
    source: Arc<str>,
    program: Arc<Program>,
}

impl Expression {
    /// Parses `source`.
    ///
    /// # Errors
    /// When it is not CEL.
    pub fn parse(source: &str) -> Result<Self, ParseError> {
        let program = ENV.compile(source).map_err(|errors| ParseError {
            source_text: source.to_owned(),
            cause: errors
                .errors
                .iter()
                .map(|e| format!("column {}: {}", e.pos.1, e.msg))
                .collect::<Vec<_>>()
                .join("; "),
        })?;
        Ok(Self { source: source.into(), program: Arc::new(program) })
    }

    /// The text it was parsed from.
    #[must_use]
    pub fn source(&self) -> &str {
        &self.source
    }

    /// Variables the expression mentions, sorted; those bound by its own macros are included.
    #[must_use]
    pub fn variables(&self) -> Vec<String> {
        let references = self.program.references();
        let mut names: Vec<String> = references.variables().into_iter().map(str::to_owned).collect();
        names.sort();
        names
    }

    /// Evaluates to a JSON value; objects come back with sorted keys.
    ///
    /// # Errors
    /// On a missing key or variable, an overflow, a division by zero, a type that does not fit.
    pub fn eval(&self, scope: &Scope<'_>) -> Result<Value, EvalError> {
        let value = self.program.execute(scope.context()).map_err(|e| self.error(&e))?;
        scope::to_json(&value).ok_or_else(|| self.error(&"the result has no JSON form"))
    }

    /// Evaluates to true or false.
    ///
    /// # Errors
    /// As [`Self::eval`], and when the result is not a boolean.
    pub fn eval_bool(&self, scope: &Scope<'_>) -> Result<bool, EvalError> {
        match self.eval(scope)? {
            Value::Bool(b) => Ok(b),
            other => Err(self.error(&format_args!("true or false expected, got {}", template::plain(&other)))),
        }
    }

    /// Evaluates to a count or a dimension: an integer from 0 to 2^53.
    ///
    /// # Errors
    /// As [`Self::eval`], and when the result is not such an integer.
    pub fn eval_u64(&self, scope: &Scope<'_>) -> Result<u64, EvalError> {
        let value = self.eval(scope)?;
        match value.as_u64() {
            Some(n) if n <= 1 << 53 => Ok(n),
            _ => Err(self.error(&format_args!("a size of 0 to 2^53 expected, got {}", template::plain(&value)))),
        }
    }

    fn error(&self, cause: &dyn fmt::Display) -> EvalError {
        let mut cause = cause.to_string();
        if let Some((at, _)) = cause.char_indices().nth(MESSAGE_CAP) {
            cause.truncate(at);
            cause.push('…');
        }
        EvalError { source_text: self.source.to_string(), cause }
    }
}

impl PartialEq for Expression {
    fn eq(&self, other: &Self) -> bool {
        self.source == other.source
    }
}

impl Eq for Expression {}

impl fmt::Display for Expression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.source)
    }
}

impl fmt::Debug for Expression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`", self.source)
    }
}

impl<'de> Deserialize<'de> for Expression {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let source = String::deserialize(deserializer)?;
        Self::parse(&source).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests;
