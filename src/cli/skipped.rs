//! `-v`: why rules were skipped.

use std::collections::BTreeMap;
use std::path::Path;

use super::output;
use crate::check::finding::Skipped;
use crate::checkpoint::escape;
use crate::knowledge::rule::RuleSet;

/// Maximum length of a reason, in characters: that of a rule of the user ends with its condition.
const REASON: usize = 100;

/// Prints why each skipped rule was skipped; rules with the same reason share a line.
pub fn print(dir: &Path, skips: &[Skipped], rules: &RuleSet) {
    let mut reasons: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for skipped in skips {
        reasons.entry(&skipped.why).or_default().push(&skipped.code);
    }
    let all: Vec<&str> = rules.all().map(|rule| rule.code.as_str()).collect();
    output::note(&output::safe(&format!("{}: {} of {} rules were skipped", dir.display(), skips.len(), all.len())));
    for (why, codes) in reasons {
        output::note(&format!("  {}: {}", escape(why, REASON), named(codes, &all).join(", ")));
    }
}

/// The codes, sorted; a family whose rules are all among them is printed as one name.
fn named<'c>(mut codes: Vec<&'c str>, all: &[&str]) -> Vec<&'c str> {
    codes.sort_unstable();
    let whole = |family: &str| {
        let count = |list: &[&str]| list.iter().filter(|code| family_of(code) == family).count();
        count(&codes) > 1 && count(&codes) == count(all)
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
