//! The data files that a user may write: rules, recipes, architectures, quantisation schemes, expressions.
//!
//! The first byte selects the kind. Expressions have inputs of their own, because their parser is slow; files with many
//! expressions would take most of the time.

#![no_main]

use ckpt_doctor::knowledge::quantization::Scheme;
use ckpt_doctor::knowledge::recipe::{MergeFile, Recipe};
use ckpt_doctor::knowledge::rule::RuleFile;
use ckpt_doctor::knowledge::{Expression, Library, Scope, Template, source};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((kind, rest)) = data.split_first() else { return };
    let Ok(text) = std::str::from_utf8(rest) else { return };
    match kind % 16 {
        0..3 => drop(source::parse_lazily::<RuleFile>("rule.json5", text)),
        3..6 => drop(source::parse_lazily::<Recipe>("recipe.json5", text)),
        6..9 => drop(Library::default().add("architecture.json5", text)),
        9..12 => drop(source::parse_lazily::<Scheme>("scheme.json5", text)),
        12..15 => drop(source::parse::<MergeFile>("merge.json5", text)),
        _ => {
            if let Ok(expression) = Expression::parse(text) {
                let mut scope = Scope::new();
                scope.bind_int("a", 7);
                drop(expression.eval(&scope));
            }
            if let Ok(template) = Template::parse(text) {
                drop(template.render(&Scope::new()));
            }
        }
    }
});
