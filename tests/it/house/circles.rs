//! No file of `src` needs another one that needs it: what a reader has to know of a file lies below it.

use std::collections::{BTreeMap, BTreeSet};

use regex::Regex;

use super::{none, sources, without_tests};

/// The path of a module below the crate: `["merge", "plan"]`.
type Module = Vec<String>;

/// The module of a source, for `src/merge/plan.rs`; the root of the crate is empty.
fn module(path: &str) -> Module {
    let inside = path.trim_start_matches("src/").trim_end_matches(".rs");
    if ["lib", "main"].contains(&inside) { Module::new() } else { inside.split('/').map(str::to_owned).collect() }
}

/// The paths of a tree of `use`: `a::{b, c::d}` are `a::b` and `a::c::d`.
fn flattened(tree: &str) -> Vec<String> {
    let tree = tree.trim();
    let Some((prefix, inner)) = tree.split_once('{') else { return vec![tree.to_owned()] };
    let inner = inner.trim_end().trim_end_matches('}');
    let mut depth = 0_usize;
    let parts = inner.split(|c| {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            _ => {}
        }
        c == ',' && depth == 0
    });
    parts.filter(|part| !part.trim().is_empty()).flat_map(|part| flattened(&format!("{prefix}{part}"))).collect()
}

/// The modules that a source names in `use` and in paths from `crate` or `super`. The modules around it are its face, and not
/// counted.
fn needed(of: &Module, code: &str, modules: &BTreeSet<Module>) -> BTreeSet<Module> {
    let uses = Regex::new(r"(?s)\buse ((?:crate|super|self)::.*?);").expect("a pattern");
    let paths = Regex::new(r"\b(?:crate|super)(?:::\w+)+").expect("a pattern");
    let named = uses.captures_iter(code).flat_map(|found| flattened(&found[1]));
    let named = named.chain(paths.find_iter(code).map(|found| found.as_str().to_owned()));
    let resolved = named.filter_map(|path| {
        let mut here = of.clone();
        for segment in path.split("::").map(str::trim) {
            match segment {
                "crate" => here.clear(),
                "super" => drop(here.pop()),
                "self" => {}
                name => here.push(name.to_owned()),
            }
        }
        (0..=here.len()).rev().map(|len| here[..len].to_vec()).find(|module| modules.contains(module))
    });
    resolved.filter(|module| !of.starts_with(module)).collect()
}

#[test]
fn no_file_needs_a_file_that_needs_it() {
    let sources: Vec<(Module, String)> = sources()
        .into_iter()
        .filter(|(path, _)| !path.ends_with("tests.rs") && !path.contains("/tests/"))
        .map(|(path, text)| (module(&path), without_tests(&text)))
        .collect();
    let modules: BTreeSet<Module> = sources.iter().map(|(module, _)| module.clone()).collect();
    let mut left: BTreeMap<Module, BTreeSet<Module>> =
        sources.iter().map(|(of, code)| (of.clone(), needed(of, code, &modules))).collect();
    assert!(left.values().map(BTreeSet::len).sum::<usize>() > 500, "the imports are not read");
    // A file below which no file is left is in no circle; nor is one above all others.
    loop {
        let ends: Vec<Module> = left.iter().filter(|(_, needs)| needs.is_empty()).map(|(of, _)| of.clone()).collect();
        if ends.is_empty() {
            break;
        }
        left.retain(|of, _| !ends.contains(of));
        for needs in left.values_mut() {
            needs.retain(|of| !ends.contains(of));
        }
    }
    loop {
        let wanted: BTreeSet<Module> = left.values().flatten().cloned().collect();
        let before = left.len();
        left.retain(|of, _| wanted.contains(of));
        if left.len() == before {
            break;
        }
    }
    let line = |(of, needs): (&Module, &BTreeSet<Module>)| {
        let needs: Vec<String> = needs.iter().map(|module| module.join("::")).collect();
        format!("{} is in a circle with {}", of.join("::"), needs.join(", "))
    };
    none(&left.iter().map(line).collect::<Vec<_>>());
}
