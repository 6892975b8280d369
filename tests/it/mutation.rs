//! Mutations of sound files: the readers' invariants hold, and the checks do not panic.
//!
//! The inputs follow from a seed. `cargo test` runs some thousands; `CKPT_DOCTOR_MUTATIONS=200000`, as in CI, sets the
//! number.

mod mutate;

use std::collections::BTreeMap;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};

use ckpt_doctor::check::check;
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::report::Format;
use mutate::Mutator;

use crate::support::Draw;
use crate::support::repairs::{File, planned, renders, repairs};

/// Number of inputs in a plain `cargo test`.
const FEW: usize = 2_000;
/// One in this many inputs goes through all checks and a renderer, which takes a hundred times as long.
const CHECKED: usize = 100;

/// A sound file.
struct Seed {
    name: String,
    bytes: Vec<u8>,
}

/// The files of a checkpoint, with weights truncated to the header.
fn seeds(base: &str) -> Vec<Seed> {
    let dir = tempfile::TempDir::new().unwrap();
    crate::support::make_base(base, dir.path());
    let mut seeds = Vec::new();
    for entry in fs::read_dir(dir.path()).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name().into_string().unwrap();
        let bytes = fs::read(entry.path()).unwrap();
        // In larger files, a mutation is unlikely to change anything that is read.
        if bytes.len() < 1 << 20 {
            seeds.push(Seed { name, bytes });
        }
    }
    seeds.sort_by(|a, b| a.name.cmp(&b.name));
    seeds
}

/// Checks the invariants of a file with this name.
fn hold(name: &str, bytes: &[u8]) {
    if name.ends_with(".safetensors") {
        crate::support::invariants::header::hold(bytes);
    } else if name.ends_with(".index.json") {
        crate::support::invariants::documents::index(bytes);
    } else if name == "tokenizer.json" || name == "tokenizer_config.json" {
        crate::support::invariants::documents::tokenizer(&[(name, bytes)]);
    } else if name.ends_with(".json") {
        crate::support::invariants::documents::hold(name, bytes);
    } else if name.ends_with(".py") {
        crate::support::invariants::module::hold(bytes);
    } else {
        crate::support::invariants::documents::vocabulary(name, bytes);
    }
}

/// Changes one file of the checkpoint, then checks it, renders a report and repairs it.
fn look(seeds: &[Seed], changed: usize, bytes: &[u8], knowledge: &Knowledge, format: Format) {
    let mut files: Vec<File> =
        seeds.iter().map(|seed| (seed.name.as_str(), seed.bytes.len() as u64, seed.bytes.as_slice())).collect();
    files[changed] = (files[changed].0, bytes.len() as u64, bytes);
    let checkpoint = planned(&files);
    let outcome = check(&checkpoint, knowledge);
    renders(&checkpoint, &outcome, format);
    repairs(&files, &checkpoint, &outcome, knowledge);
}

#[test]
fn invariants_hold_for_mutated_files() {
    let wanted = std::env::var("CKPT_DOCTOR_MUTATIONS").map_or(FEW, |n| n.parse().expect("a number"));
    let bases: Vec<Vec<Seed>> =
        ["llama", "llama-sharded", "llama-gptq", "lora", "spatialvla"].map(seeds).into_iter().collect();
    let files: Vec<(usize, usize)> =
        bases.iter().enumerate().flat_map(|(b, seeds)| (0..seeds.len()).map(move |s| (b, s))).collect();
    let knowledge = crate::support::knowledge();
    let next = AtomicUsize::new(0);
    let work = || {
        let mut broken = BTreeMap::new();
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= wanted {
                return broken;
            }
            let (base, file) = files[number % files.len()];
            let seed = &bases[base][file];
            let mut mutator = Mutator(Draw::new(number as u64));
            let other = &bases[base][mutator.0.below(bases[base].len())];
            let bytes = mutator.mutate(&seed.bytes, &other.bytes);
            let tried = catch_unwind(AssertUnwindSafe(|| {
                hold(&seed.name, &bytes);
                if number.is_multiple_of(CHECKED) {
                    let format = Format::ALL[number / CHECKED % Format::ALL.len()];
                    look(&bases[base], file, &bytes, &knowledge, format);
                }
            }));
            if tried.is_err() {
                broken.insert(number, seed.name.clone());
            }
        }
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(8);
    let mut broken = BTreeMap::new();
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        broken.extend(workers.into_iter().flat_map(|w| w.join().unwrap()));
    });
    let shown: Vec<_> = broken.iter().take(20).map(|(number, name)| format!("{name}, mutation {number}")).collect();
    assert!(broken.is_empty(), "{} of {wanted}: {}", broken.len(), shown.join("; "));
}
