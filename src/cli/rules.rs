//! `rules` and `explain`.

use std::fmt::Write;

use std::path::Path;

use ckpt_doctor::knowledge::rule::Rule;
use comfy_table::{Table, presets};

use super::args::{ExplainArgs, SettingsArgs};
use super::exit::CLEAN;
use super::output;
use super::settings::{SettingsResolver, Typed};

/// Runs `rules`: a line for each that is asked here.
pub fn list(args: &SettingsArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let here = SettingsResolver::new(Typed::new(args, rules)).resolve(Path::new("."))?;
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    for rule in &here.knowledge.rules.rules {
        table.add_row([rule.code.as_str(), rule.severity.name(), rule.name.as_str()]);
    }
    let lines: Vec<String> = table.lines().map(|line| line.trim().to_owned()).collect();
    output::print(&format!("{}\n", lines.join("\n")))?;
    Ok(CLEAN)
}

/// Runs `explain`: all there is to say of one rule.
pub fn explain(args: &ExplainArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let here = SettingsResolver::new(Typed::new(&args.settings, rules)).resolve(Path::new("."))?;
    output::print(&page(here.knowledge.rules.find(&args.rule)?)?)?;
    Ok(CLEAN)
}

fn page(rule: &Rule) -> Result<String, std::fmt::Error> {
    let mut out = String::new();
    writeln!(out, "{} {} ({})\n", rule.code, rule.name, rule.severity.name())?;
    writeln!(out, "What it finds\n  {}\n", rule.summary)?;
    writeln!(out, "Why it matters\n  {}", rule.why)?;
    if !rule.applies.is_empty() {
        writeln!(out, "\nApplies to\n  {}", rule.applies.join(", "))?;
    }
    writeln!(out, "\nMessage\n  {}", rule.message.source())?;
    for fix in &rule.fixes {
        writeln!(out, "\nFix ({})\n  {}", fix.safety.name(), fix.help.source())?;
    }
    if let Some(origin) = &rule.origin {
        writeln!(out, "\nFrom\n  {origin}")?;
    }
    if !rule.references.is_empty() {
        writeln!(out, "\nReferences\n  {}", rule.references.join("\n  "))?;
    }
    Ok(out)
}
