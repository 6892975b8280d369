//! Counts the steps that the expressions of a user's files take.
//!
//! CEL always terminates, but nested loops over a document's lists can take very long, and the crate has no limit. The
//! loops of a user's expression are therefore rewritten to count steps: the list of a loop, each collected value and each sum
//! pass through a function that source text cannot name.

use std::cell::Cell;
use std::time::{Duration, Instant};

use cel::common::ast::{CallExpr, EntryExpr, Expr, IdedExpr, operators};
use cel::{ExecutionError, FunctionContext, Value as Cel};

use super::limits;
use super::scope::Scope;

/// Name of the function; identifiers cannot contain `@`.
const COUNT: &str = "@count";

/// Time limit, for single steps that take long, such as comparing two lists of a million elements.
const LONGEST: Duration = Duration::from_mins(1);

/// Remaining steps, and the time at which evaluation stops.
#[derive(Clone, Copy)]
struct Limit {
    steps: u64,
    until: Instant,
}

thread_local! {
    static LIMIT: Cell<Option<Limit>> = const { Cell::new(None) };
}

/// Runs `work` with a limit of `steps` for its expressions; also returns whether the limit was reached. From then on
/// every evaluation fails, so the result must be discarded.
pub(crate) fn within<T>(steps: u64, work: impl FnOnce() -> T) -> (T, bool) {
    struct RestoreLimit(Option<Limit>);
    impl Drop for RestoreLimit {
        fn drop(&mut self) {
            LIMIT.set(self.0);
        }
    }
    let until = Instant::now().checked_add(LONGEST).unwrap_or_else(Instant::now);
    let _before = RestoreLimit(LIMIT.replace(Some(Limit { steps, until })));
    let result = work();
    (result, LIMIT.get().is_some_and(|limit| limit.steps == 0))
}

/// Runs one evaluation, with a limit of its own unless one is set.
pub(super) fn bounded<T>(work: impl FnOnce() -> T) -> T {
    if LIMIT.get().is_some() { work() } else { within(limits::STEPS, work).0 }
}

/// Counts steps, if a limit is set.
pub(super) fn spend(steps: u64) -> Result<(), String> {
    let Some(limit) = LIMIT.get() else { return Ok(()) };
    let left = limit.steps.saturating_sub(steps);
    let left = if Instant::now() > limit.until { 0 } else { left };
    LIMIT.set(Some(Limit { steps: left, ..limit }));
    if left == 0 { Err("evaluation limit exceeded".to_owned()) } else { Ok(()) }
}

pub(super) fn register(scope: &mut Scope<'static>) {
    scope.add(COUNT, |context: &FunctionContext| -> Result<Cel, ExecutionError> {
        let Some(value) = context.args.first() else { return Err(context.error("one value expected")) };
        let value = Cel::try_from(value.as_ref())?;
        spend(size(&value)).map_err(|cause| context.error(cause))?;
        Ok(value)
    });
}

/// Number of nested values, including the value itself; a string counts as its number of eight-byte words.
pub(super) fn size(value: &Cel) -> u64 {
    let sum = |sizes: &mut dyn Iterator<Item = u64>| sizes.fold(1_u64, u64::saturating_add);
    match value {
        Cel::List(items) => sum(&mut items.iter().map(size)),
        Cel::Map(map) => sum(&mut map.map.values().map(size)),
        Cel::String(text) => (text.len() as u64 / 8).saturating_add(1),
        _ => 1,
    }
}

/// Rewrites the expression so that its loops count steps.
pub(super) fn count(expression: &IdedExpr) -> IdedExpr {
    let mut counted = expression.clone();
    visit(&mut counted);
    counted
}

fn visit(expression: &mut IdedExpr) {
    match &mut expression.expr {
        Expr::Comprehension(l) => {
            let gathers = gathered(&mut l.loop_step, &l.accu_var);
            if let Some(items) = gathers {
                items.iter_mut().for_each(wrap);
            }
            for part in [&mut l.accu_init, &mut l.iter_range, &mut l.loop_cond, &mut l.loop_step, &mut l.result] {
                visit(part);
            }
            wrap(&mut l.iter_range);
            // `all` and `exists` ignore errors of single elements, but not an error in the loop condition. `map` and
            // `filter` have no condition, and CEL runs them fast only while it is a literal `true`.
            if !matches!(l.loop_cond.expr, Expr::Literal(_)) {
                wrap(&mut l.loop_cond);
            }
        }
        Expr::Call(call) => {
            call.target.as_deref_mut().into_iter().chain(&mut call.args).for_each(visit);
            if call.func_name == operators::ADD && !is_gathering(call) {
                wrap(expression);
            }
        }
        Expr::List(list) => list.elements.iter_mut().for_each(visit),
        Expr::Select(select) => visit(&mut select.operand),
        Expr::Map(map) => map.entries.iter_mut().for_each(|e| entry(&mut e.expr)),
        Expr::Struct(object) => object.entries.iter_mut().for_each(|e| entry(&mut e.expr)),
        Expr::Unspecified | Expr::Ident(_) | Expr::Literal(_) => {}
    }
}

fn entry(entry: &mut EntryExpr) {
    match entry {
        EntryExpr::StructField(field) => visit(&mut field.value),
        EntryExpr::MapEntry(pair) => {
            visit(&mut pair.key);
            visit(&mut pair.value);
        }
    }
}

