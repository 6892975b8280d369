//! The search of `explain` for the problem that an error comes from.

use ckpt_doctor::knowledge::problems::{reported_problems, search};
use ckpt_doctor::knowledge::rule::RuleSet;

use crate::support::Draw;

/// A text as another user has it: behind a traceback, with other numbers, and with every sixth word lost.
fn as_told(symptom: &str, draw: &mut Draw) -> String {
    let mut told = String::from(
        "Traceback (most recent call last):\n  File \"/home/me/run.py\", line 12, in <module>\n    model = AutoModel.from_pretrained(path)\n",
    );
    let other = |c: char| c.to_digit(10).and_then(|digit| char::from_digit((digit + 3) % 10, 10)).unwrap_or(c);
    for word in symptom.split(' ').filter(|_| draw.below(6) != 0) {
        told.extend(word.chars().map(other));
        told.push(' ');
    }
    told
}

#[test]
fn the_text_of_an_error_leads_to_its_problem() {
    let rules = RuleSet::embedded().unwrap();
    let problems = reported_problems(&rules).unwrap();
    let reported: Vec<_> = problems.iter().filter(|problem| problem.thread.is_some()).collect();
    let mut draw = Draw::new(20_261_126);
    let mut missed = Vec::new();
    for problem in &reported {
        let told = as_told(&problem.symptom, &mut draw);
        let found = search(&problems, &told);
        let is_found = |one: &&ckpt_doctor::knowledge::problems::ReportedProblem| {
            one.problem == problem.problem || one.code.is_some() && one.code == problem.code
        };
        if !found.iter().any(is_found) {
            missed.push(format!("{}\n  {told}", problem.problem));
        }
    }
    assert!(
        reported.len() > 150 && missed.len() * 10 <= reported.len(),
        "{} of {}:\n{}",
        missed.len(),
        reported.len(),
        missed.join("\n")
    );
    for text in ["", "hello world", "the quick brown fox", "ConnectionError while talking to the printer"] {
        assert_eq!(search(&problems, text).len(), 0, "{text}");
    }
}
