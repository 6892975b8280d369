//! Expressions of the built-in files as CEL parses them, from `rules/expressions.txt`, so that a check need not start CEL's
//! parser, which is slow.
//!
//! Each line has the text of an expression and its tree, both as JSON; the lines are sorted. A text without a line is
//! parsed as usual. A test writes the file, and compares it with what CEL's parser makes of each text.

use std::sync::LazyLock;

use cel::common::ast::{
    CallExpr, ComprehensionExpr, EntryExpr, Expr, IdedEntryExpr, IdedExpr, ListExpr, LiteralValue, MapEntryExpr,
    MapExpr, SelectExpr,
};
use serde_json::Value;

use crate::knowledge::source;

/// The lines of the file, for [`source::line_of`].
static LINES: LazyLock<&[u8]> = LazyLock::new(|| source::bytes("expressions.txt").unwrap_or_default());

/// The tree of an expression, if the file has one.
pub(super) fn find(expression: &str) -> Option<IdedExpr> {
    let wanted = serde_json::to_string(expression).ok()?;
    let tree = source::line_of(&LINES, &wanted)?;
    decode(&serde_json::from_str(tree).ok()?)
}

/// The expression that a value of [`encode`] stands for.
fn decode(value: &Value) -> Option<IdedExpr> {
    let expr = match value {
        Value::Null => Expr::Literal(LiteralValue::Null),
        Value::Bool(value) => Expr::Literal(LiteralValue::Boolean((*value).into())),
        Value::Number(number) => Expr::Literal(match number.as_i64() {
            Some(int) => LiteralValue::Int(int.into()),
            None => LiteralValue::Double(number.as_f64()?.into()),
        }),
        Value::String(name) => Expr::Ident(name.clone()),
        Value::Array(parts) => composed(parts)?,
        Value::Object(_) => return None,
    };
    Some(IdedExpr { id: 0, expr })
}

fn composed(parts: &[Value]) -> Option<Expr> {
    let (kind, parts) = parts.split_first()?;
    let name = |value: &Value| value.as_str().map(str::to_owned);
    let all = |parts: &[Value]| parts.iter().map(decode).collect::<Option<Vec<_>>>();
    Some(match (kind.as_str()?, parts) {
        ("string", [text]) => Expr::Literal(LiteralValue::String(name(text)?.into())),
        ("call", [function, args @ ..]) => {
            Expr::Call(CallExpr { func_name: name(function)?, target: None, args: all(args)? })
        }
        ("method", [function, target, args @ ..]) => {
            let target = Some(Box::new(decode(target)?));
            Expr::Call(CallExpr { func_name: name(function)?, target, args: all(args)? })
        }
        ("key" | "has", [operand, field]) => {
            let test = kind == "has";
            Expr::Select(SelectExpr { operand: Box::new(decode(operand)?), field: name(field)?, test })
        }
        ("list", elements) => Expr::List(ListExpr::new(all(elements)?)),
        ("map", entries) => {
            let entry = |pair: &[Value]| match pair {
                [key, value] => {
                    let entry = MapEntryExpr { key: decode(key)?, value: decode(value)?, optional: false };
                    Some(IdedEntryExpr { id: 0, expr: EntryExpr::MapEntry(entry) })
                }
                _ => None,
            };
            Expr::Map(MapExpr { entries: entries.chunks(2).map(entry).collect::<Option<_>>()? })
        }
        ("loop", [range, var, var2, accu, init, cond, step, result]) => {
            Expr::Comprehension(Box::new(ComprehensionExpr {
                iter_range: decode(range)?,
                iter_var: name(var)?,
                iter_var2: name(var2),
                accu_var: name(accu)?,
                accu_init: decode(init)?,
                loop_cond: decode(cond)?,
                loop_step: decode(step)?,
                result: decode(result)?,
            }))
        }
        _ => return None,
    })
}

#[cfg(test)]
pub(super) mod tests {
    use std::cell::RefCell;
    use std::collections::BTreeSet;
    use std::fmt::Write as _;

    use serde_json::json;

