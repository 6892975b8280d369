//! The examples in README.md and docs/ match the output of the program.
//!
//! The commands of `console` blocks run in order, page by page, each page in a directory of its own. A `text` block
//! that starts with a command is not run: it shows the output of a command that a `console` block of the page runs.
//! A line `...` in an example matches any number of lines.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;
use std::{env, fs};

use crate::support::project;

/// A command and the output that a page shows for it.
struct Example<'a> {
    command: &'a str,
    output: Vec<&'a str>,
    runs: bool,
}

/// The examples of a page, in order.
fn examples(page: &str) -> Vec<Example<'_>> {
    let mut all: Vec<Example> = Vec::new();
    let mut language = None;
    let mut started = false;
    for line in page.lines() {
        if let Some(fence) = line.strip_prefix("```") {
            language = (language.is_none() && !fence.is_empty()).then_some(fence);
            started = false;
            continue;
        }
        let Some(language @ ("console" | "text")) = language else { continue };
        match line.strip_prefix("$ ") {
            Some(command) => {
                started = true;
                all.push(Example { command, output: Vec::new(), runs: language == "console" });
            }
            None if started => all.last_mut().expect("a command").output.push(line),
            None => assert!(language == "text", "a console block starts with its output: {line}"),
        }
    }
    all
}

/// Whether the real output matches the example.
fn matches(shown: &[&str], real: &[&str]) -> bool {
    match shown.split_first() {
        None => real.is_empty(),
        Some((&"...", rest)) => (0..=real.len()).any(|skip| real.get(skip..).is_some_and(|real| matches(rest, real))),
        Some((first, rest)) => {
            real.split_first().is_some_and(|(line, real)| line.trim_end() == *first && matches(rest, real))
        }
    }
}

/// Runs a command in a shell, with the program of this build on the path; both outputs.
fn run(command: &str, place: &Path) -> (String, String) {
    let program = Path::new(env!("CARGO_BIN_EXE_ckpt-doctor")).parent().unwrap().to_owned();
    let path = env::join_paths([program].into_iter().chain(env::split_paths(&env::var_os("PATH").unwrap()))).unwrap();
    let mut shell = Command::new("sh");
    shell.args(["-c", command]).current_dir(place).env("PATH", path).env("XDG_STATE_HOME", crate::support::state());
    shell.env_remove("FORCE_COLOR").env_remove("CLICOLOR_FORCE");
    let ran = shell.output().unwrap();
    (String::from_utf8(ran.stdout).unwrap(), String::from_utf8(ran.stderr).unwrap())
}

/// Examples that differ from the real output.
fn differences(page: &str) -> String {
    let place = tempfile::tempdir().unwrap();
    // The directory of a clone after the first build: fixtures and a target directory.
    let copied = Command::new("cp").arg("-r").arg(project().join("fixtures")).arg(place.path()).status().unwrap();
    assert!(copied.success());
    fs::create_dir(place.path().join("target")).unwrap();

    let mut wrong = String::new();
    let mut printed: BTreeMap<&str, String> = BTreeMap::new();
    let examples = examples(page);
    for Example { command, output, .. } in examples.iter().filter(|e| e.runs) {
        let (real, errors) = run(command, place.path());
        if !matches(output, &real.lines().collect::<Vec<_>>()) {
            let _ok = writeln!(wrong, "$ {command}\n{real}{errors}");
        }
        printed.insert(command, real);
    }
    for Example { command, output, .. } in examples.iter().filter(|e| !e.runs) {
        match printed.get(command) {
            Some(real) if matches(output, &real.lines().collect::<Vec<_>>()) => {}
            Some(real) => _ = writeln!(wrong, "shown before it runs: $ {command}\n{real}"),
            None => _ = writeln!(wrong, "shown, but not run by a console block: $ {command}"),
        }
    }
    wrong
}

#[test]
fn examples_match_the_output() {
    let docs = fs::read_dir(project().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let mut pages: Vec<_> = docs.filter(|path| path.extension().is_some_and(|e| e == "md")).collect();
    pages.push(project().join("README.md"));
    let mut wrong = String::new();
    let mut found = 0;
    for path in pages {
        let page = fs::read_to_string(&path).unwrap();
        if examples(&page).is_empty() {
            continue;
        }
        found += 1;
        let differences = differences(&page);
        if !differences.is_empty() {
            let _ok = writeln!(wrong, "{} shows something else for\n{differences}", path.display());
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
    assert!(found >= 5, "{found} pages with examples");
}

#[test]
fn the_readme_shows_the_hook_that_init_writes() {
    let read = |file: &str| fs::read_to_string(project().join(file)).unwrap();
    let template = read("src/cli/init/pre-commit-config.yaml");
    let (_comment, hook) = template.split_once('\n').unwrap();
    assert!(read("README.md").contains(hook), "{hook}");
}

/// Links between pages point to existing files and headings.
#[test]
fn links_between_pages_resolve() {
    let link = regex::Regex::new(r"\]\(([^)\s:]+)\)").unwrap();
    let mut wrong = String::new();
    let mut pages = crate::support::files(&project().join("docs"), ".md");
    for folder in ["", "fixtures", "fuzz", "tests", "rules"] {
        let readme = project().join(folder).join("README.md");
        pages.push(readme);
    }
    pages.extend(["CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"].map(|name| project().join(name)));
    for path in pages {
        let page = fs::read_to_string(&path).unwrap();
        for found in link.captures_iter(&page) {
            let (file, heading) = found[1].split_once('#').unwrap_or((&found[1], ""));
            let target = if file.is_empty() { path.clone() } else { path.parent().unwrap().join(file) };
            let there = target.exists() && (heading.is_empty() || anchors(&target).iter().any(|a| a == heading));
            if !there {
                let _ok = writeln!(wrong, "{}: {}", path.display(), &found[1]);
            }
        }
    }
    assert!(wrong.is_empty(), "links that lead nowhere:\n{wrong}");
}

/// The anchors of a page's headings, as generated by GitHub.
fn anchors(path: &Path) -> Vec<String> {
    let text = fs::read_to_string(path).unwrap();
    let headings = text.lines().filter(|line| line.starts_with('#'));
    headings
        .map(|line| {
            let kept = |c: &char| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_');
            line.trim_start_matches('#')
                .trim()
                .to_lowercase()
                .chars()
                .filter(kept)
                .collect::<String>()
                .replace(' ', "-")
        })
        .collect()
}
