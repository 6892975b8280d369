//! Expressions: compiled while their file is parsed, or at the first evaluation.

use std::borrow::Borrow;
use std::cell::RefCell;
use std::collections::{BTreeSet, HashSet};
use std::fmt;
use std::hash::{Hash, Hasher};
use std::sync::{Arc, OnceLock};

use cel::Value as Cel;
use serde::{Deserialize, Deserializer};
use serde_json::Value;

use super::program::Program;
use super::scope::{self, Scope};
use super::steps;
use crate::knowledge::source::Text;

/// Maximum length of an evaluation error in characters: the crate prints whole operands.
const MESSAGE_CAP: usize = 300;

/// An expression that could not be evaluated, with the cause.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{source_text}`: {cause}")]
pub struct EvalError {
    /// The expression as written.
    pub source_text: String,
    /// The cause, capped.
    pub cause: String,
    /// The expression, for those who look up what it reads; `None` where a text around expressions failed.
    pub expression: Option<Expression>,
}

/// A text that is not a valid expression.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{source_text}` is not an expression: {cause}")]
pub struct ParseError {
    /// The text.
    pub source_text: String,
    /// The parser's message, with the position in the text.
    pub cause: String,
}

/// A CEL expression. Cloning is cheap.
///
/// The built-in data files contain thousands of expressions, and a run needs a few, so those are compiled at their
/// first evaluation.
#[derive(Clone)]
pub struct Expression(Arc<Inner>);

struct Inner {
    source: Box<str>,
    /// Whether the expression comes from a user's file, so that its steps are counted.
    counted: bool,
    program: OnceLock<Result<Program, String>>,
}

/// How the current file is parsed; serde cannot pass this to a deserialiser.
#[derive(Default)]
struct Reading {
    /// Whether an invalid expression is an error of the file, with its position.
    at_once: bool,
    /// Expressions of the file so far; duplicates are compiled once.
    seen: Option<HashSet<Expression>>,
}

thread_local! {
    static READING: RefCell<Reading> = RefCell::default();
}

/// Parses a user's data file with `read`: an invalid expression is an error with its position.
pub(crate) fn compile_eagerly<T>(read: impl FnOnce() -> T) -> T {
    reading(true, read)
}

/// Parses a built-in data file with `read`: its expressions are compiled at their first evaluation.
pub(crate) fn compile_lazily<T>(read: impl FnOnce() -> T) -> T {
    reading(false, read)
}

fn reading<T>(at_once: bool, read: impl FnOnce() -> T) -> T {
    /// Restores the outer mode, also after a panic.
    struct RestoreReading(Reading);
    impl Drop for RestoreReading {
        fn drop(&mut self) {
            READING.set(std::mem::take(&mut self.0));
        }
    }
    let _before = RestoreReading(READING.replace(Reading { at_once, seen: Some(HashSet::new()) }));
    read()
}

impl Expression {
    /// Parses `source`.
    ///
    /// # Errors
    /// [`ParseError`] when the text is not valid CEL.
    pub fn parse(source: &str) -> Result<Self, ParseError> {
        let expression = Self(Arc::new(Inner { source: source.into(), counted: true, program: OnceLock::new() }));
        match expression.program() {
            Ok(_) => Ok(expression),
            Err(cause) => Err(ParseError { source_text: shortened(source), cause: cause.to_owned() }),
        }
    }

    /// The expression for a text of the file that is being parsed.
    pub(super) fn from_data_file(source: &str) -> Result<Self, ParseError> {
        let (at_once, seen) =
            READING.with_borrow(|r| (r.at_once, r.seen.as_ref().and_then(|seen| seen.get(source).cloned())));
        if let Some(seen) = seen {
            return Ok(seen);
        }
        let expression = if at_once {
            Self::parse(source)?
        } else {
            #[cfg(test)]
            super::parsed::tests::record(source);
            Self(Arc::new(Inner { source: source.into(), counted: false, program: OnceLock::new() }))
        };
        READING.with_borrow_mut(|r| Some(r.seen.as_mut()?.insert(expression.clone())));
        Ok(expression)
    }

