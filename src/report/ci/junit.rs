//! `JUnit` XML: a test suite for each checkpoint, a test case for each finding.
//!
//! Errors and warnings are failures; findings of severity info are skipped tests. A checkpoint without findings is one
//! passed test; a path that could not be checked is a test with an error. Times are omitted, because none are measured.

use std::fmt::Write as _;

use quick_junit::{NonSuccessKind, Property, TestCase, TestCaseStatus, TestSuite};

use super::{Group, Item, PATH, UNCHECKED, file, groups, spot};
use crate::checkpoint::escape;
use crate::report::Report;
use crate::report::format::{more, name, tensors};

/// Maximum number of places printed for one finding.
const PLACES: usize = 100;

pub fn render(report: &Report) -> String {
    let mut out = quick_junit::Report::new(report.tool.name);
    for group in groups(report) {
        let mut suite = TestSuite::new(words(&group.title));
        if !group.headline.is_empty() {
            suite.add_property(Property::new("verdict", legal(&group.headline)));
        }
        if let Some(governed) = &group.governed {
            suite.add_property(Property::new("settings", legal(governed)));
        }
        if group.hides_failure {
            let mut status = TestCaseStatus::non_success(NonSuccessKind::Failure);
            status.set_message("findings below --min-severity, which --fail-on counts");
            let mut case = TestCase::new("findings that are not listed", status);
            case.set_classname(words(&group.path));
            suite.add_test_case(case);
        } else if group.items.is_empty() {
            let mut case = TestCase::new("clean", TestCaseStatus::success());
            case.set_classname(words(&group.path));
            suite.add_test_case(case);
        }
        suite.add_test_cases(group.items.iter().map(|item| case(&group, item)));
        out.add_test_suite(suite);
    }
    let mut text = match out.to_string() {
        Ok(text) => text,
        // Writing to memory cannot fail.
        Err(error) => format!("<!-- {} -->", words(&error.to_string()).replace("--", "- ")),
    };
    if !text.ends_with('\n') {
        text.push('\n');
    }
    text
}

fn case(group: &Group<'_>, item: &Item<'_>) -> TestCase {
    // A suite fails exactly where the exit code does.
    let mut status = match item.fails {
        _ if item.code == UNCHECKED => TestCaseStatus::non_success(NonSuccessKind::Error),
        true => TestCaseStatus::non_success(NonSuccessKind::Failure),
        false => TestCaseStatus::skipped(),
    };
    status
        .set_type(item.severity.name())
        .set_message(legal(&item.message))
        .set_description(legal(&description(group, item)));
    let first = item.locations.first();
    let place = first.and_then(|l| file(&group.path, l)).unwrap_or_else(|| group.path.clone());
    let mut case = TestCase::new(legal(&format!("{} {}", name(item.code), name(item.name))), status);
    case.set_classname(words(&place));
    case
}

/// The complete finding, one line for each part.
fn description(group: &Group<'_>, item: &Item<'_>) -> String {
    let mut out = item.message.clone();
    let mut places: Vec<String> = item.locations.iter().map(|l| escape(&spot(&group.path, l), PATH)).collect();
    places.dedup();
    for place in places.iter().take(PLACES) {
        let _infallible = write!(out, "\nat {place}");
    }
    if let Some(more) = more(places.len(), PLACES) {
        let _infallible = write!(out, "\n{more}");
    }
    for tensor in tensors(&item.message, item.locations, PLACES) {
        let _infallible = write!(out, "\ntensor {tensor}");
    }
    if let Some(help) = &item.help {
        let _infallible = write!(out, "\nhelp: {help}");
    }
    out
}

fn words(text: &str) -> String {
    legal(&escape(text, PATH))
}

/// Removes the two characters that XML forbids and [`escape`] does not replace.
fn legal(text: &str) -> String {
    text.replace(['\u{fffe}', '\u{ffff}'], "\u{fffd}")
}
