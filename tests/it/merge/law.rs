//! The law of merges, for generated recipes and options: a merge writes inside its target or nothing, and what it
//! publishes runs no code of a donor's choice.
//!
//! The recipes follow from a seed. `cargo test` runs some hundreds; `CKPT_DOCTOR_LAWS=100000` sets the number.

pub mod bytes;
mod donors;
mod mutants;
mod recipes;
mod tensors;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use ckpt_doctor::checkpoint::{PythonModule, Shard};
use ckpt_doctor::knowledge::recipe::CODE_SWITCHES;
use ckpt_doctor::{Merge, MergeStage, Report};
use serde_json::Value;
use tempfile::TempDir;

use crate::support::Draw;
use recipes::Request;

/// Number of recipes in a plain `cargo test`.
const FEW: usize = 300;

/// Paths below a folder with their bytes; `None` for a directory.
type Snapshot = BTreeMap<PathBuf, Option<Vec<u8>>>;

fn snapshot(folder: &Path) -> Snapshot {
    let mut out = Snapshot::new();
    let mut pending = vec![folder.to_owned()];
    while let Some(here) = pending.pop() {
        for entry in fs::read_dir(here).unwrap() {
            let path = entry.unwrap().path();
            let kind = fs::symlink_metadata(&path).unwrap();
            if kind.is_dir() {
                pending.push(path.clone());
            }
            out.insert(path.clone(), kind.is_file().then(|| fs::read(&path).unwrap()));
        }
    }
    out
}

/// A folder with the donors, and an empty one three levels deeper for the results: `../../x` stays in the snapshot.
struct Room {
    all: TempDir,
    results: PathBuf,
}

impl Room {
    fn new() -> Self {
        let all = TempDir::new().unwrap();
        donors::write(&all.path().join("donors"));
        let results = all.path().join("a/b/results");
        fs::create_dir_all(&results).unwrap();
        Self { all, results }
    }

    /// Runs one merge, and checks what it left.
    fn run(&self, request: &Request, before: &Snapshot) -> &'static str {
        let recipe = self.all.path().join("recipe.json");
        fs::write(&recipe, request.recipe.to_string()).unwrap();
        let out = self.results.join("out");
        let mut merge = Merge::new(&out).recipe(recipe.to_str().unwrap());
        for (role, donor) in &request.donors {
            merge = merge.donor(*role, self.all.path().join("donors").join(donor));
        }
        for (name, value) in &request.options {
            merge = merge.option(*name, value);
        }
        let result = merge.run();
        fs::remove_file(recipe).unwrap();
        let outcome = match &result {
            Ok(report) if report.merge.as_ref().unwrap().stage == Some(MergeStage::Written) => {
                published(&out, report);
                fs::remove_dir_all(&out).unwrap();
                "written"
            }
            Ok(_) => "stopped",
            Err(error) => {
                in_words(&error.to_string());
                "refused"
            }
        };
        // Equal after the result is removed: no other file, no `.out.partial`, donors as they were.
        assert!(snapshot(self.all.path()) == *before, "{outcome}: a file outside of the target changed");
        outcome
    }
}

/// An error is a sentence; the words of the expression language only follow one, in brackets with the expression.
fn in_words(error: &str) {
    const RAW: [&str; 10] = [
        "overload",
        "No such key",
        "Unexpected type",
        "Undeclared reference",
        "can not be compared",
        "Unsupported",
        "Invalid argument",
        "InternalError",
        "Error executing",
        "Index out of bounds",
    ];
    assert!(!error.trim().is_empty());
    for raw in RAW {
        if let Some((before, _)) = error.split_once(raw) {
            assert!(before.contains(" (`"), "the words of the expression language alone: {error}");
        }
    }
}

