//! `rules` and `explain`.

use std::fmt::{self, Write};
use std::path::Path;

use anyhow::bail;
use comfy_table::{ContentArrangement, Row, Table, presets};

use super::args::{ExplainArgs, SettingsArgs};
use super::exit::CLEAN;
use super::output;
use super::settings::{Typed, resolve};
use crate::knowledge::problems::{reported_problems, search};
use crate::knowledge::rule::{Fix, Object, Rule, RuleSet, Safety, example};
use crate::knowledge::settings::Surroundings;
use crate::knowledge::{Loader, Template};
use crate::report::{recipes, wrap};

/// Runs `rules`: lists the selected rules.
pub fn list(args: &SettingsArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let here = resolve(&Typed::new(args, rules), &Surroundings::new([]))?;
    let rows = here.knowledge.rules.rules.iter().map(|rule| [&rule.code, rule.highest_severity().name(), &rule.name]);
    output::print(&table(rows, None))?;
    Ok(CLEAN)
}

/// Runs `explain`: prints the page of a rule or a recipe, or the list of a family.
pub fn explain(args: &ExplainArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let here = resolve(&Typed::new(&args.settings, rules), &Surroundings::new([]))?;
    let rules = &here.knowledge.rules;
    let words = args.words.join(" ");
    let width = output::width();
    let recipe = here.knowledge.recipes.iter().find(|recipe| recipe.recipe == words);
    let text = match (recipe, family(rules, &words, width)) {
        (Some(recipe), _) => recipes::page(recipe),
        (None, Some(list)) => list,
        (None, None) if words.trim().contains(char::is_whitespace) => error_page(rules, &words)?,
        (None, None) => page(rules.find(&words)?, width)?,
    };
    output::print(&fit(&text, width))?;
    Ok(CLEAN)
}

/// The text with lines of at most `width` columns; what continues a line is indented as it.
fn fit(text: &str, width: Option<usize>) -> String {
    let fit_line = |line: &str| {
        let words = line.trim_start();
        let indent = line.len().saturating_sub(words.len());
        let text = wrap(words, width.map(|width| width.saturating_sub(indent)));
        format!("{:indent$}{}\n", "", text.replace('\n', &format!("\n{:indent$}", "")))
    };
    text.lines().map(fit_line).collect()
}

/// Cells in columns, of at most `width` columns in all.
fn table<R: Into<Row>>(rows: impl IntoIterator<Item = R>, width: Option<usize>) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).add_rows(rows);
    if let Some(width) = width {
        table.set_content_arrangement(ContentArrangement::Dynamic);
        table.set_width(u16::try_from(width).unwrap_or(u16::MAX).max(40));
    }
    let line = |line: String| format!("{}\n", line.strip_prefix(' ').unwrap_or(&line).trim_end());
    table.lines().map(line).collect()
}

/// The problems that the text of an error may come from.
fn error_page(rules: &RuleSet, words: &str) -> anyhow::Result<String> {
    let problems = reported_problems(rules)?;
    let found = search(&problems, words);
    if found.is_empty() {
        bail!("no known problem has a text like this; `ckpt-doctor check DIR` tells what is wrong with a directory");
    }
    let mut out = String::from("Known problems with a text like this, the most similar first\n");
    for problem in found {
        writeln!(out, "\n{}\n  Error: {}\n  Cause: {}", problem.problem, problem.symptom, problem.cause)?;
        match &problem.code {
            Some(code) => writeln!(out, "  Rule: {code} {}", rules.find(code)?.name)?,
            None => writeln!(out, "  Rule: none, the files do not show it")?,
        }
        if let Some(thread) = &problem.thread {
            writeln!(out, "  Reported in: {thread}")?;
        }
    }
    writeln!(out, "\n`ckpt-doctor check DIR` tells whether a directory has one of them.")?;
    Ok(out)
}

