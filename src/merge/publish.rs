//! Checks a finished plan for what no result may contain, whichever entry of the recipe brought it.

use std::collections::BTreeSet;

use serde_json::Value;

use super::draft::MergeDraft;
use super::error::MergeError;
use crate::check::modules::local_class;
use crate::checkpoint::{FaultKind, PythonModule, line_column};
use crate::knowledge::recipe::{AUTO_MAP, Recipe};

/// Fails unless every Python module parses, and `auto_map` names only modules of the plan.
///
/// [`super::run`] calls it after the rules have found no error in the planned checkpoint: they grade code of another
/// repository, and modules that no loader imports, as information.
pub(super) fn check(recipe: &Recipe, draft: &MergeDraft) -> Result<(), MergeError> {
    let mut modules = BTreeSet::new();
    for file in &draft.plan.files {
        if let Some(module) = file.name.strip_suffix(".py") {
            parses(&file.name, &file.origin, &file.bytes)?;
            modules.insert(module);
        }
    }
    for document in &draft.documents {
        let Some(map) = document.get("/auto_map") else { continue };
        let place = format!("{}: {}/{AUTO_MAP}", recipe.recipe, document.name);
        let Some(entries) = map.as_object() else {
            return Err(MergeError::Recipe(format!("{place} is not an object; set it to class names by key")));
        };
        for (key, entry) in entries {
            for target in targets(entry) {
                if !target.as_str().and_then(local_class).is_some_and(|(module, _)| modules.contains(module)) {
                    return Err(MergeError::Recipe(format!(
                        "{place}/{key} is {target}, which names no class of a module that the merge writes; set it to \"module.Class\", or remove it"
                    )));
                }
            }
        }
    }
    Ok(())
}

/// The class names of an entry: one, or a list with null for a class that does not exist, as for `AutoTokenizer`.
fn targets(entry: &Value) -> Vec<&Value> {
    match entry {
        Value::Array(items) => items.iter().filter(|item| !item.is_null()).collect(),
        one => vec![one],
    }
}

fn parses(name: &str, origin: &str, bytes: &[u8]) -> Result<(), MergeError> {
    let module = PythonModule::parse(name, bytes);
    let Some(fault) = module.faults.first() else { return Ok(()) };
    let start = fault.places.first().and_then(|place| place.span.as_ref()).map(|span| span.start);
    let at = match (start, module.text.as_deref()) {
        (Some(start), Some(text)) => {
            let (line, column) = line_column(text, start);
            format!(":{line}:{column}")
        }
        _ => String::new(),
    };
    let cause = match fault.kind {
        FaultKind::PythonSyntax => "is not valid Python",
        FaultKind::PythonTooComplex => "is too large to be parsed as Python",
        _ => "cannot be read as Python",
    };
    Err(MergeError::Donor(format!(
        "{name}{at} {cause} ({origin}), so the result could not be imported; correct the module or the option that fills it"
    )))
}
