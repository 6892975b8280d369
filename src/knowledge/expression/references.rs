//! The names that an expression uses, for the validation of recipes before any donor is opened.

use cel::common::ast::{CallExpr, ComprehensionExpr, EntryExpr, Expr, IdedExpr, LiteralValue, SelectExpr, operators};

use super::compiled::Expression;
use super::program::Program;

/// The names that an expression uses.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct References {
    /// Each variable that a loop of the expression does not bind, with the keys that follow it: `opt.rows` is
    /// `["opt", "rows"]`. The key that `has(…)` tests is not among them.
    pub paths: Vec<Vec<String>>,
    /// Each call of a function, operators excluded.
    pub calls: Vec<FunctionCall>,
    /// Strings in the expression that may be its result: `'pad'` of `a ? 'pad' : b`.
    pub results: Vec<String>,
}

/// A call of a function.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FunctionCall {
    /// Name of the function.
    pub function: String,
    /// Its arguments; `None` for one that is not a string in the expression.
    pub arguments: Vec<Option<String>>,
}

impl Expression {
    /// The names that the expression uses; nothing for a text that is not an expression.
    #[must_use]
    pub fn references(&self) -> References {
        let mut references = References::default();
        match self.program() {
            Ok(Program::Path { variable, keys }) => {
                let keys = keys.iter().map(|key| key.inner().to_owned());
                references.paths.push([variable.clone()].into_iter().chain(keys).collect());
            }
            Ok(Program::General(parsed) | Program::Counted { parsed, .. }) => references.read(parsed),
            Ok(Program::Constant(_)) | Err(_) => {}
        }
        references
    }
}

/// A part of an expression that is still to be read, and the names that the loops around it bind.
type Pending<'e> = (&'e IdedExpr, Vec<&'e str>);

impl References {
    /// Reads every part, without recursion.
    fn read(&mut self, expression: &IdedExpr) {
        self.read_results(expression);
        let mut pending: Vec<Pending<'_>> = vec![(expression, Vec::new())];
        while let Some((part, bound)) = pending.pop() {
            match &part.expr {
                Expr::Ident(_) | Expr::Select(_) => self.path(part, bound, &mut pending),
                Expr::Call(call) => self.call(part, call, bound, &mut pending),
                Expr::Comprehension(l) => within_loop(l, &bound, &mut pending),
                Expr::List(list) => pending.extend(list.elements.iter().map(|e| (e, bound.clone()))),
                Expr::Map(map) => {
                    for entry in &map.entries {
                        pending.extend(values(&entry.expr).into_iter().map(|value| (value, bound.clone())));
                    }
                }
                Expr::Struct(object) => {
                    for entry in &object.entries {
                        pending.extend(values(&entry.expr).into_iter().map(|value| (value, bound.clone())));
                    }
                }
                Expr::Literal(_) | Expr::Unspecified => {}
            }
        }
    }

    /// Reads `variable.key.key`; a chain of keys on anything else is a part of its own.
    fn path<'e>(&mut self, part: &'e IdedExpr, bound: Vec<&'e str>, pending: &mut Vec<Pending<'e>>) {
        let mut keys = Vec::new();
        let mut here = part;
        while let Some((operand, key)) = step(here) {
            keys.extend(key);
            here = operand;
        }
        match &here.expr {
            Expr::Ident(name) if bound.contains(&name.as_str()) || name.starts_with('@') => {}
            Expr::Ident(name) => {
                keys.push(name.as_str());
                self.paths.push(keys.into_iter().rev().map(str::to_owned).collect());
            }
            _ => pending.push((here, bound)),
        }
    }

    fn call<'e>(
        &mut self,
        part: &'e IdedExpr,
        call: &'e CallExpr,
        bound: Vec<&'e str>,
        pending: &mut Vec<Pending<'e>>,
    ) {
        if step(part).is_some() {
            return self.path(part, bound, pending);
        }
        let parts = || call.target.as_deref().into_iter().chain(&call.args);
        if call.func_name.starts_with(|c: char| c.is_ascii_alphabetic()) {
            let arguments = parts().map(|argument| text(argument).map(str::to_owned)).collect();
            self.calls.push(FunctionCall { function: call.func_name.clone(), arguments });
        }
        pending.extend(parts().map(|argument| (argument, bound.clone())));
    }

    fn read_results(&mut self, expression: &IdedExpr) {
        let mut pending = vec![expression];
        while let Some(part) = pending.pop() {
            match &part.expr {
                Expr::Call(call) if call.func_name == operators::CONDITIONAL => {
                    pending.extend(call.args.iter().skip(1));
                }
                _ => self.results.extend(text(part).map(str::to_owned)),
            }
        }
    }
}

