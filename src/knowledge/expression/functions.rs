//! Functions for the expressions of data files, in addition to those of CEL.

use cel::common::types::{CelNull, CelString};
use cel::common::value::Val;
use cel::{ExecutionError, FunctionContext, Value as Cel};
use serde_json::Value;

use super::compiled::{EvalError, Expression};
use super::scope::{Scope, plain};
use super::steps;
use crate::checkpoint::file_size;

/// Maximum length of a list from `range`.
const RANGE_CAP: i64 = 100_000;
/// Maximum number of items that `join` prints.
const JOIN_CAP: usize = 5;

type FunctionResult = Result<Value, String>;

impl Scope<'static> {
    /// A root scope with the standard functions of CEL and those of the data files:
    /// `pow isqrt sqrt sum floor ceil range min max get keys zpad glob`.
    #[must_use]
    pub fn new() -> Self {
        let mut scope = Self::bare();
        register(&mut scope);
        scope
    }
}

impl Default for Scope<'static> {
    fn default() -> Self {
        Self::new()
    }
}

/// Whether expressions of data files have a function of this name, of CEL or of this module.
///
/// The crate does not list its functions, so one is called: an unknown one is an undeclared reference.
pub(crate) fn is_function(name: &str) -> bool {
    let scope = Scope::new();
    let undeclared = |error: EvalError| error.cause.starts_with("Undeclared reference");
    let unknown = |call: String| Expression::parse(&call).is_ok_and(|call| call.eval(&scope).is_err_and(undeclared));
    // Some are functions of a string only: `text.startsWith(other)`.
    !unknown(format!("{name}()")) || !unknown(format!("''.{name}('')"))
}

/// Adds all functions to a root scope.
fn register(scope: &mut Scope<'static>) {
    scope.function("pow", pow);
    scope.function("isqrt", isqrt);
    scope.function("sqrt", |a| match a {
        [n] => {
            n.as_f64().filter(|n| *n >= 0.0).map(|n| n.sqrt().into()).ok_or_else(|| format!("{n} has no square root"))
        }
        _ => Err("sqrt(n) takes one number".to_owned()),
    });
    scope.function("sum", sum);
    scope.function("floor", |a| round(a, f64::floor));
    scope.function("ceil", |a| round(a, f64::ceil));
    scope.function("range", range);
    scope.function("keys", keys);
    scope.function("split", split);
    scope.function("zpad", zpad);
    scope.function("join", join);
    scope.function("plural", plural);
    scope.function("filesize", |a| match a {
        [n] => n.as_u64().map(|n| file_size(n).into()).ok_or_else(|| "filesize(n) takes a number of bytes".to_owned()),
        _ => Err("filesize(n) takes one number".to_owned()),
    });
    scope.function("glob", |a| match a {
        [Value::String(name), Value::String(pattern)] => Ok(glob(name, pattern).into()),
        _ => Err("glob(name, pattern) takes two strings".to_owned()),
    });
    scope.add("min", cel::functions::min);
    scope.add("max", cel::functions::max);
    scope.add("get", get);
    steps::register(scope);
}

/// The words of a text, in lower case, between separators; a list is its words already. As `pos_att_type: "p2c|c2p"`.
fn split(arguments: &[Value]) -> FunctionResult {
    match arguments {
        [Value::String(text), Value::String(separator)] => {
            Ok(text.to_lowercase().split(separator.as_str()).map(|word| Value::from(word.trim())).collect())
        }
        [list @ (Value::Array(_) | Value::Null), Value::String(_)] => Ok(list.clone()),
        _ => Err("split(text, separator) takes a text, or a list, and a text".to_owned()),
    }
}

fn pow(arguments: &[Value]) -> FunctionResult {
    let usage = || "pow(base, exponent) takes two integers, the exponent from 0".to_owned();
    let [base, exponent] = arguments else { return Err(usage()) };
    let (Some(base), Some(exponent)) = (base.as_i64(), exponent.as_u64()) else { return Err(usage()) };
    let exponent = u32::try_from(exponent).map_err(|_| usage())?;
    base.checked_pow(exponent).map(Value::from).ok_or_else(|| format!("{base}^{exponent} overflows"))
}

/// The integer part of an integer's square root.
fn isqrt(arguments: &[Value]) -> FunctionResult {
    match arguments {
        [n] => {
            n.as_i64().and_then(i64::checked_isqrt).map(Value::from).ok_or_else(|| format!("{n} has no square root"))
        }
        _ => Err("isqrt(n) takes one integer".to_owned()),
    }
}

/// The sum of a list of integers, or of numbers when one is not an integer.
fn sum(arguments: &[Value]) -> FunctionResult {
    let [Value::Array(items)] = arguments else { return Err("sum(list) takes one list of numbers".to_owned()) };
    if let Some(integers) = items.iter().map(Value::as_i64).collect::<Option<Vec<_>>>() {
        let total = integers.into_iter().try_fold(0_i64, i64::checked_add);
        return total.map(Value::from).ok_or_else(|| "the sum overflows".to_owned());
    }
    let numbers = items.iter().map(Value::as_f64).collect::<Option<Vec<_>>>();
    numbers.map(|n| n.into_iter().sum::<f64>().into()).ok_or_else(|| "sum(list) takes numbers only".to_owned())
}

