//! `--for @FILE` and `--for-python`: the versions of an environment in place of versions by name.

use std::path::Path;

use anyhow::bail;

use crate::knowledge::loader::Requirements;
use crate::knowledge::pins::read_pins;

/// A parser of a value of `--for`: `@FILE` stays as it is, and `parse` reads anything else. Called by the arguments, which
/// read no file.
pub fn or_file(
    parse: impl Fn(&str) -> Result<String, String> + Clone + Send + Sync + 'static,
) -> impl Fn(&str) -> Result<String, String> + Clone + Send + Sync + 'static {
    move |text| match text.strip_prefix('@') {
        Some("") => Err("expected the path of a file behind @".to_owned()),
        Some(_) => Ok(text.to_owned()),
        None => parse(text),
    }
}

/// The values of `--for` for a check, with what files pin in place of their names.
///
/// # Errors
/// Those of [`read_pins`].
pub fn programs(values: &[String]) -> anyhow::Result<Vec<String>> {
    replaced(values, |pins| pins.texts())
}

/// The values of `--for` for a command that knows versions of transformers alone.
///
/// # Errors
/// Those of [`read_pins`].
pub fn transformers(values: &[String]) -> anyhow::Result<Vec<String>> {
    replaced(values, |pins| pins.transformers)
}

/// The value of `--for` for a command that takes one version of transformers.
///
/// # Errors
/// Those of [`read_pins`], and a file that pins several versions.
pub fn one_transformers(value: &str) -> anyhow::Result<String> {
    let versions = transformers(&[value.to_owned()])?;
    match versions.as_slice() {
        [version] => Ok(version.clone()),
        _ => bail!(
            "{}: pins transformers {}, and this command takes one version: name it with --for",
            value.trim_start_matches('@'),
            versions.join(" and ")
        ),
    }
}

fn replaced(values: &[String], kept: impl Fn(Requirements) -> Vec<String>) -> anyhow::Result<Vec<String>> {
    let mut all = Vec::new();
    for value in values {
        match value.strip_prefix('@') {
            Some(file) => all.extend(kept(read_pins(Path::new(file))?)),
            None => all.push(value.clone()),
        }
    }
    Ok(all)
}
