//! `recipes`, and the pages of recipes.

use std::path::Path;

use super::args::{ListFormat, RecipesArgs};
use super::exit::CLEAN;
use super::{library, output};
use crate::knowledge::rule::RuleSet;
use crate::report::recipes as report;

/// Runs `recipes`: lists the recipes with what each donor has to be.
pub fn list(args: &RecipesArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let knowledge = library::knowledge(RuleSet::embedded()?, rules)?;
    output::print(&match args.output_format {
        ListFormat::Text => report::list(&knowledge.recipes),
        ListFormat::Json => report::json(&knowledge.recipes),
    })?;
    Ok(CLEAN)
}