fn round(arguments: &[Value], to: fn(f64) -> f64) -> FunctionResult {
    match arguments {
        [Value::Number(n)] if n.is_i64() => Ok(Value::Number(n.clone())),
        [Value::Number(n)] => {
            let rounded = n.as_f64().map_or(f64::NAN, to);
            // Up to 2^53 a double is exact, and no size is larger.
            if rounded.abs() <= 9_007_199_254_740_992.0 {
                #[expect(clippy::cast_possible_truncation, reason = "whole and within 2^53")]
                let whole = rounded as i64;
                Ok(whole.into())
            } else {
                Err(format!("{n} is out of range"))
            }
        }
        _ => Err("one number expected".to_owned()),
    }
}

fn range(arguments: &[Value]) -> FunctionResult {
    match arguments {
        [n] => match n.as_i64() {
            Some(n) if n <= RANGE_CAP => Ok((0..n).collect::<Vec<_>>().into()),
            _ => Err(format!("range(n) takes an integer up to {RANGE_CAP}")),
        },
        _ => Err("range(n) takes one integer".to_owned()),
    }
}

fn keys(arguments: &[Value]) -> FunctionResult {
    match arguments {
        [Value::Object(map)] => Ok(map.keys().cloned().collect::<Vec<_>>().into()),
        _ => Err("keys(map) takes one map".to_owned()),
    }
}

fn zpad(arguments: &[Value]) -> FunctionResult {
    match arguments {
        [n, width] => match (n.as_u64(), width.as_u64()) {
            (Some(n), Some(width @ 0..=64)) => {
                let digits = n.to_string();
                let zeros = usize::try_from(width).unwrap_or(0).saturating_sub(digits.len());
                Ok(format!("{}{digits}", "0".repeat(zeros)).into())
            }
            _ => Err("zpad(n, width) takes two integers from 0, the width up to 64".to_owned()),
        },
        _ => Err("zpad(n, width) takes two integers".to_owned()),
    }
}

/// `join(list)`: `a, b, c`, or `a, b, c, d, e and 3 more`.
fn join(arguments: &[Value]) -> FunctionResult {
    let [Value::Array(items)] = arguments else { return Err("join(list) takes one list".to_owned()) };
    let shown = items.iter().take(JOIN_CAP).map(plain).collect::<Vec<_>>().join(", ");
    match items.len().checked_sub(JOIN_CAP) {
        None | Some(0) => Ok(shown.into()),
        Some(more) => Ok(format!("{shown} and {more} more").into()),
    }
}

/// `plural(n, 'tensor')`: `1 tensor`, `2 tensors`.
fn plural(arguments: &[Value]) -> FunctionResult {
    match arguments {
        [n, Value::String(noun)] if n.is_number() => {
            Ok(format!("{n} {noun}{}", if n.as_u64() == Some(1) { "" } else { "s" }).into())
        }
        _ => Err("plural(n, noun) takes a number and a string".to_owned()),
    }
}

/// `get(map, key, default)`: the default when the key is absent or null, or when `map` is null.
///
/// Looks into the borrowed map: turning a whole document into JSON for one key would be dear.
fn get(context: &FunctionContext) -> Result<Cel, ExecutionError> {
    let mut arguments = context.this.iter().chain(&context.args);
    let (Some(map), Some(key), Some(default), None) =
        (arguments.next(), arguments.next(), arguments.next(), arguments.next())
    else {
        return Err(context.error("get(map, key, default) takes three arguments"));
    };
    let is_null = |value: &dyn Val| value.downcast_ref::<CelNull>().is_some();
    if is_null(map.as_ref()) {
        return default.as_ref().try_into();
    }
    let (Some(indexer), Some(_)) = (map.as_ref().as_indexer(), key.as_ref().downcast_ref::<CelString>()) else {
        return Err(context.error("get(map, key, default) takes a map and a string"));
    };
    match indexer.get(key.as_ref()) {
        Ok(found) if !is_null(found.as_ref()) => found.as_ref().try_into(),
        Ok(_) | Err(ExecutionError::NoSuchKey(_)) => default.as_ref().try_into(),
        Err(e) => Err(e),
    }
}

/// Whether `name` matches `pattern`, in which `*` is any run of characters and `?` any one.
///
/// Linear in memory, and in time at most the product of the two lengths.
#[must_use]
pub(crate) fn glob(name: &str, pattern: &str) -> bool {
    let (name, pattern): (Vec<char>, Vec<char>) = (name.chars().collect(), pattern.chars().collect());
    let (mut n, mut p) = (0, 0);
    let mut retry: Option<(usize, usize)> = None;
    while let Some(c) = name.get(n) {
        match pattern.get(p) {
            Some('*') => {
                retry = Some((p, n));
                p = p.saturating_add(1);
            }
            Some(q) if *q == '?' || q == c => {
                n = n.saturating_add(1);
                p = p.saturating_add(1);
            }
            _ => match &mut retry {
                Some((star, from)) => {
                    *from = from.saturating_add(1);
                    (p, n) = (star.saturating_add(1), *from);
                }
                None => return false,
            },
        }
    }
    pattern.get(p..).is_some_and(|rest| rest.iter().all(|c| *c == '*'))
}

#[cfg(test)]
mod tests {
    use super::is_function;

    #[test]
    fn functions_are_told_from_unknown_names() {
        for name in
            ["size", "startsWith", "contains", "matches", "int", "string", "double", "type", "get", "min", "pow"]
        {
            assert!(is_function(name), "{name}");
        }
        for name in ["shap", "len", "exec"] {
            assert!(!is_function(name), "{name}");
        }
    }
}
