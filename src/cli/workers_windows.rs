//! Windows has no workers: the directories of a run are checked in threads of one process.

use std::ffi::OsString;
use std::path::PathBuf;

use super::exit::FAILED;
use super::look::{CheckRun, Looked, Stop};
use crate::checkpoint::parallel;

/// The first argument of a worker.
pub const ARGUMENT: &str = "--check-in-worker";

/// Checks the directories in this many threads; the results in their order.
pub fn look(run: &CheckRun<'_>, dirs: &[PathBuf], threads: usize) -> Vec<Result<Looked, Stop>> {
    parallel::map(threads, dirs, || (), |(), dir| run.look(dir))
}

/// Fails: nothing starts a worker.
pub fn main(_args: impl Iterator<Item = OsString>) -> u8 {
    FAILED
}
