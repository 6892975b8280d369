//! `docs/reported-problems.md`. `CKPT_DOCTOR_WRITE=1 cargo test --test it pages:: reported::` writes it.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use ckpt_doctor::check::Safety;
use ckpt_doctor::knowledge::problems::ReportedProblem;
use serde_json::Value;

use super::{Found, Problem, Rebuilt, found, problems};
use crate::pages::{fresh, markdown};

const HEAD: &str = "# Problems that users reported

Checkpoints that did not load, or loaded incorrectly, as described in public issue threads, with what `ckpt-doctor check`
says of such a directory. Every directory below is rebuilt in `fixtures/reported/` and checked by the tests of this project;
`tests/peer/reported.py` opens it with the loaders that it was reported for, where these can be installed.
";

/// The title of an area: its folder in `fixtures/reported/`, as a heading.
fn title(area: &str) -> String {
    let text = area.replace('-', " ");
    let mut letters = text.chars();
    letters.next().map(|first| first.to_uppercase().chain(letters).collect()).unwrap_or_default()
}

fn links(threads: &[String]) -> String {
    let link = |thread: &String| {
        let (repository, number) = thread.split_once('#').unwrap_or_default();
        format!("[{thread}](https://github.com/{repository}/issues/{number})")
    };
    threads.iter().map(link).collect::<Vec<_>>().join(", ")
}

/// The finding that names the cause, with its place and its fix.
fn said(case: &Rebuilt, found: &Found) -> String {
    let Some(finding) = found.defect.iter().find(|f| f["code"] == case.expect.code.as_str()) else {
        return String::new();
    };
    let text = |value: &Value| markdown(value.as_str().unwrap_or_default());
    let code = &case.expect.code;
    let mut out =
        format!("- **{code}** ({}): {}", finding["severity"].as_str().unwrap_or_default(), text(&finding["message"]));
    if !case.loaders.is_empty() {
        let _ = write!(out, " (with `--for {}`)", case.loaders.join(" --for "));
    }
    let fix = &finding["fix"];
    let advice = [&fix["title"], &fix["help"]].into_iter().find(|value| value.is_string());
    if let Some(advice) = advice {
        let _ = write!(out, "\n- Fix: {}", text(advice));
    }
    match case.fixed {
        Some(Safety::Safe) => out.push_str(" (`--fix`)"),
        Some(_) => out.push_str(" (`--fix --unsafe-fixes`)"),
        None => {}
    }
    out
}

fn entry(problem: &Problem, found: Option<&Found>) -> String {
    let Problem { problem: what, threads, symptom, cause, unseen, case, .. } = problem;
    let mut out = format!("\n### {}\n\n", markdown(what));
    let _ =
        writeln!(out, "- Reported: `{}` ({})\n- Cause: {}", symptom.replace('`', "'"), links(threads), markdown(cause));
    if let (Some(case), Some(found)) = (case, found) {
        let _ = writeln!(out, "{}", said(case, found));
    }
    if let Some(why) = unseen {
        let _ = writeln!(out, "- Not visible in the files: {}", markdown(why));
    }
    out
}

#[test]
fn embedded_problems_are_fresh() {
    let embedded = |problem: Problem| ReportedProblem {
        code: problem.case.map(|case| case.expect.code),
        thread: problem.threads.into_iter().next(),
        problem: problem.problem,
        symptom: problem.symptom,
        cause: problem.cause,
    };
    let all: Vec<ReportedProblem> = problems().into_iter().map(embedded).collect();
    fresh("rules/problems.json", &format!("{}\n", serde_json::to_string_pretty(&all).expect("text")));
}

#[test]
fn reported_problems_are_fresh() {
    let all = found();
    let threads: BTreeSet<&String> = all.iter().flat_map(|(problem, _)| &problem.threads).collect();
    let rebuilt = all.iter().filter(|(problem, _)| problem.case.is_some()).count();
    let repaired = all.iter().filter(|(problem, _)| problem.case.as_ref().is_some_and(|c| c.fixed.is_some())).count();
    let mut areas: BTreeMap<&str, Vec<&(Problem, Option<Found>)>> = BTreeMap::new();
    for entry in all {
        areas.entry(entry.0.name.split('/').next().unwrap_or_default()).or_default().push(entry);
    }
    let mut text = format!(
        "<!-- Generated: `CKPT_DOCTOR_WRITE=1 cargo test --test it reported::` writes this file. -->\n\n{HEAD}"
    );
    let _ = writeln!(
        text,
        "\n{} problems from {} threads; {rebuilt} are visible in files and rebuilt, and `check --fix` repairs {repaired} of these.",
        all.len(),
        threads.len()
    );
    for (area, mut problems) in areas {
        problems.sort_by_key(|(problem, _)| (problem.case.is_none(), problem.seen, problem.name.clone()));
        let _ = write!(text, "\n## {}\n", title(area));
        text.extend(problems.iter().map(|(problem, found)| entry(problem, found.as_ref())));
    }
    fresh("docs/reported-problems.md", &text);
}