/// Whether a sum is the step of `map` or `filter`, which CEL runs fast only as it is.
fn is_gathering(call: &CallExpr) -> bool {
    matches!(call.args.first().map(|first| &first.expr), Some(Expr::Ident(name)) if name.starts_with('@'))
}

/// The values that `map` and `filter` append to their result, `@result + [value]`, with or without a filter.
fn gathered<'e>(step: &'e mut IdedExpr, gathering: &str) -> Option<&'e mut Vec<IdedExpr>> {
    let Expr::Call(call) = &mut step.expr else { return None };
    if call.func_name == operators::CONDITIONAL {
        return gathered(call.args.get_mut(1)?, gathering);
    }
    let [before, list] = call.args.as_mut_slice() else { return None };
    let appends = call.func_name == operators::ADD && matches!(&before.expr, Expr::Ident(name) if name == gathering);
    match &mut list.expr {
        Expr::List(list) if appends => Some(&mut list.elements),
        _ => None,
    }
}

fn wrap(expression: &mut IdedExpr) {
    let inner = std::mem::take(expression);
    let id = inner.id;
    let call = CallExpr { func_name: COUNT.to_owned(), target: None, args: vec![inner] };
    *expression = IdedExpr { id, expr: Expr::Call(call) };
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::knowledge::Expression;

    #[test]
    fn counted_loops_give_the_same_results() {
        let mut scope = Scope::new();
        scope.bind("l", &json!([1, 2, 3]));
        scope.bind("m", &json!({ "a": [1], "b": [] }));
        for (source, value) in [
            ("l.map(x, x * 2)", json!([2, 4, 6])),
            ("l.map(x, x + 1 + x)", json!([3, 5, 7])),
            ("'a' + 'b' + string(l.size() + 1)", json!("ab4")),
            ("l.map(x, x > 1, l.filter(y, y < x))", json!([[1], [1, 2]])),
            ("l.all(x, l.exists(y, y == x))", json!(true)),
            ("l.exists_one(x, x == 2) && [l, l].all(a, a.size() == 3)", json!(true)),
            ("{'k': l.map(x, x)}.k", json!([1, 2, 3])),
            ("m.exists(k, m[k].size() == 0)", json!(true)),
        ] {
            assert_eq!(Expression::parse(source).unwrap().eval(&scope).unwrap(), value, "{source}");
        }
    }

    #[test]
    fn values_grow_to_a_limit() {
        // Each step makes the value four times as long, as the `let` of an architecture or a recipe may.
        let mut scope = Scope::new();
        scope.bind("x", &json!("aaaaaaaa"));
        let grow = Expression::parse("x + x + x + x").unwrap();
        let error = (0..40).find_map(|_| grow.bind("x", &mut scope).err()).unwrap();
        assert!(error.cause.contains("too large") || error.cause.contains("limit"), "{error}");
        let Some(serde_json::Value::String(held)) = scope.get("x") else { panic!("x is text") };
        assert!(held.len() <= 8 * 250_000, "{}", held.len());
        scope.bind("l", &json!([1]));
        let grow = Expression::parse("[l, l, l, l, l, l, l, l]").unwrap();
        let error = (0..40).find_map(|_| grow.bind("l", &mut scope).err()).unwrap();
        assert!(error.cause.contains("too large"), "{error}");
    }

    #[test]
    fn no_source_text_exhausts_the_stack() {
        let pieces = [
            ("1+", ""),
            ("(", ")"),
            ("[", "]"),
            ("{1:", "}"),
            ("!", ""),
            ("-", ""),
            ("", "-1"),
            ("true?", ":2"),
            ("true?1:", ""),
            ("[1].map(x,", ")"),
            ("size(", ")"),
            ("", "[0]"),
            ("", ".a"),
            ("1<", ""),
            ("true&&", ""),
            ("[1]+", ""),
            ("1 in ", ""),
            ("'(' + ", ""),
            ("x ", ""),
        ];
        let repeated = |open: &str, close: &str, n: usize| format!("{}1{}", open.repeat(n), close.repeat(n));
        let sources = pieces.iter().flat_map(|(open, close)| {
            let longest = limits::SOURCE.saturating_sub(1) / (open.len() + close.len());
            [8, 20, 24, 60, 120, 240, longest, 300_000].map(|n| repeated(open, close, n))
        });
        for source in sources {
            let scope = Scope::new();
            let result = Expression::parse(&source).map(|expression| expression.eval(&scope).is_ok());
            let message = result.map_or_else(|error| error.to_string(), |_| String::new());
            assert!(message.len() < 2000, "{} bytes: {message}", message.len());
        }
    }

    #[test]
    fn an_endless_evaluation_is_stopped() {
        let scope = Scope::new();
        let many = "range(1000)";
        for source in [
            format!("{many}.all(a, {many}.all(b, {many}.all(c, a + b + c >= 0)))"),
            format!("{many}.map(a, {many}).size() > 0"),
            format!("{many}.map(a, {many}.map(b, [a, b])).size() > 0"),
            format!("{many}.filter(a, {many}.exists(b, b == -1)).size() > 0"),
        ] {
            let expression = Expression::parse(&source).unwrap();
            let (result, stopped) = within(20_000, || expression.eval_bool(&scope));
            assert!(stopped && result.unwrap_err().to_string().contains("evaluation limit"), "{source}");
        }
        let (result, stopped) = within(1_000, || Expression::parse("[1, 2].all(x, x > 0)").unwrap().eval_bool(&scope));
        assert!(result.unwrap() && !stopped);
    }
}