    pub(super) fn program(&self) -> Result<&Program, &str> {
        let program = self.0.program.get_or_init(|| Program::compile(&self.0.source, self.0.counted));
        program.as_ref().map_err(String::as_str)
    }

    /// The source text.
    #[must_use]
    pub fn source(&self) -> &str {
        &self.0.source
    }

    /// Variables of the expression, without those that its loops bind.
    #[must_use]
    pub fn variables(&self) -> BTreeSet<String> {
        self.references().paths.into_iter().filter_map(|path| path.into_iter().next()).collect()
    }

    /// Evaluates to a JSON value; objects have sorted keys.
    ///
    /// # Errors
    /// On a missing key or variable, an overflow, a division by zero, or a type mismatch.
    pub fn eval(&self, scope: &Scope<'_>) -> Result<Value, EvalError> {
        let value = self.value(scope)?;
        scope::to_json(&value).ok_or_else(|| self.error(&"the result cannot be converted to JSON"))
    }

    /// Evaluates the expression and binds the result to `name` in the same scope.
    ///
    /// # Errors
    /// As [`Self::eval`].
    pub(crate) fn bind(&self, name: &str, scope: &mut Scope<'_>) -> Result<(), EvalError> {
        let value = self.value(scope)?.try_into().map_err(|e| self.error(&e))?;
        scope.bind_val(name, value);
        Ok(())
    }

    fn value(&self, scope: &Scope<'_>) -> Result<Cel, EvalError> {
        steps::spend(1).map_err(|cause| self.error(&cause))?;
        self.program().map_err(|cause| self.error(&cause))?.run(scope.context()).map_err(|e| self.error(&e))
    }

    /// Evaluates to true or false.
    ///
    /// # Errors
    /// As [`Self::eval`], and when the result is not a boolean.
    pub fn eval_bool(&self, scope: &Scope<'_>) -> Result<bool, EvalError> {
        match self.value(scope)? {
            Cel::Bool(b) => Ok(b),
            other => Err(self.unfit("true or false", &other)),
        }
    }

    /// Evaluates to a count or a dimension: an integer from 0 to 2^53.
    ///
    /// # Errors
    /// As [`Self::eval`], and when the result is not such an integer.
    pub fn eval_u64(&self, scope: &Scope<'_>) -> Result<u64, EvalError> {
        let value = self.value(scope)?;
        match value {
            Cel::Int(n @ 0..=0x20_0000_0000_0000) => Ok(n.unsigned_abs()),
            _ => Err(self.unfit("an integer from 0 to 2^53", &value)),
        }
    }

    fn unfit(&self, wanted: &str, value: &Cel) -> EvalError {
        let value = scope::to_json(value).unwrap_or(Value::Null);
        self.error(&format_args!("{wanted} expected, got {}", scope::plain(&value)))
    }

    fn error(&self, cause: &dyn fmt::Display) -> EvalError {
        let mut cause = cause.to_string();
        if let Some((at, _)) = cause.char_indices().nth(MESSAGE_CAP) {
            cause.truncate(at);
            cause.push('…');
        }
        EvalError { source_text: shortened(&self.0.source), cause, expression: Some(self.clone()) }
    }
}

/// The text of an expression for an error.
fn shortened(source: &str) -> String {
    match source.char_indices().nth(MESSAGE_CAP) {
        Some((at, _)) => format!("{}…", source.get(..at).unwrap_or_default()),
        None => source.to_owned(),
    }
}

impl PartialEq for Expression {
    fn eq(&self, other: &Self) -> bool {
        self.0.source == other.0.source
    }
}

impl Eq for Expression {}

impl Hash for Expression {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.source().hash(state);
    }
}

impl Borrow<str> for Expression {
    fn borrow(&self) -> &str {
        self.source()
    }
}

impl fmt::Display for Expression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0.source)
    }
}

impl fmt::Debug for Expression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`", self.0.source)
    }
}

impl<'de> Deserialize<'de> for Expression {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let Text(source) = Text::deserialize(deserializer)?;
        Self::from_data_file(&source).map_err(serde::de::Error::custom)
    }
}
