//! The law of mistakes: a recipe with a mistake anywhere is accepted, or refused with file, line and column, in words.
//!
//! Every recipe of the program and of the fixtures is changed at random; the changes follow from a seed.
//! `CKPT_DOCTOR_LAWS=1000` sets the number for each recipe.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::knowledge::recipe::Recipe;
use ckpt_doctor::merge::validate;
use regex::Regex;

use crate::support::{Draw, knowledge, texts};

/// Mutants of each recipe in a plain `cargo test`.
const EACH: usize = 40;

/// Texts that replace a string of a recipe: mistakes of every kind.
const MISTAKES: &[&str] = &[
    "",
    "nobody",
    "opt.nothing",
    "opt.",
    "1 +",
    "a b",
    "tokens.nothing",
    "id_of('<image>')",
    "shape('nobody', 'x')",
    "stored.nobody.x",
    "{",
    "{nothing}",
    "../x",
    "/etc/passwd",
    "(",
    "[",
    "x.safetensors",
    "projector=pad",
    "*",
    "/~2",
    "/auto_map/x/y",
    "'fold'",
    "x.map(y, y + z)",
    "99999999999999999999",
    "\\u0000",
    "#",
];

/// One change of a text.
fn mutant(draw: &mut Draw, text: &str) -> String {
    let strings: Vec<_> =
        Regex::new(r#""([^"\\\n]*)""#).unwrap().captures_iter(text).map(|c| c.get(1).unwrap()).collect();
    let replaced =
        |found: &regex::Match<'_>, new: &str| format!("{}{new}{}", &text[..found.start()], &text[found.end()..]);
    let lines: Vec<&str> = text.lines().collect();
    let line = draw.below(lines.len());
    match draw.below(6) {
        0 => replaced(&strings[draw.below(strings.len())], draw.one(MISTAKES)),
        1 => replaced(&strings[draw.below(strings.len())], strings[draw.below(strings.len())].as_str()),
        2 => {
            // A word with two exchanged letters.
            let words: Vec<_> = Regex::new(r"[A-Za-z_]{3,}").unwrap().find_iter(text).collect();
            let word = words[draw.below(words.len())];
            let mut letters: Vec<char> = word.as_str().chars().collect();
            let at = draw.below(letters.len() - 1);
            letters.swap(at, at + 1);
            replaced(&word, &letters.iter().collect::<String>())
        }
        3 => [&lines[..line], &lines[line + 1..]].concat().join("\n"),
        4 => [&lines[..=line], &lines[line..]].concat().join("\n"),
        _ => {
            let at = text.char_indices().nth(draw.below(text.chars().count())).map_or(0, |(at, _)| at);
            format!("{}{}{}", &text[..at], draw.one(MISTAKES), &text[at..])
        }
    }
}

/// What became of a mutant; panics unless it is accepted, or refused with its place.
fn outcome(path: &str, text: &str, knowledge: &Knowledge) -> &'static str {
    let error = match Recipe::parse(path, text) {
        Err(error) => error,
        Ok(recipe) => match validate(&recipe, path, text, knowledge) {
            Err(error) => error,
            Ok(()) => return "accepted",
        },
    };
    let error = error.to_string();
    let place = error.strip_prefix(path).and_then(|rest| rest.strip_prefix(':')).unwrap_or_default();
    let mut parts = place.splitn(3, ':');
    let number = |part: Option<&str>| part.is_some_and(|part| part.parse::<usize>().is_ok_and(|n| n > 0));
    assert!(number(parts.next()) && number(parts.next()), "no place: {error}");
    let words = parts.next().unwrap_or_default();
    assert!(words.split_whitespace().count() > 1, "no words: {error}");
    for raw in ["Syntax error", "Undeclared reference", "overload"] {
        assert!(!words.contains(raw) || words.contains("is not an expression"), "raw words alone: {error}");
    }
    "refused"
}

#[test]
fn a_mistake_in_a_recipe_is_refused_with_its_place() {
    let each = std::env::var("CKPT_DOCTOR_LAWS").map_or(EACH, |n| n.parse().expect("a number"));
    let knowledge = knowledge();
    let recipe = |(_, text): &(String, String)| text.contains("donors:");
    let recipes = texts("rules/recipes").into_iter().chain(texts("fixtures/recipes")).filter(recipe);
    let (mut outcomes, mut broken) = (BTreeMap::<&str, usize>::new(), Vec::new());
    for (path, text) in recipes {
        let mut draw = Draw::new(text.len() as u64);
        for _ in 0..each {
            let mutant = mutant(&mut draw, &text);
            match catch_unwind(AssertUnwindSafe(|| outcome(&path, &mutant, &knowledge))) {
                Ok(outcome) => *outcomes.entry(outcome).or_default() += 1,
                Err(reason) => {
                    let reason = reason.downcast_ref::<String>().cloned().unwrap_or_default();
                    broken.push(format!("{path}: {reason}"));
                }
            }
        }
    }
    assert!(broken.is_empty(), "{}:\n{}", broken.len(), broken.join("\n"));
    assert!(outcomes["accepted"] > 20 && outcomes["refused"] > 200, "{outcomes:?}");
}
