//! Writes what the program embeds: the data files of `rules/` as JSON, the index of the architecture files, and the
//! conditions of the rules.

#![allow(
    clippy::print_stdout,
    clippy::disallowed_methods,
    reason = "how a build script reads, writes and talks to cargo"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::{env, fs, io};

use serde_json::{Map, Value};

mod library {
    pub mod scan {
        include!("src/knowledge/library/scan.rs");
    }

    /// The lines of the index for a file: `c NAME` for a class, `m NAME` for a model type.
    pub fn keys(text: &str) -> impl Iterator<Item = String> {
        let classes = scan::classes(text).map(|name| format!("c {name}"));
        classes.chain(scan::model_types(text).map(|name| format!("m {name}")))
    }
}

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed=rules");
    println!("cargo::rerun-if-changed=src/knowledge/library/scan.rs");
    let mut index: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for entry in fs::read_dir("rules/architectures")? {
        let path = entry?.path();
        let Some(stem) = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()) else { continue };
        if path.extension().is_some_and(|extension| extension == "json5") {
            for key in library::keys(&fs::read_to_string(&path)?) {
                index.entry(key).or_default().insert(stem.clone());
            }
        }
    }
    let line = |(key, stems): (&String, &BTreeSet<String>)| {
        let stems: Vec<&str> = stems.iter().map(String::as_str).collect();
        format!("{key}\t{}\n", stems.join("\t"))
    };
    let text: String = index.iter().map(line).collect();
    let out = PathBuf::from(env::var_os("OUT_DIR").unwrap_or_default());
    fs::write(out.join("architectures.index"), text)?;
    let mut heads = BTreeMap::new();
    let data = out.join("rules");
    if data.exists() {
        fs::remove_dir_all(&data)?;
    }
    convert(Path::new("rules"), &data, &mut heads)?;
    fs::write(out.join("rules.json"), Value::Array(heads.into_values().collect()).to_string())
}

/// Copies a folder of data files, with JSON5 files as JSON, which is faster to parse; those of recipes stay as they are,
/// since the manifest of a merge has their digests. `heads` gets the conditions of the rules by their codes.
fn convert(folder: &Path, to: &Path, heads: &mut BTreeMap<String, Value>) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let copy = to.join(path.file_name().unwrap_or_default());
        if path.is_dir() {
            convert(&path, &copy, heads)?;
        } else if path.extension().is_some_and(|extension| extension == "json5") && !folder.starts_with("rules/recipes")
        {
            let wrong = |error| io::Error::other(format!("{}: {error}", path.display()));
            let value: Value = json5::from_str(&fs::read_to_string(&path)?).map_err(wrong)?;
            fs::write(copy, value.to_string())?;
            if path.starts_with("rules/checks") {
                let head = ["code", "name", "applies", "when", "let", "check"];
                let head = head.into_iter().filter_map(|key| Some((key.to_owned(), value.get(key)?.clone())));
                let path = path.to_string_lossy().replace('\\', "/");
                let derived = [("path", path.as_str()), ("affects", affected(&value))];
                let derived = derived.map(|(key, text)| (key.to_owned(), text.into()));
                let head: Map<String, Value> = head.chain(derived).collect();
                let code = value.get("code").and_then(Value::as_str).unwrap_or_default().to_owned();
                heads.insert(code, Value::Object(head));
            }
        } else if path.extension().is_none_or(|extension| extension != "md") {
            fs::copy(&path, copy)?;
        }
    }
    Ok(())
}

/// What `Affected::by` of `src/knowledge/rule/effect.rs` returns for a rule; a test compares the two.
fn affected(rule: &Value) -> &'static str {
    let effects = rule.get("effects").and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
    match effects {
        [] => "nothing",
        _ if effects.iter().all(|effect| effect.get("program").is_some()) => "programs",
        _ => "transformers",
    }
}
