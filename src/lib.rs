//! Validates, repairs and merges model checkpoint directories from their files alone.
//!
//! Each module is one stage, and data moves from the first to the last:
//! [`checkpoint`] reads what is there, [`knowledge`] says what should be, [`check`] compares the
//! two, [`surgery`] plans and writes changes, [`report`] renders. No module imports from a later one.

pub mod check;
pub mod checkpoint;
pub mod knowledge;
pub mod report;
pub mod surgery;

#[cfg(test)]
mod schemas;
