//! Python modules.

#![no_main]

#[path = "../../tests/it/support/invariants.rs"]
mod invariants;

libfuzzer_sys::fuzz_target!(|data: &[u8]| invariants::module::hold(data));
