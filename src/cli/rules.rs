//! `rules` and `explain`.

use std::fmt::{self, Write};
use std::path::Path;

use anyhow::bail;
use comfy_table::{Table, presets};

use super::args::{ExplainArgs, SettingsArgs};
use super::exit::CLEAN;
use super::output;
use super::settings::{Typed, resolve};
use crate::knowledge::problems::{reported_problems, search};
use crate::knowledge::rule::{Fix, Object, Rule, RuleSet, Safety, example};
use crate::knowledge::settings::Surroundings;
use crate::knowledge::{Loader, Template};
use crate::report::recipes;

/// Runs `rules`: lists the selected rules.
pub fn list(args: &SettingsArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let here = resolve(&Typed::new(args, rules), &Surroundings::new([]))?;
    let rows = here.knowledge.rules.rules.iter().map(|rule| [&rule.code, rule.highest_severity().name(), &rule.name]);
    output::print(&table(rows))?;
    Ok(CLEAN)
}

/// Runs `explain`: prints the page of a rule or a recipe, or the list of a family.
pub fn explain(args: &ExplainArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let here = resolve(&Typed::new(&args.settings, rules), &Surroundings::new([]))?;
    let rules = &here.knowledge.rules;
    let words = args.words.join(" ");
    let recipe = here.knowledge.recipes.iter().find(|recipe| recipe.recipe == words);
    let text = match (recipe, family(rules, &words)) {
        (Some(recipe), _) => recipes::page(recipe),
        (None, Some(list)) => list,
        (None, None) if words.trim().contains(char::is_whitespace) => error_page(rules, &words)?,
        (None, None) => page(rules.find(&words)?)?,
    };
    output::print(&text)?;
    Ok(CLEAN)
}

fn table<'r, const N: usize>(rows: impl Iterator<Item = [&'r str; N]>) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.add_rows(rows);
    table.lines().fold(String::new(), |text, line| text + line.trim() + "\n")
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
fn family(rules: &RuleSet, word: &str) -> Option<String> {
    let word = word.to_ascii_uppercase();
    let is_member = |rule: &&Rule| rule.code.trim_end_matches(|c: char| c.is_ascii_digit()) == word;
    let members: Vec<&Rule> = rules.all().filter(is_member).collect();
    let title = rules.catalogue.families.iter().find(|(family, _)| *family == word);
    let title = title.map(|(_, title)| format!(": {title}")).unwrap_or_default();
    let rows = members
        .iter()
        .map(|rule| [&rule.code, rule.highest_severity().name(), &rule.name, &rule.summary].map(AsRef::as_ref));
    (!members.is_empty()).then(|| format!("{word}{title}\n\n{}", table(rows)))
}

fn page(rule: &Rule) -> Result<String, fmt::Error> {
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
        writeln!(out, "\nEffects\n  {}", effects(rule).trim_end().replace('\n', "\n  "))?;
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
fn effects(rule: &Rule) -> String {
    let header = ["object"].into_iter().chain(Loader::ALL.map(Loader::version)).chain(["what happens"]);
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.add_row(header);
    for effect in &rule.effects {
        let under = |loader: Loader| {
            if effect.is_under(loader.version()) { effect.consequence.name() } else { "-" }
        };
        let happens = effect.prose();
        let object = effect.object.map_or("by file", Object::name);
        table.add_row([object].into_iter().chain(Loader::ALL.map(under)).chain([happens.as_str()]));
    }
    table.lines().fold(String::new(), |text, line| text + line.trim() + "\n")
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