    use super::*;
    use crate::knowledge::Knowledge;
    use crate::knowledge::architecture::Blueprint;
    use crate::knowledge::expression::program::Program;
    use crate::knowledge::expression::scope::ENV;

    thread_local! {
        static SEEN: RefCell<BTreeSet<String>> = const { RefCell::new(BTreeSet::new()) };
    }

    /// Notes the text of an expression in a built-in file.
    pub(in super::super) fn record(text: &str) {
        if Program::simple(text).is_none() {
            SEEN.with_borrow_mut(|seen| seen.insert(text.to_owned()));
        }
    }

    /// The tree as JSON; `None` for the kinds that no built-in expression has.
    fn encode(expression: &IdedExpr) -> Option<Value> {
        let all = |parts: &[IdedExpr]| parts.iter().map(encode).collect::<Option<Vec<_>>>();
        let composed =
            |kind: &str, parts: Vec<Value>| Some(Value::Array([Value::from(kind)].into_iter().chain(parts).collect()));
        match &expression.expr {
            Expr::Literal(LiteralValue::Null) => Some(Value::Null),
            Expr::Literal(LiteralValue::Boolean(value)) => Some(json!(*value.inner())),
            Expr::Literal(LiteralValue::Int(value)) => Some(json!(*value.inner())),
            Expr::Literal(LiteralValue::Double(value)) => Some(json!(*value.inner())),
            Expr::Literal(LiteralValue::String(text)) => composed("string", vec![json!(text.inner())]),
            Expr::Ident(name) => Some(json!(name)),
            Expr::Call(CallExpr { func_name, target: None, args }) => {
                composed("call", [json!(func_name)].into_iter().chain(all(args)?).collect())
            }
            Expr::Call(CallExpr { func_name, target: Some(target), args }) => {
                composed("method", [json!(func_name), encode(target)?].into_iter().chain(all(args)?).collect())
            }
            Expr::Select(SelectExpr { operand, field, test }) => {
                composed(if *test { "has" } else { "key" }, vec![encode(operand)?, json!(field)])
            }
            Expr::List(list) if list.optional_indices.is_empty() => composed("list", all(&list.elements)?),
            Expr::Map(map) => {
                let mut parts = Vec::new();
                for entry in &map.entries {
                    match &entry.expr {
                        EntryExpr::MapEntry(entry) if !entry.optional => {
                            parts.extend([encode(&entry.key)?, encode(&entry.value)?]);
                        }
                        _ => return None,
                    }
                }
                composed("map", parts)
            }
            Expr::Comprehension(l) => composed(
                "loop",
                vec![
                    encode(&l.iter_range)?,
                    json!(l.iter_var),
                    json!(l.iter_var2),
                    json!(l.accu_var),
                    encode(&l.accu_init)?,
                    encode(&l.loop_cond)?,
                    encode(&l.loop_step)?,
                    encode(&l.result)?,
                ],
            ),
            _ => None,
        }
    }

    /// The texts of all expressions in built-in files.
    fn texts() -> BTreeSet<String> {
        SEEN.take();
        Knowledge::embedded().expect("the built-in files").read_all();
        for (path, text) in source::embedded("architectures") {
            source::parse_embedded::<Blueprint>(&path, text).expect("a built-in file");
        }
        SEEN.take()
    }

    #[test]
    fn the_file_has_what_cel_makes_of_every_built_in_expression() {
        let mut wanted = String::new();
        let line = |text: &String| {
            let program = ENV.compile(text).expect("an expression");
            let tree = encode(program.expression()).expect("a kind that is encoded");
            // What comes back from the file is the same tree.
            assert_eq!(encode(&decode(&tree).expect("the same")), Some(tree.clone()), "{text}");
            (serde_json::to_string(text).expect("a string"), tree)
        };
        let mut lines: Vec<(String, Value)> = texts().iter().map(line).collect();
        lines.sort_by(|a, b| a.0.cmp(&b.0));
        for (text, tree) in lines {
            let _ = writeln!(wanted, "{text}\t{tree}");
        }
        crate::schemas::assert_fresh("rules/expressions.txt", &wanted);
    }
}