/// Title and rules of a family; `None` if `word` is not a family.
fn family(rules: &RuleSet, word: &str, width: Option<usize>) -> Option<String> {
    let word = word.to_ascii_uppercase();
    let is_member = |rule: &&Rule| rule.code.trim_end_matches(|c: char| c.is_ascii_digit()) == word;
    let members: Vec<&Rule> = rules.all().filter(is_member).collect();
    let title = rules.catalogue.families.iter().find(|(family, _)| *family == word);
    let title = title.map(|(_, title)| format!(": {title}")).unwrap_or_default();
    let rows =
        members.iter().map(|rule| [rule.code.as_str(), rule.highest_severity().name(), &rule.name, &rule.summary]);
    (!members.is_empty()).then(|| format!("{word}{title}\n\n{}", table(rows, width)))
}

fn page(rule: &Rule, width: Option<usize>) -> Result<String, fmt::Error> {
    let mut out = String::new();
    writeln!(out, "{} {} ({})\n", rule.code, rule.name, rule.highest_severity().name())?;
    writeln!(out, "What it reports\n  {}\n", rule.summary)?;
    writeln!(out, "Why it matters\n  {}", rule.why)?;
    if !rule.applies.is_empty() {
        writeln!(out, "\nApplies to\n  {}", rule.applies.join(", "))?;
    }
    match example(&rule.code).filter(|_| rule.origin.is_none()) {
        Some(example) => writeln!(out, "\nExample\n  {}", example.replace('\n', "\n  "))?,
        None => writeln!(out, "\nMessage\n  {}", rule.message.prose())?,
    }
    if let Some(harm) = rule.harm {
        writeln!(out, "\nHarm\n  {}", harm.name())?;
    }
    if !rule.effects.is_empty() {
        writeln!(
            out,
            "\nEffects\n  {}",
            effects(rule, width.map(|width| width.saturating_sub(2))).trim_end().replace('\n', "\n  ")
        )?;
    }
    for fix in &rule.fixes {
        writeln!(out, "\nFix ({})", safety(fix.safety))?;
        for text in texts(fix) {
            writeln!(out, "  {text}")?;
        }
    }
    if let Some(origin) = &rule.origin {
        writeln!(out, "\nDefined in\n  {origin}")?;
    }
    if !rule.references.is_empty() {
        writeln!(out, "\nReferences\n  {}", rule.references.join("\n  "))?;
    }
    Ok(out)
}

/// The effects of a rule, with a column for each known loader.
fn effects(rule: &Rule, width: Option<usize>) -> String {
    let header = ["object"].into_iter().chain(Loader::ALL.map(Loader::version)).chain(["what happens"]);
    let mut rows: Vec<Vec<String>> = vec![header.map(str::to_owned).collect()];
    for effect in &rule.effects {
        let under = |loader: Loader| {
            if effect.is_under(loader.version()) { effect.consequence.name() } else { "-" }
        };
        let object = effect.object.map_or("by file", Object::name);
        let row = [object].into_iter().chain(Loader::ALL.map(under)).map(str::to_owned);
        rows.push(row.chain([effect.prose()]).collect());
    }
    table(rows, width)
}

fn texts(fix: &Fix) -> impl Iterator<Item = String> {
    [&fix.title, &fix.help].into_iter().flatten().map(Template::prose)
}

const fn safety(safety: Safety) -> &'static str {
    match safety {
        Safety::Safe => "safe, applied by --fix",
        Safety::Unsafe => "unsafe, applied by --fix --unsafe-fixes",
        Safety::Manual => "manual",
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use crate::knowledge::Knowledge;

    #[test]
    fn pages_fit_the_terminal() {
        let knowledge = Knowledge::embedded().unwrap();
        let rules = &knowledge.rules;
        for (width, rule) in [60, 80, 120].into_iter().flat_map(|width| rules.all().map(move |rule| (width, rule))) {
            let text = fit(&page(rule, Some(width)).unwrap(), Some(width));
            let is_long = |line: &&str| line.chars().count() > width && line.trim_start().contains(' ');
            let long: Vec<&str> = text.lines().filter(is_long).collect();
            assert!(long.is_empty(), "{} at {width}: {long:#?}", rule.code);
        }
        let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        let list = family(rules, "CFG", Some(70)).unwrap();
        assert!(list.lines().all(|line| line.chars().count() <= 70), "{list}");
        assert_eq!(words(&fit("  a b c d e f", Some(7))), words("a b c d e f"));
        assert_eq!(fit("  a b c d e f\n\ng", Some(7)), "  a b\n  c d\n  e f\n\ng\n");
    }
}
