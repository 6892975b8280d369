//! Validates, repairs and merges model checkpoint directories from their files alone.
//!
//! Each module is one stage, and data moves from the first to the last: [`checkpoint`] reads files, [`knowledge`]
//! holds rules and architectures, [`check`] compares the two, [`surgery`] plans and writes changes, [`report`] renders,
//! [`merge`] runs all of these to build one checkpoint from several. No module imports from a later one.

pub mod check;
pub mod checkpoint;
pub mod knowledge;
pub mod merge;
pub mod report;
pub mod surgery;

#[cfg(test)]
mod schemas;