/// What holds for every published directory.
fn published(out: &Path, report: &Report) {
    let files = snapshot(out);
    let names: BTreeSet<&str> = files.keys().map(|p| p.file_name().unwrap().to_str().unwrap()).collect();
    let bytes = |name: &str| files[&out.join(name)].as_deref().unwrap_or_else(|| panic!("{name} is a file"));
    let merge = report.merge.as_ref().unwrap();
    let (shards, others): (Vec<&str>, Vec<&str>) = names.iter().partition(|name| name.ends_with(".safetensors"));
    let listed: BTreeSet<&str> = merge.files.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(listed, others.iter().copied().collect(), "the report lists the files");
    let tensors: usize = shards
        .iter()
        .map(|name| Shard::parse(*name, bytes(name).len() as u64, bytes(name)))
        .map(|shard| {
            assert!(shard.faults.is_empty(), "{:?}", shard.faults);
            shard.tensors.len()
        })
        .sum();
    assert!(tensors > 0 && tensors == merge.tensors, "{tensors} tensors");
    for name in others {
        assert!(!name.starts_with('.'), "{name}");
        if name.ends_with(".py") {
            // These two of the donors do not compile, whatever the parser says.
            let text = String::from_utf8_lossy(bytes(name));
            assert!(!text.contains("def serve(") && !text.contains("a.import.b"), "{name}: {text}");
            assert_eq!(PythonModule::parse(name, bytes(name)).faults, [], "{name}");
        } else if name.to_lowercase().ends_with(".json") {
            let value: Value = serde_json::from_slice(bytes(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
            no_switches(name, &value, &names);
        }
    }
}

/// No key that makes a loader run code, at any depth, except an `auto_map` that names published modules.
fn no_switches(name: &str, document: &Value, published: &BTreeSet<&str>) {
    let mut pending = vec![(document, true)];
    while let Some((value, top)) = pending.pop() {
        if let Value::Object(map) = value {
            for (key, value) in map {
                if top && key == "auto_map" {
                    for target in value.as_object().unwrap_or_else(|| panic!("{name}: {value}")).values() {
                        let target = target.as_str().unwrap_or_else(|| panic!("{name}: {target}"));
                        let module = format!("{}.py", target.split('.').next().unwrap());
                        assert!(published.contains(module.as_str()), "{name}: {target}");
                    }
                } else {
                    let token = name == "added_tokens.json" && value.is_u64();
                    assert!(token || !CODE_SWITCHES.contains(&key.as_str()), "{name}: {key} in {document}");
                }
                pending.push((value, false));
            }
        } else if let Value::Array(items) = value {
            pending.extend(items.iter().map(|item| (item, false)));
        }
    }
}

#[test]
fn a_merge_writes_inside_its_target_or_nothing() {
    let wanted = std::env::var("CKPT_DOCTOR_LAWS").map_or(FEW, |n| n.parse().expect("a number"));
    let next = AtomicUsize::new(0);
    let work = || {
        let (mut outcomes, mut broken) = (BTreeMap::new(), Vec::new());
        let mut room = Room::new();
        let mut before = snapshot(room.all.path());
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= wanted {
                return (outcomes, broken);
            }
            let request = Request::new(&mut Draw::new(number as u64), room.all.path());
            if let Ok(outcome) = catch_unwind(AssertUnwindSafe(|| room.run(&request, &before))) {
                *outcomes.entry(outcome).or_insert(0_usize) += 1;
            } else {
                broken.push(format!("recipe {number}: {}, options {:?}", request.recipe, request.options));
                room = Room::new();
                before = snapshot(room.all.path());
            }
        }
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(8);
    let (mut outcomes, mut broken) = (BTreeMap::<&str, usize>::new(), Vec::new());
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        for (some, wrong) in workers.into_iter().map(|w| w.join().unwrap()) {
            for (outcome, n) in some {
                *outcomes.entry(outcome).or_default() += n;
            }
            broken.extend(wrong);
        }
    });
    assert!(broken.is_empty(), "{} of {wanted}:\n{}", broken.len(), broken[..broken.len().min(5)].join("\n"));
    // A generator whose recipes are all refused at their first word would test nothing.
    for outcome in ["written", "refused"] {
        assert!(outcomes.get(outcome).is_some_and(|n| n * 10 > wanted), "{outcomes:?}");
    }
}
