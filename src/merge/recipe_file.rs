//! Recipe files: a recipe with the templates and the processor in its folder.

use std::path::{Component, Path};

use super::validate::{validate, validate_processor};
use crate::checkpoint::open::{JSON_CAP, read_capped};
use crate::knowledge::Knowledge;
use crate::knowledge::processor::Processor;
use crate::knowledge::recipe::{FileSpec, Recipe};
use crate::knowledge::source::DataError;

/// Reads and validates a recipe file, with the files in its folder that it names.
///
/// # Errors
/// [`DataError`] when a file cannot be read or parsed, or the recipe is not valid.
pub fn read(path: &Path, knowledge: &Knowledge) -> Result<Recipe, DataError> {
    let (name, text) = (path.display().to_string(), text(path)?);
    let mut recipe = Recipe::parse(&name, &text)?;
    let folder = Folder { path: path.parent().unwrap_or(Path::new("")), recipe: &name, text: &text };
    for file in &recipe.files {
        if let FileSpec::Template(template) = file
            && let Some((_, text)) = folder.file("text", &template.text)?
        {
            recipe.origin.templates.insert(template.text.clone(), text);
        }
    }
    let processor = recipe.tokens.as_ref().and_then(|tokens| tokens.processor.as_ref());
    if let Some(path) = processor.filter(|path| path.ends_with(".json5")) {
        let found = folder.file("processor", path)?;
        let processor = found.map(|(name, text)| processor_of(&name, &text, knowledge)).transpose()?;
        let missing = || folder.wrong("processor", path, "does not exist in the folder of the recipe");
        recipe.origin.processor = Some(processor.ok_or_else(missing)?);
    }
    validate(&recipe, &name, &text, knowledge)?;
    Ok(recipe)
}

/// Parses and validates the text of a processor; `name` is its path.
///
/// # Errors
/// [`DataError`] with the place.
pub fn processor_of(name: &str, text: &str, knowledge: &Knowledge) -> Result<Processor, DataError> {
    let processor = Processor::parse(name, text)?;
    validate_processor(&processor, name, text, knowledge)?;
    Ok(processor)
}

/// The folder of a recipe, with the recipe's path and text for the places of errors.
struct Folder<'r> {
    path: &'r Path,
    recipe: &'r str,
    text: &'r str,
}

impl Folder<'_> {
    fn wrong(&self, key: &str, word: &str, reason: &str) -> DataError {
        DataError::about_value(self.recipe, self.text, key, word, format!("`{word}` {reason}"))
    }

    /// Path and text of a file below the folder; `None` when it does not exist.
    ///
    /// Fails for a path that leads out of the folder, also through a symbolic link.
    fn file(&self, key: &str, word: &str) -> Result<Option<(String, String)>, DataError> {
        let outside = || self.wrong(key, word, "is not below the folder of the recipe");
        let mut steps = Path::new(word).components();
        if word.is_empty() || !steps.all(|step| matches!(step, Component::Normal(_) | Component::CurDir)) {
            return Err(outside());
        }
        let here = if self.path.as_os_str().is_empty() { Path::new(".") } else { self.path };
        let path = self.path.join(word);
        let (Ok(folder), Ok(file)) = (here.canonicalize(), path.canonicalize()) else { return Ok(None) };
        if !file.starts_with(folder) {
            return Err(outside());
        }
        Ok(Some((path.display().to_string(), text(&path)?)))
    }
}

/// The text of a recipe or merge file.
pub(super) fn text(path: &Path) -> Result<String, DataError> {
    let name = path.display().to_string();
    // Most of its messages begin with the path, which the error names already.
    let told = |error: String| error.strip_prefix(&format!("{name} ")).map_or_else(|| error.clone(), str::to_owned);
    let bytes = read_capped(path, JSON_CAP).map_err(|error| DataError::new(&name, told(error.to_string())))?;
    String::from_utf8(bytes).map_err(|_| DataError::new(&name, "not UTF-8"))
}
