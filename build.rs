//! Writes the index of the embedded architecture files, the other data files as JSON and the conditions of the rules, and
//! rebuilds the program when a file in `rules/` changes: the program embeds this directory.

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
    let mut files = BTreeMap::new();
    convert(Path::new("rules"), &mut files)?;
    let mut lines = String::new();
    let mut rules = BTreeMap::new();
    for (path, value) in files {
        lines.extend([&path, "\t", &value.to_string(), "\n"]);
        if path.starts_with("rules/checks/") {
            let head = ["code", "name", "applies", "when", "check"];
            let head = head.into_iter().filter_map(|key| Some((key.to_owned(), value.get(key)?.clone())));
            let head: Map<String, Value> = head.chain([("path".to_owned(), path.into())]).collect();
            rules.insert(value["code"].as_str().unwrap_or_default().to_owned(), Value::Object(head));
        }
    }
    fs::write(out.join("rules.json"), Value::Array(rules.into_values().collect()).to_string())?;
    fs::write(out.join("data.txt"), lines)
}

/// Reads the JSON5 files below a folder as JSON, by their paths; not those of architectures.
fn convert(folder: &Path, files: &mut BTreeMap<String, Value>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() && !path.ends_with("architectures") {
            convert(&path, files)?;
        } else if path.extension().is_some_and(|extension| extension == "json5") {
            let wrong = |error| io::Error::other(format!("{}: {error}", path.display()));
            let value: Value = json5::from_str(&fs::read_to_string(&path)?).map_err(wrong)?;
            files.insert(path.to_string_lossy().replace('\\', "/"), value);
        }
    }
    Ok(())
}
