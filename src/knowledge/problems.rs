//! Problems that users reported, and the search for one by the text of an error: `rules/problems.json`.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::rule::{Consequence, RuleSet};
use super::source::{self, DataError};

/// Most problems that a search returns.
const FOUND: usize = 5;

/// Lowest score of a problem that is returned, from 0 to 1.
const ALIKE: f64 = 0.3;

/// Least weight of the words that are shared: a word that one problem in three hundred has weighs 5.7, one that every second has 1.1.
const SHARED: f64 = 5.0;

/// Words of a text that are looked at: a traceback has a few hundred.
const WORDS: usize = 20_000;

/// A reported problem, or the exception of a rule.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ReportedProblem {
    /// What is wrong with the directory, in one sentence.
    pub problem: String,
    /// What the user sees, in the words of the program that fails.
    pub symptom: String,
    /// Why it fails.
    pub cause: String,
    /// The rule that reports it; `None` where the files do not show it.
    pub code: Option<String>,
    /// A thread that reports it, as `owner/repository#number`; `None` for the exception of a rule.
    pub thread: Option<String>,
}

/// The problems of `rules/problems.json`, which `tests/it/reported` writes, and the exceptions that the rules predict.
///
/// # Errors
/// An embedded file that cannot be parsed.
pub fn reported_problems(rules: &RuleSet) -> Result<Vec<ReportedProblem>, DataError> {
    let file = "problems.json";
    let text = source::text(file).unwrap_or_default();
    let mut problems: Vec<ReportedProblem> = source::parse_embedded(&format!("rules/{file}"), text)?;
    for rule in rules.all() {
        let raising = rule.effects.iter().filter(|effect| effect.consequence == Consequence::Raises);
        problems.extend(raising.map(|effect| ReportedProblem {
            problem: rule.summary.clone(),
            symptom: effect.text.prose(),
            cause: rule.why.clone(),
            code: Some(rule.code.clone()),
            thread: None,
        }));
    }
    Ok(problems)
}

/// The problems whose words are most like those of `text`, the best first; each rule and each problem once. `explain` calls it
/// with the text of an error, a traceback too. None when nothing is alike.
///
/// A rare word counts more than a common one. Words that no problem has, such as the paths of the user, do not count.
#[must_use]
pub fn search<'p>(problems: &'p [ReportedProblem], text: &str) -> Vec<&'p ReportedProblem> {
    let symptoms: Vec<BTreeSet<String>> = problems.iter().map(|problem| words(&problem.symptom)).collect();
    let others: Vec<BTreeSet<String>> =
        problems.iter().map(|problem| words(&format!("{} {}", problem.problem, problem.cause))).collect();
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for (symptom, other) in symptoms.iter().zip(&others) {
        for word in symptom.union(other) {
            let count = counts.entry(word).or_default();
            *count = count.saturating_add(1);
        }
    }
    let all = as_f64(problems.len());
    let weight = |word: &String| counts.get(word.as_str()).map_or(0.0, |count| (1.0 + all / as_f64(*count)).ln());
    let sum = |words: &mut dyn Iterator<Item = &String>| words.map(weight).sum::<f64>();
    let asked = words(text);
    let total = sum(&mut asked.iter());
    let score = |symptom: &BTreeSet<String>, other: &BTreeSet<String>| {
        let shared = sum(&mut symptom.intersection(&asked));
        let beside = sum(&mut other.difference(symptom).filter(|word| asked.contains(*word)));
        let of_text = shared + beside / 2.0;
        if of_text < SHARED { 0.0 } else { share(shared, sum(&mut symptom.iter())).midpoint(share(of_text, total)) }
    };
    let scores = symptoms.iter().zip(&others).map(|(symptom, other)| score(symptom, other));
    let mut scored: Vec<(f64, &ReportedProblem)> = scores.zip(problems).filter(|(score, _)| *score >= ALIKE).collect();
    // A reported one stands before the exception of its rule.
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| Reverse(&a.1.thread).cmp(&Reverse(&b.1.thread))));
    let mut found: Vec<&ReportedProblem> = Vec::new();
    for (_, problem) in scored {
        let is_known =
            found.iter().any(|one| one.problem == problem.problem || one.code.is_some() && one.code == problem.code);
        if !is_known && found.len() < FOUND {
            found.push(problem);
        }
    }
    found
}

/// The words of a text without numbers, in lower case: `size`, `mismatch`, `lm_head`.
fn words(text: &str) -> BTreeSet<String> {
    let is_word = |word: &&str| word.len() > 2 && word.bytes().any(|b| b.is_ascii_alphabetic());
    let parts = text.split(|c: char| !c.is_alphanumeric() && c != '_').take(WORDS);
    parts.filter(is_word).map(str::to_lowercase).collect()
}

fn share(part: f64, whole: f64) -> f64 {
    if whole > 0.0 { part / whole } else { 0.0 }
}

#[expect(clippy::cast_precision_loss, reason = "counts of problems")]
const fn as_f64(count: usize) -> f64 {
    count as f64
}
