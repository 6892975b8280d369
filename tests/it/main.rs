//! All integration tests, in one binary: it links the library once.
//!
//! `cargo test --test it merge::` runs one area. `tests/README.md` describes the areas. On Windows, where nothing is
//! written, only those run that neither write nor need what only a Unix has.

#![allow(
    clippy::arithmetic_side_effects,
    clippy::cast_possible_truncation,
    clippy::expect_used,
    clippy::format_push_string,
    clippy::indexing_slicing,
    clippy::print_stdout,
    clippy::too_many_lines,
    clippy::unwrap_used,
    reason = "a panic fails the test"
)]
#![cfg_attr(windows, allow(dead_code, unused_imports, unused_macros, reason = "support of the other areas"))]
#![allow(clippy::disallowed_methods, reason = "tests read the project's files and write temporary directories")]

#[macro_use]
mod support;

mod cli;
#[cfg(unix)]
mod docs;
#[cfg(unix)]
mod excess;
#[cfg(unix)]
mod fix;
#[cfg(unix)]
mod hostile;
#[cfg(unix)]
mod house;
#[cfg(unix)]
mod laws;
#[cfg(unix)]
mod library;
mod load;
#[cfg(unix)]
mod merge;
#[cfg(unix)]
mod mutation;
#[cfg(unix)]
mod pages;
mod readers;
#[cfg(unix)]
mod reported;
mod reports;
#[cfg(unix)]
mod rules;
#[cfg(unix)]
mod yesterday;
