//! Names that a rule binds with `let`.

use super::Unevaluated;
use crate::knowledge::{Expression, Scope};

/// Binds the values of `lets` in a scope, in order. A value that cannot be evaluated leaves its name unbound, so that
/// expressions that use it cannot be evaluated either.
pub(super) fn bind(lets: &[(String, Expression)], scope: &mut Scope<'_>) {
    for (name, expression) in lets {
        let _ = expression.bind(name, scope);
    }
}

/// The expression that made `failed` fail, with its error: one of `lets` when `failed` uses a name that [`bind`] left
/// unbound in `scope`, else `failed` itself.
pub(super) fn cause<'r>(
    lets: &'r [(String, Expression)],
    failed: Unevaluated<'r>,
    scope: &Scope<'_>,
) -> Unevaluated<'r> {
    let used = failed.0.variables();
    let is_unbound = |(name, _): &(String, Expression)| used.contains(name) && scope.get(name).is_none();
    let Some(at) = lets.iter().position(is_unbound) else { return failed };
    let (before, rest) = lets.split_at(at);
    match rest.first().and_then(|(_, expression)| Some((expression, expression.eval(scope).err()?))) {
        // Only names before it are bound for it.
        Some(inner) => cause(before, inner, scope),
        None => failed,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn lets(pairs: &[(&str, &str)]) -> Vec<(String, Expression)> {
        pairs.iter().map(|(name, source)| ((*name).to_owned(), Expression::parse(source).unwrap())).collect()
    }

    #[test]
    fn names_are_bound_in_order() {
        let mut scope = Scope::new();
        scope.bind("config", &json!({ "heads": 8 }));
        bind(&lets(&[("heads", "config.heads"), ("twice", "heads * 2"), ("heads_of", "[heads, twice]")]), &mut scope);
        assert_eq!(scope.get("heads_of"), Some(json!([8, 16])));
    }

    #[test]
    fn a_name_without_a_value_is_unbound() {
        let mut scope = Scope::new();
        scope.bind("config", &json!({ "heads": 8 }));
        bind(&lets(&[("kv", "config.kv"), ("ratio", "config.heads / kv"), ("heads", "config.heads")]), &mut scope);
        assert_eq!(["kv", "ratio", "heads"].map(|name| scope.get(name)), [None, None, Some(json!(8))]);
    }

    #[test]
    fn the_first_name_without_a_value_is_the_cause() {
        let all = lets(&[("kv", "config.kv"), ("ratio", "config.heads / kv"), ("again", "again + 1")]);
        let mut scope = Scope::new();
        scope.bind("config", &json!({ "heads": 8 }));
        bind(&all, &mut scope);
        for (source, expected) in [
            ("ratio > 1", "config.kv"),
            ("kv > 1", "config.kv"),
            ("again > 1", "again + 1"),
            ("config.size > 1", "config.size > 1"),
        ] {
            let expression = Expression::parse(source).unwrap();
            let error = expression.eval(&scope).unwrap_err();
            assert_eq!(cause(&all, (&expression, error), &scope).0.source(), expected, "{source}");
        }
    }
}
