//! The compiled form of an expression.

use cel::common::ast::IdedExpr;
use cel::common::types::CelString;
use cel::common::value::Val;
use cel::{Context, ExecutionError, Value as Cel};

use super::limits;
use super::parsed;
use super::scope::ENV;
use super::steps;

/// A compiled expression. Most expressions of the data files are a number, a flag, or a path such as `c.hidden_size`:
/// these skip CEL's parser, which is slow, and its interpreter.
pub(super) enum Program {
    /// An integer, `true` or `false`.
    Constant(Cel),
    /// A variable, and the keys to follow from it.
    Path { variable: String, keys: Vec<CelString<'static>> },
    /// Any other expression of a built-in file.
    General(Box<IdedExpr>),
    /// Any other expression of a user's file: as parsed, and with counted loops.
    Counted { parsed: Box<IdedExpr>, counted: Box<IdedExpr> },
}

/// Words that are not variables.
const RESERVED: [&str; 4] = ["true", "false", "null", "in"];

impl Program {
    /// Fails with CEL's message, including the column.
    pub fn compile(source: &str, counted: bool) -> Result<Self, String> {
        if counted {
            limits::check(source)?;
        }
        if let Some(simple) = Self::simple(source) {
            return Ok(simple);
        }
        if let Some(expression) = parsed::find(source).filter(|_| !counted) {
            return Ok(Self::General(Box::new(expression)));
        }
        let program = ENV.compile(source).map_err(|errors| {
            let errors = errors.errors.iter().map(|e| format!("column {}: {}", e.pos.1, e.msg));
            errors.collect::<Vec<_>>().join("; ")
        })?;
        let parsed = Box::new(program.expression().clone());
        Ok(if counted {
            let counted = Box::new(steps::count(&parsed));
            Self::Counted { parsed, counted }
        } else {
            Self::General(parsed)
        })
    }

    /// A constant or a path, which needs no parser.
    pub fn simple(source: &str) -> Option<Self> {
        Self::constant(source).or_else(|| Self::path(source))
    }

    fn constant(source: &str) -> Option<Self> {
        let digits = source.bytes().all(|b| b.is_ascii_digit());
        Some(Self::Constant(match source {
            "true" => Cel::Bool(true),
            "false" => Cel::Bool(false),
            _ if digits => Cel::Int(source.parse().ok()?),
            _ => return None,
        }))
    }

    fn path(source: &str) -> Option<Self> {
        let word = |text: &str| {
            let mut bytes = text.bytes();
            let first = bytes.next().is_some_and(|b| b.is_ascii_alphabetic() || b == b'_');
            first && bytes.all(|b| b.is_ascii_alphanumeric() || b == b'_') && !RESERVED.contains(&text)
        };
        if !source.split('.').all(word) {
            return None;
        }
        let mut words = source.split('.').map(str::to_owned);
        let variable = words.next()?;
        Some(Self::Path { variable, keys: words.map(CelString::from).collect() })
    }

    pub fn run(&self, context: &Context<'_, 'static>) -> Result<Cel, ExecutionError> {
        match self {
            Self::Constant(value) => Ok(value.clone()),
            Self::Path { variable, keys } => {
                let undeclared = || ExecutionError::UndeclaredReference(variable.clone().into());
                let root = context.get_variable(variable).ok_or_else(undeclared)?;
                follow(root.as_ref(), keys)
            }
            Self::General(expression) => Cel::resolve(expression, context),
            Self::Counted { counted, .. } => {
                let value = steps::bounded(|| Cel::resolve(counted, context))?;
                if steps::size(&value) > limits::VALUE {
                    let message = "the value is too large".to_owned();
                    return Err(ExecutionError::FunctionError { function: "value".to_owned(), message });
                }
                Ok(value)
            }
        }
    }
}

fn follow(value: &dyn Val, keys: &[CelString<'static>]) -> Result<Cel, ExecutionError> {
    let Some((key, deeper)) = keys.split_first() else { return value.try_into() };
    match value.as_indexer() {
        Some(map) => follow(map.get(key)?.as_ref(), deeper),
        None => Err(ExecutionError::NoSuchKey(key.inner().to_owned().into())),
    }
}
