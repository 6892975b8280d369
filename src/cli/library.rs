//! The built-in rules, architectures, processors and recipes, and those of `--rules`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::checkpoint::list::list;
use crate::checkpoint::open::{MODULE_CAP, read_capped};
use crate::checkpoint::platform::shown;
use crate::knowledge::rule::RuleSet;
use crate::knowledge::{Knowledge, Library};
use crate::merge::{processor_of, read_recipe};

/// Maximum depth of folders in a directory of rules.
const MAX_DEPTH: usize = 8;
/// Maximum number of files in a directory of rules; some 200 are built in.
const MAX_FILES: usize = 4_000;
/// Maximum number of bytes of the files in a directory of rules.
const MAX_BYTES: usize = 32 << 20;

/// The built-in library with the files of `rules/architectures`, which override built-in ones.
pub fn with(rules: Option<&Path>) -> anyhow::Result<Library> {
    let mut library = Library::embedded();
    for (name, text) in texts(rules, "architectures")? {
        library.add(&name, &text)?;
    }
    Ok(library)
}

/// The built-in rules and those in `rules/checks`.
pub fn rules(rules: Option<&Path>) -> anyhow::Result<RuleSet> {
    let texts = texts(rules, "checks")?;
    Ok(RuleSet::embedded()?.and_files(texts.iter().map(|(name, text)| (name.clone(), text.as_str())))?)
}

/// These rules with the built-in architectures, processors and recipes, and those in `rules`, which override built-in ones
/// of the same name.
pub fn knowledge(set: RuleSet, rules: Option<&Path>) -> anyhow::Result<Knowledge> {
    let mut knowledge = Knowledge::with(set, with(rules)?);
    for (name, text) in texts(rules, "processors")? {
        let processor = processor_of(&name, &text, &knowledge)?;
        knowledge.processors.retain(|other| other.processor != processor.processor);
        knowledge.processors.insert(0, processor);
    }
    for file in files(rules, "recipes")? {
        let recipe = read_recipe(&file, &knowledge)?;
        knowledge.recipes.retain(|other| other.recipe != recipe.recipe);
        knowledge.recipes.push(recipe);
        knowledge.recipes.sort_by(|a, b| a.recipe.cmp(&b.recipe));
    }
    Ok(knowledge)
}

/// The folders of `--rules` that are read, and the depth to which they are searched. The folders below `recipes` contain
/// the templates and processors of recipes.
const FOLDERS: [(&str, usize); 4] =
    [("architectures", MAX_DEPTH), ("checks", MAX_DEPTH), ("processors", 0), ("recipes", 0)];

/// The `.json5` files in a folder of `--rules`, sorted.
fn files(rules: Option<&Path>, folder: &str) -> anyhow::Result<Vec<PathBuf>> {
    let Some(rules) = rules else { return Ok(Vec::new()) };
    let mut files = Vec::new();
    for (part, depth) in FOLDERS {
        let below = rules.join(part);
        if below.is_dir() {
            find(&below, depth, &mut files)?;
        }
    }
    if files.is_empty() {
        let folders = FOLDERS.map(|(folder, _)| format!("{folder}/"));
        bail!("{} contains no .json5 file in {}", rules.display(), folders.join(", "));
    }
    files.retain(|file| file.starts_with(rules.join(folder)));
    files.sort();
    if files.len() > MAX_FILES {
        bail!("{} contains {} files; at most {MAX_FILES} are read", rules.display(), files.len());
    }
    Ok(files)
}

/// Name and text of the `.json5` files in a folder of `--rules`.
fn texts(rules: Option<&Path>, folder: &str) -> anyhow::Result<Vec<(String, String)>> {
    let files = files(rules, folder)?;
    let mut bytes = 0_usize;
    let read = |file: PathBuf| {
        let text = String::from_utf8(read_capped(&file, MODULE_CAP)?);
        bytes = bytes.saturating_add(text.as_ref().map_or(0, String::len));
        if bytes > MAX_BYTES {
            bail!("the files in {folder} of --rules have more than {MAX_BYTES} bytes");
        }
        let name = shown(&file);
        Ok((name.clone(), text.with_context(|| format!("{name}: not UTF-8"))?))
    };
    files.into_iter().map(read).collect()
}

fn find(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) -> anyhow::Result<()> {
    let entries = list(folder).with_context(|| format!("{} cannot be listed", folder.display()))?;
    for entry in entries {
        let entry = entry?;
        let path = folder.join(&entry.name);
        // Links to folders are skipped: they may form a loop.
        if entry.is_folder {
            if let Some(depth) = depth.checked_sub(1) {
                find(&path, depth, files)?;
            }
        } else if path.extension().is_some_and(|e| e == "json5") {
            files.push(path);
        }
    }
    Ok(())
}
