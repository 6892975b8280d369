//! Versions that a file of an environment pins, for `--for @FILE`: lock files, pyproject.toml and requirement files.
//!
//! Such a file is untrusted text. Nothing that it names is run, and only files beside it that it includes are read.

mod demand;
mod read;
mod requirement_file;
mod toml_file;

pub use read::read_pins;
