//! Measures the parts of `check` that do not read weights: `cargo bench --bench rules [-- DIRECTORY...]`
//!
//! Without a directory, the bench takes the donors of `fixtures`. Each line has the fastest of many runs, because
//! disturbances only make a run slower.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]
#![allow(clippy::expect_used, reason = "a bench stops at the first error")]

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use ckpt_doctor::check::check;
use ckpt_doctor::check::load::{Stored, build, predict};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::{Knowledge, Loader};

fn main() {
    let mut dirs: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    if dirs.is_empty() {
        let donors = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/donors");
        dirs = ["llava3d-tiny", "spatialvla-tiny"].map(|name| format!("{donors}/{name}")).to_vec();
    }
    let embedded = || Knowledge::embedded().expect("the built-in rules");
    fastest("all rules and tables", 5, || embedded().read_all());
    let knowledge = embedded();
    for dir in dirs {
        println!("{dir}");
        measure(Path::new(&dir), &knowledge);
    }
}

/// Measures one checkpoint: its headers and documents, the names of its tensors in the newest loader that has
/// the class, and all rules.
fn measure(dir: &Path, knowledge: &Knowledge) {
    let open = || Checkpoint::open(dir).expect("a checkpoint");
    fastest("headers and documents", 50, open);
    let checkpoint = Arc::new(open());
    let stored = Stored::of(&checkpoint);
    let names = || checkpoint.shards.values().flat_map(|shard| shard.tensors.iter().map(|tensor| tensor.name.as_str()));
    let config = checkpoint.config().cloned().unwrap_or_default();
    let class = |loader| knowledge.library.find(&config, names(), loader);
    if let Some(class) = Loader::ALL.into_iter().rev().find_map(class) {
        fastest("names that the class expects", 50, || build(class, &config, &stored).is_ok());
        if let Ok(expected) = build(class, &config, &stored) {
            fastest("names that the loader matches", 50, || predict(&expected, &stored));
        }
    }
    fastest("all rules", 20, || check(&checkpoint, knowledge));
}

/// Runs `work` a number of times, and prints the shortest time.
fn fastest<T>(name: &str, runs: usize, work: impl Fn() -> T) {
    let times = (0..runs).map(|_| {
        let begun = Instant::now();
        black_box(work());
        begun.elapsed()
    });
    println!("{name:34} {:9} us", times.min().unwrap_or_default().as_micros());
}
