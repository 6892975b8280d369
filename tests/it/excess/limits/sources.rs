//! The limits in the sources: each has a row or a reason, and each row its value.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;

use regex::Regex;

use super::{LIMITS, Limit, reasons};
use crate::house::{sources, without_tests};
use crate::support::project;

/// Constants by file and name, with the expression of their value; functions have none.
type Named = BTreeMap<(String, String), Option<String>>;

/// The numbers and functions of the files in which a stranger's bytes are read or checked.
fn named() -> Named {
    let number =
        Regex::new(r"(?m)^ *(?:pub(?:\([^)]*\))? )?const ([A-Z][A-Z0-9_]*): (?:usize|u\d+) =\s*([^;]+);").unwrap();
    let function = Regex::new(r"(?m)^ *(?:pub(?:\([^)]*\))? )?(?:const )?fn (\w+)").unwrap();
    let is_read = |path: &str| path.starts_with("src/checkpoint") || path.starts_with("src/check/");
    let mut named = Named::new();
    for (path, text) in sources().into_iter().filter(|(path, _)| is_read(path) && !path.ends_with("/tests.rs")) {
        let code = without_tests(&text);
        let functions = function.captures_iter(&code).map(|found| ((path.clone(), found[1].to_owned()), None));
        let numbers = number.captures_iter(&code);
        named.extend(functions);
        named.extend(numbers.map(|found| ((path.clone(), found[1].to_owned()), Some(found[2].trim().to_owned()))));
    }
    named
}

/// What a row or reason is about: names in a file, which stand for their sum.
fn meant(at: &str) -> Vec<(String, String)> {
    let (path, names) = at.split_once(' ').expect("a file and a name");
    names.split(" + ").map(|name| (path.to_owned(), name.to_owned())).collect()
}

/// The value of a sum, product, shift or number; `None` for anything else.
fn value(expression: &str) -> Option<usize> {
    if let Some((one, other)) = expression.split_once("<<") {
        return value(one)?.checked_shl(u32::try_from(value(other)?).ok()?);
    }
    if let Some((one, other)) = expression.split_once('*') {
        return value(one)?.checked_mul(value(other)?);
    }
    expression.trim().replace('_', "").parse().ok()
}

/// Where the source has another value than the row.
fn other_value(limit: &Limit, named: &Named) -> Option<String> {
    let of = |key: &(String, String)| value(named.get(key)?.as_ref()?);
    let sum: usize = meant(limit.at).iter().map(of).sum::<Option<usize>>()?;
    (sum != limit.most).then(|| format!("{} is {sum}, and its row has {}", limit.at, limit.most))
}

#[test]
fn every_limit_has_a_row_or_a_reason() {
    let named = named();
    let rows = || LIMITS.iter().copied().flatten();
    let of_rows: BTreeSet<(String, String)> = rows().flat_map(|limit| meant(limit.at)).collect();
    let of_reasons: Vec<(String, String)> = reasons::all().flat_map(meant).collect();
    let given = || of_rows.iter().chain(&of_reasons);
    let mut wrong: Vec<String> = rows().filter_map(|limit| other_value(limit, &named)).collect();
    let gone = given().filter(|key| !named.contains_key(*key));
    wrong.extend(gone.map(|(path, name)| format!("{path} has no {name}, which has a row or a reason")));
    let twice =
        of_reasons.iter().enumerate().filter(|(i, key)| of_rows.contains(*key) || of_reasons[..*i].contains(key));
    wrong.extend(twice.map(|(_, (path, name))| format!("{path} {name} has a reason, and a row or another reason")));
    // What one file calls a limit is one in others, too.
    let pattern = Regex::new(r"^(?:MAX_\w+|\w*CAP)$").unwrap();
    let first = |at| meant(at).into_iter().map(|(_, name)| name).next();
    let others: BTreeSet<String> = rows().map(|limit| limit.at).chain(reasons::all()).filter_map(first).collect();
    for ((path, name), _) in named.iter().filter(|(_, value)| value.is_some()) {
        let is_limit = pattern.is_match(name) || others.contains(name);
        if is_limit && !given().any(|(of, known)| (of, known) == (path, name)) {
            wrong.push(format!("{path} {name} has neither a row nor a reason"));
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

/// A limit or a test that a reason names is there.
#[test]
fn reasons_name_what_there_is() {
    let is_there = |(path, name): &(&str, &str)| {
        let text = fs::read_to_string(project().join(path)).unwrap_or_default();
        text.contains(&format!("const {name}: ")) || text.contains(&format!("fn {name}()"))
    };
    let gone: Vec<_> = reasons::cited().into_iter().filter(|cited| !is_there(cited)).collect();
    assert!(gone.is_empty(), "{gone:?}");
}
