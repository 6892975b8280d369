//! Merge files, and recipes by name or path.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use crate::checkpoint::open::{JSON_CAP, read_capped};
use crate::knowledge::recipe::{MergeFile, Recipe};
use crate::knowledge::source::{self, DataError};

/// A merge file with its paths resolved against its folder.
#[derive(Debug, Clone, Default)]
pub struct ResolvedMergeFile {
    /// Name or path of the recipe.
    pub recipe: Option<String>,
    /// Folder that the path of the recipe is relative to.
    pub base: PathBuf,
    /// Directory of each donor, by role.
    pub donors: BTreeMap<String, PathBuf>,
    /// Options.
    pub options: BTreeMap<String, String>,
    /// Directory of the result.
    pub out: PathBuf,
}

impl ResolvedMergeFile {
    /// Reads a merge file.
    ///
    /// # Errors
    /// [`DataError`] when the file cannot be read or parsed, or a donor is not a path.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let name = path.display().to_string();
        let file: MergeFile = source::parse(&name, &text(path)?)?;
        let base = path.parent().unwrap_or(Path::new("")).to_owned();
        let donor = |(role, dir): (&String, &serde_json::Value)| {
            let not_a_path = || DataError::new(&name, format!("donor {role}: the value must be a path"));
            Ok((role.clone(), tidy(base.join(dir.as_str().ok_or_else(not_a_path)?))))
        };
        let donors = file.donors.iter().map(donor).collect::<Result<_, _>>()?;
        let option = |value: &serde_json::Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        let options = file.options.iter().map(|(name, value)| (name.clone(), option(value))).collect();
        Ok(Self { recipe: file.recipe, donors, options, out: tidy(base.join(file.out)), base })
    }
}

/// `fixtures/../merged` as `merged`, unless a symbolic link makes the two different places.
fn tidy(path: PathBuf) -> PathBuf {
    let mut short = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir if matches!(short.components().next_back(), Some(Component::Normal(_))) => {
                short.pop();
            }
            Component::CurDir => {}
            other => short.push(other),
        }
    }
    // The last component may be missing: it is the output directory.
    let parent = |path: &Path| {
        let parent = path.parent()?;
        if parent.as_os_str().is_empty() { Path::new(".") } else { parent }.canonicalize().ok()
    };
    match (parent(&path), parent(&short)) {
        (Some(long), Some(other)) if long == other && path.file_name() == short.file_name() => short,
        _ => path,
    }
}

/// A recipe by name, or from a file; a path is relative to `base`.
///
/// # Errors
/// [`DataError`] when no recipe has the name, or the file cannot be read or parsed.
pub fn find_recipe(recipes: &[Recipe], name: &str, base: &Path) -> Result<Recipe, DataError> {
    if let Some(recipe) = recipes.iter().find(|r| r.recipe == name) {
        return Ok(recipe.clone());
    }
    let path = base.join(name);
    if path.extension().is_some_and(|e| e == "json5" || e == "json") {
        return Recipe::parse(&path.display().to_string(), &text(&path)?);
    }
    let names: Vec<&str> = recipes.iter().map(|r| r.recipe.as_str()).collect();
    let names = names.join(", ");
    Err(DataError::new(name, format!("unknown recipe; pass one of {names}, or the path of a .json5 file")))
}

fn text(path: &Path) -> Result<String, DataError> {
    let name = path.display().to_string();
    let bytes = read_capped(path, JSON_CAP).map_err(|error| DataError::new(&name, error.to_string()))?;
    String::from_utf8(bytes).map_err(|_| DataError::new(&name, "not UTF-8"))
}
