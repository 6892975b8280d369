use serde_json::{Value, json};

use super::*;

fn eval(source: &str) -> Result<Value, EvalError> {
    let mut scope = Scope::new();
    scope.bind("c", &json!({ "hidden": 2304, "heads": 8, "none": null, "zero": 0, "big": 1e300, "min": i64::MIN,
                             "huge": u64::MAX, "depths": [3, 4], "names": ["b", "a"], "sub": { "x": 1, "w": 2 }, "rate": 0.5 }));
    Expression::parse(source).unwrap_or_else(|e| panic!("{e}")).eval(&scope)
}

#[test]
fn evaluates_to_json() {
    for (source, expected) in [
        ("c.hidden % c.heads == 0 ? c.hidden / c.heads : -1", json!(288)),
        ("pow(2, c.heads) + sum(c.depths)", json!(263)),
        ("floor(c.rate * double(c.hidden)) + ceil(0.2)", json!(1153)),
        ("isqrt(577 - 1)", json!(24)),
        ("get(c, 'none', 7) + get(c, 'absent', 8) + c.get('heads', 9)", json!(23)),
        ("get(c.none, 'x', 1)", json!(1)),
        ("keys(c.sub)", json!(["w", "x"])),
        ("zpad(7, 5) + zpad(123456, 5)", json!("00007123456")),
        ("join(c.names) + '; ' + join(range(7))", json!("b, a; 0, 1, 2, 3, 4 and 2 more")),
        ("plural(1, 'tensor') + ', ' + plural(size(c.names), 'shard')", json!("1 tensor, 2 shards")),
        ("filesize(8055709462)", json!("8.06 GB")),
        ("glob('model.layers.3.norm', 'model.layers.*.n?rm')", json!(true)),
        ("min(c.depths) + max(5, 6)", json!(9)),
        ("range(3).map(i, i * i)", json!([0, 1, 4])),
        ("size(c.depths)", json!(2)),
        ("c.huge > 1.0", json!(true)),
        ("has(c.none) && c.none == null && !has(c.absent)", json!(true)),
        ("{'b': 1, 'a': c.sub}", json!({ "a": { "w": 2, "x": 1 }, "b": 1 })),
    ] {
        assert_eq!(eval(source).as_ref(), Ok(&expected), "{source}");
    }
}

#[test]
fn invalid_operations_are_errors() {
    for source in [
        "c.hidden / c.zero",
        "c.hidden % c.zero",
        "c.min / -1",
        "c.min % -1",
        "-c.min",
        "c.min - 1",
        "pow(10, 30)",
        "pow(2, -1)",
        "c.absent",
        "c.none.x",
        "nothing",
        "c.depths[2]",
        "c.depths[-1]",
        "c.names + 1",
        "floor(c.big)",
        "isqrt(-1)",
        "int(c.big)",
        "range(100000000000)",
        "sum(c.names)",
        "sum([9223372036854775807, 1])",
        "zpad(1, 1000000)",
        "get(c)",
        "unknown_function(1)",
        "c.hidden * c.rate",
        "c['a']['b']",
        "9223372036854775807 * 2",
    ] {
        let error = eval(source).expect_err(source);
        assert_eq!(error.source_text, source);
        assert!(!error.cause.is_empty() && error.cause.len() < 1000, "{error}");
    }
}

#[test]
fn typed_results() {
    let scope = Scope::new();
    let parse = |s| Expression::parse(s).expect(s);
    assert_eq!(parse("2 * 3").eval_u64(&scope), Ok(6));
    assert_eq!(parse("2 > 1").eval_bool(&scope), Ok(true));
    for bad in ["-1", "1.5", "'6'", "9223372036854775807", "null", "true"] {
        parse(bad).eval_u64(&scope).expect_err(bad);
    }
    assert_eq!(parse("1").eval_bool(&scope).expect_err("").to_string(), "`1`: true or false expected, got 1");
}

#[test]
fn children_see_their_parents() {
    let mut root = Scope::new();
    root.bind("n", &json!(10));
    root.function1("shape", |name| json!([name.len(), 2]));
    root.function2("joined", |a, b| json!(format!("{a}{b}")));
    let expression = Expression::parse("shape('abc')[0] * n + i + 7 + size(joined('a', 'b'))").expect("CEL");
    let mut child = root.child();
    child.bind_int("i", 5);
    let mut grandchild = child.child();
    grandchild.bind_int("i", 6);
    assert_eq!(expression.eval(&grandchild), Ok(json!(45)));
    assert_eq!(expression.eval(&child), Ok(json!(44)));
    assert!(expression.eval(&root).is_err());
    assert_eq!(expression.variables().iter().map(String::as_str).collect::<Vec<_>>(), ["i", "n"]);
}

#[test]
fn templates_render_in_a_sentence() {
    let mut scope = Scope::new();
    scope.bind("c", &json!({ "name": "lm_head", "shape": [2304, 1152], "names": ["a", "b"] }));
    let template = Template::parse("{c.name} is {c.shape}, not {{{size({'a': '}'})}}} or {c.names}: {c.absent}")
        .expect("template");
    assert_eq!(template.render(&scope), "lm_head is [2304, 1152], not {1} or [a, b]: ?");
    assert!(template.try_render(&scope).is_err());
    for bad in ["{", "a } b", "{c.}", "{}"] {
        Template::parse(bad).expect_err(bad);
    }
}

#[test]
fn an_invalid_expression_is_a_serde_error_with_its_place() {
    #[derive(serde::Deserialize, Debug)]
    #[serde(deny_unknown_fields)]
    struct File {
        when: Expression,
    }
    let text = "{\n  when: \"c.hidden +\",\n}";
    let error = compile_eagerly(|| json5::from_str::<File>(text)).expect_err("no operand");
    assert!(error.to_string().contains("`c.hidden +` is not an expression"), "{error}");
    // Compiled lazily, it fails at the first evaluation.
    let lazy = json5::from_str::<File>(text).expect("not compiled yet");
    let error = lazy.when.eval(&Scope::new()).expect_err("no operand");
    assert!(error.to_string().starts_with("`c.hidden +`: column"), "{error}");
}

#[test]
fn simple_expressions_evaluate_as_in_cel() {
    let mut scope = Scope::new();
    scope.bind("c", &json!({ "n": 7, "sub": { "x": [1, 2], "y": null }, "text": "abc" }));
    scope.bind_int("i", 3);
    for simple in [
        "7",
        "true",
        "false",
        "i",
        "c.n",
        "c.sub.x",
        "c.sub.y",
        "c.sub",
        "c.absent",
        "d",
        "c.n.x",
        "c.text.x",
        "c.sub.y.z",
        "null",
    ] {
        let general = Expression::parse(&format!("({simple})")).expect("CEL").eval(&scope);
        let direct = Expression::parse(simple).expect("CEL").eval(&scope);
        assert_eq!(direct.ok(), general.ok(), "{simple}");
    }
    for (absent, cause) in [("c.sub.z", "No such key: z"), ("d", "Undeclared reference to 'd'")] {
        let error = Expression::parse(absent).expect("CEL").eval(&scope).expect_err(absent);
        assert_eq!(error.cause, cause);
    }
    Expression::parse("99999999999999999999").expect_err("more than 64 bits");
}
