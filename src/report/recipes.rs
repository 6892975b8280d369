//! Renders recipes: the list of `recipes`, and the page of `explain RECIPE` and `build-merged --recipe NAME --help`.

use std::fmt::Write as _;

use serde::Serialize;

use super::json::pretty;
use super::model::ToolInfo;
use crate::knowledge::recipe::{ANY, DonorSpec, FileSpec, OptionKind, OptionSpec, Recipe};

#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct RecipesDocument<'a> {
    /// Version of this contract: 1.
    schema: u32,
    tool: ToolInfo,
    /// The recipes, by name.
    recipes: Vec<RecipeSummary<'a>>,
}

/// A recipe.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct RecipeSummary<'a> {
    /// Name on the command line.
    name: &'a str,
    /// The result, as one line.
    summary: &'a str,
    /// File that defines the recipe; `rules/recipes/…` for a built-in one.
    file: &'a str,
    /// Roles of the donors.
    donors: Vec<DonorSummary<'a>>,
    /// Options.
    options: Vec<OptionSummary<'a>>,
}

/// A donor role.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct DonorSummary<'a> {
    /// Name of the role on the command line.
    role: &'a str,
    /// Description of the donor.
    what: &'a str,
    /// Architectures that the donor may have; `*` for any. Without these and `parts`, a directory that only provides files.
    architectures: &'a [String],
    /// Parts that the donor's model must have, such as `language`.
    parts: &'a [String],
    /// Whether the donor may be left out.
    optional: bool,
}

/// An option of a recipe.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct OptionSummary<'a> {
    /// Name on the command line.
    name: &'a str,
    /// `choice`, `size`, `integer` or `text`.
    kind: &'a str,
    /// Allowed values of a choice.
    values: &'a [String],
    /// Default value.
    default: &'a str,
    /// Effect.
    help: &'a str,
}

impl<'a> RecipeSummary<'a> {
    fn new(recipe: &'a Recipe) -> Self {
        Self {
            name: &recipe.recipe,
            summary: &recipe.summary,
            file: &recipe.origin.path,
            donors: recipe.donors.iter().map(DonorSummary::new).collect(),
            options: recipe.options.iter().map(OptionSummary::new).collect(),
        }
    }
}

impl<'a> DonorSummary<'a> {
    fn new(DonorSpec { role, what, architectures, parts, optional, .. }: &'a DonorSpec) -> Self {
        Self { role, what, architectures, parts, optional: *optional }
    }
}

impl<'a> OptionSummary<'a> {
    fn new(spec: &'a OptionSpec) -> Self {
        let OptionSpec { name, values, default, help, .. } = spec;
        Self { name, kind: spec.kind().name(), values, default, help }
    }
}

/// All recipes as JSON (`schema` 1).
#[must_use]
pub fn json(recipes: &[Recipe]) -> String {
    pretty(&RecipesDocument {
        schema: 1,
        tool: ToolInfo::this(),
        recipes: recipes.iter().map(RecipeSummary::new).collect(),
    })
}

/// Name, summary and donors of each recipe, for a terminal.
#[must_use]
pub fn list(recipes: &[Recipe]) -> String {
    let mut out = String::new();
    for recipe in recipes {
        let _ok = writeln!(out, "{}: {}", recipe.recipe, recipe.summary);
        donors(&mut out, recipe);
        out.push('\n');
    }
    out.push_str("`ckpt-doctor explain RECIPE` prints the options of a recipe.\n");
    out
}

/// The page of one recipe.
#[must_use]
pub fn page(recipe: &Recipe) -> String {
    let mut out = format!("{}\n\nResult\n  {}\n\nDonors\n", recipe.recipe, recipe.summary);
    donors(&mut out, recipe);
    if !recipe.options.is_empty() {
        out.push_str("\nOptions\n");
        for option in &recipe.options {
            let _ok = writeln!(out, "  --set {}={}\n      {}", option.name, values(option), option.help);
        }
    }
    out.push_str("\nFiles\n");
    for line in files(recipe) {
        let _ok = writeln!(out, "  {line}");
    }
    if !recipe.tolerates.is_empty() {
        let _ok = writeln!(out, "\nTolerated errors of the result\n  {}", recipe.tolerates.join(", "));
    }
    let _ok = writeln!(out, "\nExample\n  {}", example(recipe));
    let _ok = writeln!(
        out,
        "\nDefined in\n  {}; `ckpt-doctor build-merged --recipe {} --print-recipe` prints it",
        recipe.origin.path, recipe.recipe
    );
    out
}