/// `a.key` and `a['key']` as `a` and the key; for `has(a.key)`, the key is omitted.
fn step(part: &IdedExpr) -> Option<(&IdedExpr, Option<&str>)> {
    match &part.expr {
        Expr::Select(SelectExpr { operand, field, test }) => Some((operand, (!test).then_some(field.as_str()))),
        Expr::Call(call) if call.func_name == operators::INDEX => match call.args.as_slice() {
            [operand, key] => Some((operand, Some(text(key)?))),
            _ => None,
        },
        _ => None,
    }
}

/// The string of a string literal.
fn text(part: &IdedExpr) -> Option<&str> {
    match &part.expr {
        Expr::Literal(LiteralValue::String(text)) => Some(text.inner()),
        _ => None,
    }
}

fn within_loop<'e>(l: &'e ComprehensionExpr, bound: &[&'e str], pending: &mut Vec<Pending<'e>>) {
    let mut inner = bound.to_vec();
    inner.extend([l.iter_var.as_str(), l.accu_var.as_str()]);
    inner.extend(l.iter_var2.as_deref());
    pending.extend([&l.loop_cond, &l.loop_step, &l.result].map(|part| (part, inner.clone())));
    pending.extend([&l.iter_range, &l.accu_init].map(|part| (part, bound.to_vec())));
}

/// The expressions in an entry of a map.
fn values(entry: &EntryExpr) -> Vec<&IdedExpr> {
    match entry {
        EntryExpr::StructField(field) => vec![&field.value],
        EntryExpr::MapEntry(pair) => vec![&pair.key, &pair.value],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn references(source: &str) -> (Vec<String>, Vec<String>, Vec<String>) {
        let found = Expression::parse(source).unwrap().references();
        let mut paths: Vec<String> = found.paths.iter().map(|path| path.join(".")).collect();
        paths.sort();
        let call = |call: &FunctionCall| {
            let arguments: Vec<&str> = call.arguments.iter().map(|a| a.as_deref().unwrap_or("_")).collect();
            format!("{}({})", call.function, arguments.join(","))
        };
        let mut calls: Vec<String> = found.calls.iter().map(call).collect();
        calls.sort();
        (paths, calls, found.results)
    }

    #[test]
    fn names_in_every_kind_of_expression() {
        for (source, paths, calls, results) in [
            ("7", vec![], vec![], vec![]),
            ("a.b.c", vec!["a.b.c"], vec![], vec![]),
            ("a['b'].c + 1", vec!["a.b.c"], vec![], vec![]),
            ("has(a.b.c) ? a.b : 'no'", vec!["a.b", "a.b"], vec![], vec!["no"]),
            ("shape('x', 'y')[0] > n", vec!["n"], vec!["shape(x,y)"], vec![]),
            ("c == 'k' ? 'copy' : d ? 'pad' : e", vec!["c", "d", "e"], vec![], vec!["pad", "copy"]),
            ("l.all(x, x.k > y && x in [z])", vec!["l", "y", "z"], vec![], vec![]),
            ("{'k': v}.k", vec!["v"], vec![], vec![]),
            ("x.map(x, x.y).size()", vec!["x"], vec!["size(_)"], vec![]),
        ] {
            let (got_paths, got_calls, got_results) = references(source);
            assert_eq!((got_paths, got_calls), (own(&paths), own(&calls)), "{source}");
            assert_eq!(got_results, own(&results), "{source}");
        }
    }

    fn own(texts: &[&str]) -> Vec<String> {
        texts.iter().map(|text| (*text).to_owned()).collect()
    }
}
