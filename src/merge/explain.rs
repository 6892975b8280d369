//! Explains in words why an expression of a recipe cannot be evaluated with these donors.

use crate::checkpoint::files;
use serde_json::Value;

use super::parts::Donor;
use crate::knowledge::expression::FunctionCall;
use crate::knowledge::recipe::Recipe;
use crate::knowledge::source::hint;
use crate::knowledge::{EvalError, Expression, Scope};

/// The cause of an error as one sentence, then the expression. [`super::context::Context`] calls it with what it has bound.
pub(super) fn cause(recipe: &Recipe, donors: &[Donor], scope: &Scope<'_>, error: &EvalError) -> String {
    let references = Expression::parse(&error.source_text).map(|e| e.references()).unwrap_or_default();
    let missing_value = || references.paths.iter().find_map(|path| missing_value(recipe, donors, path));
    let missing_tensor = || references.calls.iter().find_map(|call| missing_tensor(donors, call));
    let missing_name = || references.paths.iter().find_map(|path| missing_name(scope, path));
    let words = missing_value().or_else(missing_tensor).or_else(missing_name);
    format!("{} (`{}`)", words.unwrap_or_else(|| in_words(&error.cause)), error.source_text)
}

/// The first key that a value of the recipe's own lacks, such as one that `let` defines.
fn missing_name(scope: &Scope<'_>, path: &[String]) -> Option<String> {
    let (root, keys) = path.split_first()?;
    let (mut here, mut place) = (scope.get(root)?, root.clone());
    for key in keys {
        let Value::Object(map) = &mut here else { break };
        let Some(value) = map.remove(key) else { return Some(format!("{place} has no {key}")) };
        here = value;
        place = format!("{place}.{key}");
    }
    here.is_null().then(|| format!("{place} is null"))
}

/// The first key of a path that a donor's config lacks.
fn missing_value(recipe: &Recipe, donors: &[Donor], path: &[String]) -> Option<String> {
    let (stored, path) = match path.split_first() {
        Some((first, path)) if first == "stored" => (true, path),
        _ => (false, path),
    };
    let (role, keys) = path.split_first()?;
    let spec = recipe.donors.iter().find(|spec| spec.role == *role)?;
    let Some(donor) = donors.iter().find(|donor| donor.role == *role) else {
        return Some(format!("no {role} donor is given, {}; pass --donor {role}=DIR", spec.what));
    };
    let file = donor.checkpoint.document(files::CONFIG).and_then(|document| document.value.as_ref());
    let mut here = if stored { file.unwrap_or(&Value::Null) } else { &donor.config };
    if here.is_null() && !keys.is_empty() {
        return Some(format!("the {role} donor has no readable config.json"));
    }
    let mut place = String::new();
    for key in keys {
        let Value::Object(map) = here else {
            let null = || format!("{} of the {role} donor's config.json is null", place.trim_end_matches('.'));
            return here.is_null().then(null);
        };
        let Some(value) = map.get(key) else {
            let known: Vec<&str> = map.keys().map(String::as_str).collect();
            let hint = hint(key, &known);
            return Some(format!("the {role} donor's config.json has no {place}{key}; {hint}"));
        };
        here = value;
        place.push_str(key);
        place.push('.');
    }
    here.is_null().then(|| format!("{} of the {role} donor's config.json is null", place.trim_end_matches('.')))
}

/// The tensor that a call of `shape` names and the donor lacks.
fn missing_tensor(donors: &[Donor], call: &FunctionCall) -> Option<String> {
    let (true, [Some(role), Some(name)]) = (call.function == "shape", call.arguments.as_slice()) else { return None };
    let Some(donor) = donors.iter().find(|donor| donor.role == *role) else {
        return Some(format!("no {role} donor is given"));
    };
    if donor.checkpoint.tensor(name).is_some() {
        return None;
    }
    let reason = without_tensors(donor).map(|reason| format!(": {reason}")).unwrap_or_default();
    Some(format!("the {role} donor has no tensor {name}{reason}"))
}

/// The sentence about a donor without tensors.
pub(super) fn empty(donor: &Donor) -> Option<String> {
    without_tensors(donor).map(|reason| format!("the {} donor has no tensors: {reason}", donor.role))
}

/// File name extensions of weights from which no merge copies.
const PICKLES: [&str; 5] = [".bin", ".pt", ".pth", ".ckpt", ".pkl"];

/// The reason why no tensor of the donor was read; `None` when it has tensors.
fn without_tensors(donor: &Donor) -> Option<String> {
    if donor.checkpoint.tensors().next().is_some() {
        return None;
    }
    let pickle = donor.checkpoint.entries.keys().find(|name| PICKLES.iter().any(|end| name.ends_with(end)));
    Some(pickle.map_or_else(
        || "it has no safetensors file with a tensor in it".to_owned(),
        |pickle| {
            format!(
                "its weights are in {pickle}, a pickle, and a merge copies tensors of safetensors files only; convert it: from_pretrained(DIR).save_pretrained(NEW_DIR, safe_serialization=True)"
            )
        },
    ))
}

/// The starts of errors of the crate `cel` 0.15, and their meaning.
const WORDS: [(&str, &str); 8] = [
    ("found no matching overload", "a value is missing, or of another type than the expression needs"),
    ("Unexpected type", "a value is missing, or of another type than the expression needs"),
    ("Unable to use value", "a value cannot be used as a key"),
    ("Undeclared reference", "a name is not defined"),
    ("Index out of bounds", "a list is shorter than the expression needs"),
    ("Division by zero", "a divisor is zero"),
    ("Remainder by zero", "a divisor is zero"),
    ("Overflow", "a number exceeds 64 bits"),
];

/// The start of an error that a function of this program states: `Error executing function 'pow': …`.
const OF_A_FUNCTION: &str = "Error executing function '";

/// The start of the error about a key, which follows.
const NO_KEY: &str = "No such key: ";

/// An error of the crate `cel` as a sentence; those of this program are sentences.
fn in_words(cause: &str) -> String {
    if let Some((function, reason)) = cause.strip_prefix(OF_A_FUNCTION).and_then(|rest| rest.split_once("': ")) {
        return format!("{function}(…) fails: {reason}");
    }
    if let Some(key) = cause.strip_prefix(NO_KEY) {
        return format!("a value has no key {key}");
    }
    if cause.contains(" expected, got ") {
        return cause.to_owned();
    }
    let known = WORDS.iter().find(|(start, _)| cause.starts_with(start)).map(|(_, words)| *words);
    known.unwrap_or("the expression cannot be evaluated with these donors").to_owned()
}