/// Roles that have an option of their own on the command line.
const SHORT: [&str; 2] = ["vision", "language"];

/// The argument for a role: `--vision DIR`, `--donor code=DIR`.
fn argument(spec: &DonorSpec) -> String {
    if SHORT.contains(&spec.role.as_str()) {
        format!("--{} DIR", spec.role)
    } else {
        format!("--donor {}=DIR", spec.role)
    }
}

fn donors(out: &mut String, recipe: &Recipe) {
    for spec in &recipe.donors {
        let architectures = match spec.architectures.as_slice() {
            [] if !spec.parts.is_empty() => format!("any with a known {} part", spec.parts.join(" and ")),
            [] => "files only".to_owned(),
            [any] if any == ANY => "any architecture".to_owned(),
            names => names.join(" or "),
        };
        let optional = if spec.optional { ", optional" } else { "" };
        let _ok = writeln!(out, "  {}: {} ({architectures}{optional})", argument(spec), spec.what);
    }
}

/// `keep|pad|reinit (default keep)`.
fn values(option: &OptionSpec) -> String {
    let form = match option.kind() {
        OptionKind::Choice => {
            let value = |v: &String| if v.ends_with(':') { format!("{v}PACKAGE") } else { v.clone() };
            option.values.iter().map(value).collect::<Vec<_>>().join("|")
        }
        kind => kind.name().to_ascii_uppercase(),
    };
    format!("{form} (default {})", option.default)
}

/// One line for each document and file of the result.
fn files(recipe: &Recipe) -> Vec<String> {
    let mut lines = vec!["model*.safetensors: tensors of the donors, as the report lists them".to_owned()];
    let mut names: Vec<&str> = Vec::new();
    for document in &recipe.documents {
        if names.contains(&&*document.name) {
            continue;
        }
        names.push(&document.name);
        let from = document.from.as_ref().map_or_else(|| "generated".to_owned(), |role| format!("of {role}"));
        let edited = if document.edits.is_empty() || document.from.is_none() { "" } else { ", edited" };
        let optional = if document.optional || document.when.is_some() { ", if needed" } else { "" };
        lines.push(format!("{}: {from}{edited}{optional}", document.name));
    }
    for file in &recipe.files {
        lines.push(match file {
            FileSpec::Copy(copy) => {
                let names: Vec<String> = copy.names.iter().map(ToString::to_string).collect();
                format!("{}: of {}, if they exist", names.join(", "), copy.from)
            }
            FileSpec::Modules(modules) => {
                let names: Vec<String> = modules.roots.iter().map(|root| format!("{root}.py")).collect();
                format!("{} and what they import: of {}", names.join(", "), modules.from.join(" or "))
            }
            FileSpec::Template(template) => format!("{}: a file of the recipe", template.name),
            FileSpec::Text(text) => format!("{}: generated, if needed", text.name),
        });
    }
    lines
}

/// A command line that uses the recipe, with an option that is not at its default.
fn example(recipe: &Recipe) -> String {
    let mut words = vec!["ckpt-doctor build-merged --recipe".to_owned(), recipe.recipe.clone()];
    words.extend(recipe.donors.iter().filter(|spec| !spec.optional).map(argument));
    words.push("--out OUT".to_owned());
    let other = |option: &OptionSpec| {
        let value = option.values.iter().find(|v| **v != option.default && !v.ends_with(':'))?;
        Some(format!("--set {}={value}", option.name))
    };
    words.extend(recipe.options.iter().find_map(other));
    words.join(" ")
}
