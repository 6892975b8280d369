//! The built-in rules and architectures, and those of `--rules`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::checkpoint::list::list;
use crate::checkpoint::open::{MODULE_CAP, read_capped};
use crate::knowledge::Library;
use crate::knowledge::rule::RuleSet;

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

/// Name and text of the `.json5` files in a folder of `--rules`.
fn texts(rules: Option<&Path>, folder: &str) -> anyhow::Result<Vec<(String, String)>> {
    let Some(rules) = rules else { return Ok(Vec::new()) };
    let mut files = Vec::new();
    for part in ["architectures", "checks"] {
        let below = rules.join(part);
        if below.is_dir() {
            find(&below, MAX_DEPTH, &mut files)?;
        }
    }
    if files.is_empty() {
        bail!("{} contains neither architectures/*.json5 nor checks/**/*.json5", rules.display());
    }
    files.retain(|file| file.starts_with(rules.join(folder)));
    files.sort();
    if files.len() > MAX_FILES {
        bail!("{} contains {} files; at most {MAX_FILES} are read", rules.display(), files.len());
    }
    let mut bytes = 0_usize;
    let read = |file: PathBuf| {
        let text = String::from_utf8(read_capped(&file, MODULE_CAP)?);
        bytes = bytes.saturating_add(text.as_ref().map_or(0, String::len));
        if bytes > MAX_BYTES {
            bail!("the files in {} have more than {MAX_BYTES} bytes", rules.display());
        }
        let name = file.display().to_string();
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
