//! Workflow commands of GitHub Actions: one line per finding, displayed beside the file.
//!
//! <https://docs.github.com/en/actions/reference/workflow-commands-for-github-actions>; the escapes are those of
//! `@actions/core`.

use std::fmt::Write as _;

use super::{Group, Item, PATH, file, groups};
use crate::check::Severity;
use crate::checkpoint::escape;
use crate::report::Report;
use crate::report::format::name;

pub fn render(report: &Report) -> String {
    let mut out = String::new();
    for group in groups(report) {
        if !group.headline.is_empty() {
            let verdict = format!("{}: {}", escape(&group.title, PATH), group.headline);
            let _infallible = writeln!(out, "::notice title=verdict::{}", data(&verdict));
        }
        if let Some(governed) = &group.governed {
            let settings = format!("{}: {governed}", escape(&group.title, PATH));
            let _infallible = writeln!(out, "::notice title=settings::{}", data(&settings));
        }
        for item in &group.items {
            command(&mut out, &group, item);
        }
    }
    out
}

fn command(out: &mut String, group: &Group<'_>, item: &Item<'_>) {
    let word = match item.severity {
        Severity::Error => "error",
        Severity::Warning => "warning",
        Severity::Info => "notice",
    };
    let _infallible = write!(out, "::{word} ");
    let place = item.locations.first().and_then(|l| Some((l, file(&group.path, l)?)));
    let mut message = String::new();
    if let Some((location, file)) = &place {
        let _infallible = write!(out, "file={},", property(&escape(file, PATH)));
        if let Some(line) = location.line {
            let _infallible = write!(out, "line={line},");
            if let Some(column) = location.column {
                let _infallible = write!(out, "col={column},");
            }
        }
    } else {
        // Without a file, the annotation is displayed at the top of the run, so the message names the checkpoint.
        let _infallible = write!(message, "{}: ", escape(&group.title, PATH));
    }
    message.push_str(&item.message);
    if let Some(help) = &item.help {
        let _infallible = write!(message, "\nhelp: {help}");
    }
    let _infallible = writeln!(out, "title={}::{}", property(&name(item.code)), data(&message));
}

/// Escapes the message, after the second `::`.
fn data(text: &str) -> String {
    text.replace('%', "%25").replace('\r', "%0D").replace('\n', "%0A")
}

/// Escapes a value between the first `::` and the second.
fn property(text: &str) -> String {
    data(text).replace(':', "%3A").replace(',', "%2C")
}

#[cfg(test)]
mod tests {
    use super::{data, property};

    #[test]
    fn delimiters_are_escaped_once() {
        assert_eq!(data("100%0A, a:b\r\n"), "100%250A, a:b%0D%0A");
        assert_eq!(property("a::b,c%2C"), "a%3A%3Ab%2Cc%252C");
    }
}
