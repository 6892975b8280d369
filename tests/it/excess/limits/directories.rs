//! Limits on what a directory holds.

use super::Limit;

pub(super) const LIMITS: &[Limit] = &[Limit {
    of: "entries of a directory",
    at: "src/checkpoint/read.rs MAX_NAMES",
    most: 100_000,
    file: "config.json",
    write: |n, files| {
        let here = files.len();
        files.extend((here..n).map(|i| (format!("x{i}"), Vec::new())));
        files["config.json"].clone()
    },
    says: "checkpoint-too-large",
}];
