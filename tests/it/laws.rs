//! What an untrusted directory may do, as laws: each test generates its cases from a seed.
//!
//! `SECURITY.md` names the test of each promise. `CKPT_DOCTOR_LAWS=500` sets the number of cases of each test, and
//! `CKPT_DOCTOR_SEED=7` draws others.

mod completeness;
mod exit;
mod form;
mod judgement;
mod leaks;
#[cfg(unix)]
mod mind;
#[cfg(unix)]
mod mutants;
mod order;
mod templates;
mod verdicts;

use std::path::Path;
use std::sync::LazyLock;

use tempfile::TempDir;

/// Number of cases of a test: `few` in a plain `cargo test`.
pub fn cases(few: u64) -> u64 {
    std::env::var("CKPT_DOCTOR_LAWS").map_or(few, |n| n.parse().expect("a number"))
}

/// The seed of a test: `own` unless the environment has another.
pub fn seed(own: u64) -> u64 {
    std::env::var("CKPT_DOCTOR_SEED").map_or(own, |seed| seed.parse().expect("a number"))
}

/// Writes a sound tiny Llama.
fn base(dir: &Path) {
    static LLAMA: LazyLock<TempDir> = LazyLock::new(|| {
        let dir = TempDir::new().unwrap();
        crate::support::make_base("llama", dir.path());
        dir
    });
    std::fs::create_dir_all(dir).unwrap();
    crate::support::copy(LLAMA.path(), dir);
}
