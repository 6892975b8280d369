//! `-v`: why rules were skipped.

use std::collections::BTreeMap;
use std::path::Path;

use ckpt_doctor::check::Outcome;
use ckpt_doctor::checkpoint::escape;
use ckpt_doctor::knowledge::rule::RuleSet;

use super::output;

/// Longest reason, in characters; `explain` shows a condition in full.
const REASON: usize = 100;

/// Prints why each skipped rule was skipped; rules with the same reason share a line.
pub fn say(dir: &Path, outcome: &Outcome, rules: &RuleSet) {
    let mut reasons: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for skipped in &outcome.skipped {
        reasons.entry(&skipped.why).or_default().push(&skipped.code);
    }
    let all: Vec<&str> = rules.all().map(|rule| rule.code.as_str()).collect();
    output::note(&output::safe(&format!(
        "{}: {} of {} rules skipped",
        dir.display(),
        outcome.skipped.len(),
        all.len()
    )));
    for (why, codes) in reasons {
        output::note(&format!("  {}: {}", escape(why, REASON), named(codes, &all).join(", ")));
    }
}

/// The codes, sorted, and a family by its name where all of it is among them.
fn named<'c>(mut codes: Vec<&'c str>, all: &[&str]) -> Vec<&'c str> {
    codes.sort_unstable();
    let whole = |family: &str| {
        let of = |list: &[&str]| list.iter().filter(|code| family_of(code) == family).count();
        of(&codes) > 1 && of(&codes) == of(all)
    };
    let mut names: Vec<&str> = Vec::new();
    for code in &codes {
        let family = family_of(code);
        names.push(if whole(family) { family } else { code });
    }
    names.dedup();
    names
}

fn family_of(code: &str) -> &str {
    code.trim_end_matches(|c: char| c.is_ascii_digit())
}
