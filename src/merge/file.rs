//! Merge files, and recipes by name or path.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use super::options;
use super::recipe_file::{self, text};
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::{MergeFile, Recipe};
use crate::knowledge::source::{self, DataError, hint, nearest};

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
    /// The file; `None` for values of the command line or of a caller of the library.
    origin: Option<Origin>,
}

/// A merge file with its text, for the places of errors.
#[derive(Debug, Clone)]
struct Origin {
    path: String,
    text: String,
    roles: Vec<String>,
    options: BTreeMap<String, String>,
}

impl ResolvedMergeFile {
    /// A merge into this directory, without donors.
    #[must_use]
    pub fn new(out: PathBuf) -> Self {
        Self { out, ..Self::default() }
    }

    /// Reads a merge file.
    ///
    /// # Errors
    /// [`DataError`] when the file cannot be read or parsed, or a donor is not a path.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let name = path.display().to_string();
        let text = text(path)?;
        let file: MergeFile = source::parse(&name, &text)?;
        let base = path.parent().unwrap_or(Path::new("")).to_owned();
        let donor = |(role, dir): (&String, &serde_json::Value)| {
            let not_a_path = || DataError::new(&name, format!("donor {role}: the value must be a path"));
            Ok((role.clone(), tidy(base.join(dir.as_str().ok_or_else(not_a_path)?))))
        };
        let donors: BTreeMap<String, PathBuf> = file.donors.iter().map(donor).collect::<Result<_, _>>()?;
        let option = |value: &serde_json::Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        let options: BTreeMap<String, String> =
            file.options.iter().map(|(name, value)| (name.clone(), option(value))).collect();
        let roles = donors.keys().cloned().collect();
        let origin = Some(Origin { path: name, text, roles, options: options.clone() });
        Ok(Self { recipe: file.recipe, donors, options, out: tidy(base.join(file.out)), base, origin })
    }

    /// The recipe that is named, by name or by path; `None` when the architectures of the donors choose one.
    ///
    /// # Errors
    /// [`DataError`] when no recipe has the name, or the file cannot be read, parsed or validated, and when the merge file
    /// gives a donor or an option that the recipe does not have.
    pub fn find_recipe(&self, knowledge: &Knowledge) -> Result<Option<Recipe>, DataError> {
        let Some(name) = &self.recipe else { return Ok(None) };
        let recipe = find_recipe(knowledge, name, &self.base)?;
        self.origin.as_ref().map_or(Ok(()), |origin| origin.validate(&recipe))?;
        Ok(Some(recipe))
    }
}

impl Origin {
    /// Fails unless the recipe has the roles and options of the file, and accepts their values.
    fn validate(&self, recipe: &Recipe) -> Result<(), DataError> {
        let wrong = |word: &str, reason: String| DataError::about(&self.path, &self.text, word, reason);
        let roles: Vec<&str> = recipe.donors.iter().map(|donor| donor.role.as_str()).collect();
        if let Some(role) = self.roles.iter().find(|role| !roles.contains(&role.as_str())) {
            let hint = hint(role, &roles);
            return Err(wrong(role, format!("recipe {} has no donor {role}; {hint}", recipe.recipe)));
        }
        for (name, value) in &self.options {
            let given = BTreeMap::from([(name.clone(), value.clone())]);
            options::resolve(recipe, &given).map_err(|error| wrong(name, error.to_string()))?;
        }
        Ok(())
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
fn find_recipe(knowledge: &Knowledge, name: &str, base: &Path) -> Result<Recipe, DataError> {
    if let Some(recipe) = knowledge.recipes.iter().find(|r| r.recipe == name) {
        return Ok(recipe.clone());
    }
    let path = base.join(name);
    if path.extension().is_some_and(|e| e == "json5" || e == "json") {
        return recipe_file::read(&path, knowledge);
    }
    let names: Vec<&str> = knowledge.recipes.iter().map(|r| r.recipe.as_str()).collect();
    let hint = match nearest(name, names.iter().copied()) {
        Some(near) => format!("did you mean `{near}`?"),
        None => format!("pass one of {}, or the path of a .json5 file", names.join(", ")),
    };
    Err(DataError::new(name, format!("unknown recipe; {hint}")))
}
