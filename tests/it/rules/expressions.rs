//! The size of the expressions of rules, and of the lists in them.

use std::collections::BTreeMap;
use std::fs;

use ckpt_doctor::knowledge::{Template, lists, source};
use serde_json::{Value, json};

use crate::support::{project, texts};

/// Maximum length of an expression in characters; `let` divides a longer one.
const LENGTH: usize = 250;

/// Maximum number of texts in a list or a map of an expression; a longer one is in `rules/lists.json5`.
const TEXTS: usize = 8;

/// Keys of a rule whose values are expressions, besides those of a `let`.
const EXPRESSIONS: [&str; 7] = ["when", "that", "each", "only", "to", "needs_whole_load", "rename"];

/// Keys of a rule whose values are plain texts.
const PLAIN: [&str; 3] = ["summary", "why", "references"];

/// Adds the expressions of a part of a rule, each with its place.
fn add_expressions(at: &str, key: &str, value: &Value, found: &mut Vec<(String, String)>) {
    match value {
        Value::Object(map) => {
            for (inner, value) in map {
                let key = if key == "let" { "let" } else { inner };
                add_expressions(&format!("{at}.{inner}"), key, value, found);
            }
        }
        Value::Array(list) => list.iter().for_each(|value| add_expressions(at, key, value, found)),
        Value::String(text) if key == "let" || EXPRESSIONS.contains(&key) => found.push((at.to_owned(), text.clone())),
        Value::String(text) if !PLAIN.contains(&key) => {
            let template = Template::parse(text).unwrap_or_else(|error| panic!("{at}: {error}"));
            found.extend(template.expressions().map(|expression| (at.to_owned(), expression.source().to_owned())));
        }
        _ => {}
    }
}

/// The expressions of all rules, each with its place.
fn expressions() -> Vec<(String, String)> {
    let mut found = Vec::new();
    for (path, text) in texts("rules/checks") {
        let rule: Value = source::parse(&path, &text).unwrap_or_else(|error| panic!("{error}"));
        add_expressions(&path, "", &rule, &mut found);
    }
    found
}

/// The number of texts in the longest list or map of an expression, which is parsed as in `rules/expressions.txt`.
fn longest_list(tree: &Value) -> usize {
    let Value::Array(parts) = tree else { return 0 };
    let is_text = |part: &&Value| part[0] == "string";
    let here = match parts.first().and_then(Value::as_str) {
        Some("list") => parts.iter().filter(is_text).count(),
        Some("map") => parts.iter().skip(2).step_by(2).filter(is_text).count(),
        _ => 0,
    };
    parts.iter().map(longest_list).fold(here, usize::max)
}

#[test]
fn expressions_are_short() {
    let is_long = |(_, expression): &(String, String)| expression.chars().count() > LENGTH;
    let long: Vec<_> = expressions().into_iter().filter(is_long).collect();
    assert!(long.is_empty(), "divide with `let`: {long:#?}");
}

#[test]
fn long_lists_are_in_their_file() {
    let parsed = fs::read_to_string(project().join("rules/expressions.txt")).expect("text");
    let line = |line: &str| {
        let (text, tree) = line.split_once('\t').expect("an expression and its tree");
        (serde_json::from_str::<String>(text).expect("a string"), serde_json::from_str::<Value>(tree).expect("a tree"))
    };
    let trees: BTreeMap<String, Value> = parsed.lines().map(line).collect();
    let mut wrong = Vec::new();
    for (at, expression) in expressions() {
        match trees.get(&expression) {
            Some(tree) if longest_list(tree) > TEXTS => {
                wrong.push(format!("{at}: move to rules/lists.json5: {expression}"));
            }
            // Paths and plain values have no line.
            None if expression.contains(['[', '(']) => {
                wrong.push(format!("{at}: not in rules/expressions.txt: {expression}"));
            }
            _ => {}
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert_eq!(longest_list(&json!(["call", "size", ["list", ["string", "a"], ["string", "b"], 1]])), 2);
    assert_eq!(longest_list(&json!(["map", ["string", "a"], ["string", "b"], ["string", "c"], 1])), 1);
}

#[test]
fn every_list_is_read_by_a_rule() {
    let all = expressions();
    let is_read = |name: &str| all.iter().any(|(_, expression)| expression.contains(&format!("listed('{name}')")));
    let unread: Vec<&String> = lists::all().keys().filter(|name| !is_read(name)).collect();
    assert!(unread.is_empty(), "{unread:?}");
}
