//! `rules` and `explain`.

use std::fmt::Write;

use ckpt_doctor::knowledge::rule::{Rule, RuleSet};
use comfy_table::{Table, presets};

use super::args::ExplainArgs;
use super::{CLEAN, output};

/// Runs `rules`: a line for each.
pub fn list() -> anyhow::Result<u8> {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    for rule in &RuleSet::embedded()?.rules {
        table.add_row([rule.code.as_str(), rule.severity.name(), rule.name.as_str()]);
    }
    let lines: Vec<String> = table.lines().map(|line| line.trim().to_owned()).collect();
    output::print(&format!("{}\n", lines.join("\n")))?;
    Ok(CLEAN)
}

/// Runs `explain`: all there is to say of one rule.
pub fn explain(args: &ExplainArgs) -> anyhow::Result<u8> {
    let rules = RuleSet::embedded()?;
    output::print(&page(rules.find(&args.rule)?)?)?;
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
    if let Some(fix) = &rule.fix {
        writeln!(out, "\nFix ({})\n  {}", fix.safety.name(), fix.help.source())?;
    }
    if !rule.references.is_empty() {
        writeln!(out, "\nReferences\n  {}", rule.references.join("\n  "))?;
    }
    Ok(out)
}
