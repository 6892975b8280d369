//! All integration tests, in one binary: it links the library once.
//!
//! `cargo test --test it merge::` runs one area. `tests/README.md` describes the areas.

#![allow(
    clippy::arithmetic_side_effects,
    clippy::cast_possible_truncation,
    clippy::expect_used,
    clippy::format_push_string,
    clippy::indexing_slicing,
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "a panic fails the test"
)]
#![allow(clippy::disallowed_methods, reason = "tests read the project's files and write temporary directories")]

#[macro_use]
mod support;

mod cli;
mod docs;
mod excess;
mod fix;
mod hostile;
mod house;
mod laws;
mod library;
mod load;
mod merge;
mod mutation;
mod pages;
mod readers;
mod reported;
mod reports;
mod rules;
