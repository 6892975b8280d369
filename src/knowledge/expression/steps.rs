//! Bounds on what a user's own rule may take.
//!
//! CEL ends always, but loops within loops over a document's lists end late, and the crate has no limit of its own. So
//! the loops of such a rule are parsed into ones that count: the list that a loop goes over, and each value that it
//! gathers, pass through a function that no source text can name.

use std::cell::Cell;
use std::time::{Duration, Instant};

use cel::common::ast::{CallExpr, EntryExpr, Expr, IdedExpr, operators};
use cel::{ExecutionError, FunctionContext, Value as Cel};

use super::scope::Scope;

/// Name of the function; `@` is in no identifier.
const COUNT: &str = "@count";

/// For what counts as one step and is long: to compare two lists of a million in each round of a loop.
const LONGEST: Duration = Duration::from_mins(1);

/// Steps that are left, and until when.
#[derive(Clone, Copy)]
struct Limit {
    steps: u64,
    until: Instant,
}

thread_local! {
    static LIMIT: Cell<Option<Limit>> = const { Cell::new(None) };
}

/// Runs `work`, in which expressions may take so many steps, and says whether they took them all. Any evaluation after
/// that fails, so the result is then worth nothing.
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

/// Takes steps, where they are counted.
pub(super) fn spend(steps: u64) -> Result<(), String> {
    let Some(limit) = LIMIT.get() else { return Ok(()) };
    let left = limit.steps.saturating_sub(steps);
    let left = if Instant::now() > limit.until { 0 } else { left };
    LIMIT.set(Some(Limit { steps: left, ..limit }));
    if left == 0 { Err("this takes too many steps".to_owned()) } else { Ok(()) }
}

pub(super) fn register(scope: &mut Scope<'static>) {
    scope.add(COUNT, |context: &FunctionContext| -> Result<Cel, ExecutionError> {
        let Some(value) = context.args.first() else { return Err(context.error("one value expected")) };
        let value = Cel::try_from(value.as_ref())?;
        spend(size(&value)).map_err(|cause| context.error(cause))?;
        Ok(value)
    });
}

/// Values in a value, itself included; a string has as many as it has words of eight bytes.
fn size(value: &Cel) -> u64 {
    let sum = |sizes: &mut dyn Iterator<Item = u64>| sizes.fold(1_u64, u64::saturating_add);
    match value {
        Cel::List(items) => sum(&mut items.iter().map(size)),
        Cel::Map(map) => sum(&mut map.map.values().map(size)),
        Cel::String(text) => (text.len() as u64 / 8).saturating_add(1),
        _ => 1,
    }
}

/// The expression with loops that count.
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
            // `all` and `exists` go on after an element that fails; where they ask whether to go on, nothing is forgiven.
            // `map` and `filter` do not ask, and are only fast as long as that is a plain `true`.
            if !matches!(l.loop_cond.expr, Expr::Literal(_)) {
                wrap(&mut l.loop_cond);
            }
        }
        Expr::Call(call) => call.target.as_deref_mut().into_iter().chain(&mut call.args).for_each(visit),
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

/// The values that `map` and `filter` append to what they gather, `@result + [value]`, with a guard or without.
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
    fn counted_loops_say_the_same() {
        let mut scope = Scope::new();
        scope.bind("l", &json!([1, 2, 3]));
        scope.bind("m", &json!({ "a": [1], "b": [] }));
        for (source, value) in [
            ("l.map(x, x * 2)", json!([2, 4, 6])),
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
    fn what_would_take_for_ever_is_stopped() {
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
            assert!(stopped && result.unwrap_err().to_string().contains("too many steps"), "{source}");
        }
        let (result, stopped) = within(1_000, || Expression::parse("[1, 2].all(x, x > 0)").unwrap().eval_bool(&scope));
        assert!(result.unwrap() && !stopped);
    }
}
