//! Expressions of the built-in files as CEL parses them, from `rules/expressions.txt`, so that a check need not start CEL's
//! parser, which is slow.
//!
//! Each line has the text of an expression and its tree, both as JSON; the lines are sorted. A text without a line is
//! parsed as usual. A test writes the file, and compares it with what CEL's parser makes of each text.

use std::fmt;
use std::sync::LazyLock;

use cel::common::ast::{
    CallExpr, ComprehensionExpr, EntryExpr, Expr, IdedEntryExpr, IdedExpr, ListExpr, LiteralValue, MapEntryExpr,
    MapExpr, SelectExpr,
};
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::knowledge::source;

/// The lines of the file, for [`source::line_of`].
static LINES: LazyLock<&[u8]> = LazyLock::new(|| source::bytes("expressions.txt").unwrap_or_default());

/// The tree of an expression, if the file has one.
pub(super) fn find(expression: &str) -> Option<IdedExpr> {
    let wanted = serde_json::to_string(expression).ok()?;
    let Tree(tree) = serde_json::from_str(source::line_of(&LINES, &wanted)?).ok()?;
    Some(tree)
}

/// An expression, read from its JSON: a name is a variable, other plain values are themselves, and all else is an array of a
/// kind and its parts.
struct Tree(IdedExpr);

impl<'de> Deserialize<'de> for Tree {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(TreeVisitor).map(|expr| Self(IdedExpr { id: 0, expr }))
    }
}

struct TreeVisitor;

impl<'de> Visitor<'de> for TreeVisitor {
    type Value = Expr;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an expression")
    }

    fn visit_unit<E>(self) -> Result<Expr, E> {
        Ok(Expr::Literal(LiteralValue::Null))
    }

    fn visit_bool<E>(self, value: bool) -> Result<Expr, E> {
        Ok(Expr::Literal(LiteralValue::Boolean(value.into())))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Expr, E> {
        Ok(Expr::Literal(LiteralValue::Int(value.into())))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Expr, E> {
        self.visit_i64(i64::try_from(value).map_err(E::custom)?)
    }

    fn visit_f64<E>(self, value: f64) -> Result<Expr, E> {
        Ok(Expr::Literal(LiteralValue::Double(value.into())))
    }

    fn visit_str<E>(self, name: &str) -> Result<Expr, E> {
        Ok(Expr::Ident(name.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut parts: A) -> Result<Expr, A::Error> {
        let parts = &mut parts;
        Ok(match part(parts)? {
            "string" => Expr::Literal(LiteralValue::String(part::<String, A>(parts)?.into())),
            "call" => Expr::Call(CallExpr { func_name: part(parts)?, target: None, args: rest(parts)? }),
            "method" => {
                let func_name = part(parts)?;
                Expr::Call(CallExpr { func_name, target: Some(Box::new(tree(parts)?)), args: rest(parts)? })
            }
            kind @ ("key" | "has") => {
                let operand = Box::new(tree(parts)?);
                Expr::Select(SelectExpr { operand, field: part(parts)?, test: kind == "has" })
            }
            "list" => Expr::List(ListExpr::new(rest(parts)?)),
            "map" => {
                let mut entries = Vec::new();
                while let Some(Tree(key)) = parts.next_element()? {
                    let entry = MapEntryExpr { key, value: tree(parts)?, optional: false };
                    entries.push(IdedEntryExpr { id: 0, expr: EntryExpr::MapEntry(entry) });
                }
                Expr::Map(MapExpr { entries })
            }
            "loop" => Expr::Comprehension(Box::new(ComprehensionExpr {
                iter_range: tree(parts)?,
                iter_var: part(parts)?,
                iter_var2: part(parts)?,
                accu_var: part(parts)?,
                accu_init: tree(parts)?,
                loop_cond: tree(parts)?,
                loop_step: tree(parts)?,
                result: tree(parts)?,
            })),
            other => return Err(Error::custom(format!("no kind of expression: {other}"))),
        })
    }
}

/// The next part of an array.
fn part<'de, T: Deserialize<'de>, A: SeqAccess<'de>>(parts: &mut A) -> Result<T, A::Error> {
    parts.next_element()?.ok_or_else(|| Error::custom("a part is missing"))
}

fn tree<'de, A: SeqAccess<'de>>(parts: &mut A) -> Result<IdedExpr, A::Error> {
    let Tree(tree) = part(parts)?;
    Ok(tree)
}

/// The other parts of an array.
fn rest<'de, A: SeqAccess<'de>>(parts: &mut A) -> Result<Vec<IdedExpr>, A::Error> {
    let mut trees = Vec::with_capacity(parts.size_hint().unwrap_or(2));
    while let Some(Tree(tree)) = parts.next_element()? {
        trees.push(tree);
    }
    Ok(trees)
}

#[cfg(test)]
pub(super) mod tests {
    use std::cell::RefCell;
    use std::collections::BTreeSet;
    use std::fmt::Write as _;

    use serde_json::{Value, json};

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
            let Tree(decoded) = Tree::deserialize(&tree).expect("a tree");
            assert_eq!(encode(&decoded), Some(tree.clone()), "{text}");
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
