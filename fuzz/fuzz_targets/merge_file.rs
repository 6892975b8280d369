//! Merge files: read from a folder with two donors and a recipe, and planned. Nothing is written: the target may be any path.

#![no_main]

mod merging;

use std::fs;

use ckpt_doctor::merge::{MergeRequest, ResolvedMergeFile};
use libfuzzer_sys::fuzz_target;
use merging::{KNOWLEDGE, PLACE, hold};

const RECIPE: &str = r#"{
  recipe: "r", summary: "s", donors: [{ role: "a", what: "w", architectures: ["llama"] }],
  options: [{ name: "o", values: ["x", "y:"], default: "x", help: "h" }, { name: "shard-size", default: "1MB", help: "h" }],
  documents: [{ name: "config.json", from: "a" }], tensors: [{ from: "a", names: "." }],
}"#;

fuzz_target!(|data: &[u8]| {
    let path = PLACE.join("merge.json5");
    fs::write(&path, data).expect("written");
    if !PLACE.join("recipe.json5").exists() {
        fs::write(PLACE.join("recipe.json5"), RECIPE).expect("written");
    }
    let Ok(file) = ResolvedMergeFile::read(&path) else { return };
    let Ok(recipe) = file.find_recipe(&KNOWLEDGE) else { return };
    let ResolvedMergeFile { donors, options, out, .. } = file;
    hold(&MergeRequest { recipe, donors, options, versions: Vec::new(), tolerate: Vec::new(), out, dry_run: true, hash: Default::default(), hash_donors: false });
});
