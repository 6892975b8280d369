//! Writes the index of the embedded architecture files, and rebuilds the program when a file in `rules/` changes: the
//! program embeds this directory.

#![allow(
    clippy::print_stdout,
    clippy::disallowed_methods,
    reason = "how a build script reads, writes and talks to cargo"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::{env, fs, io};

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
    fs::write(Path::new(&env::var_os("OUT_DIR").unwrap_or_default()).join("architectures.index"), text)
}
