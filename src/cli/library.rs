//! The architectures of the program, and those of `--rules`.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use ckpt_doctor::checkpoint::open::{MODULE_CAP, read_capped};
use ckpt_doctor::knowledge::Library;

/// The library inside the program with the files of `rules/architectures` over it.
pub fn with(rules: Option<&Path>) -> anyhow::Result<Library> {
    let mut library = Library::embedded();
    let Some(rules) = rules else { return Ok(library) };
    let folder = rules.join("architectures");
    let entries = fs::read_dir(&folder).with_context(|| format!("{} cannot be listed", folder.display()))?;
    let mut files: Vec<PathBuf> = entries.collect::<Result<Vec<_>, _>>()?.into_iter().map(|e| e.path()).collect();
    files.retain(|f| f.extension().is_some_and(|e| e == "json5"));
    if files.is_empty() {
        bail!("{} has no *.json5", folder.display());
    }
    files.sort();
    for file in files {
        let text = String::from_utf8(read_capped(&file, MODULE_CAP)?);
        let text = text.with_context(|| format!("{}: not UTF-8", file.display()))?;
        library.add(&file.display().to_string(), &text)?;
    }
    Ok(library)
}
