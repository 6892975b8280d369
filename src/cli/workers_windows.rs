//! Windows has no workers: the directories of a run are checked in threads of one process.

use std::ffi::OsString;
use std::path::PathBuf;

use super::exit::FAILED;
use super::look::{Answer, CheckRun, Stop};
use crate::checkpoint::parallel;

/// The first argument of a worker.
pub const ARGUMENT: &str = "--check-in-worker";

/// Asks for each directory in this many threads; the answers in their order.
pub fn ask<T: Answer>(run: &CheckRun<'_>, dirs: &[PathBuf], threads: usize) -> Vec<Result<T, Stop>> {
    parallel::map(threads, dirs, || (), |(), dir| T::of(run, dir))
}

/// Asks for each directory when its answer is asked for.
pub fn ask_in_turn<'d, T: Answer + 'd>(
    run: &'d CheckRun<'_>,
    dirs: &'d [PathBuf],
) -> Box<dyn Iterator<Item = Result<T, Stop>> + 'd> {
    Box::new(dirs.iter().map(|dir| T::of(run, dir)))
}

/// Fails: nothing starts a worker.
pub fn main(_args: impl Iterator<Item = OsString>) -> u8 {
    FAILED
}
