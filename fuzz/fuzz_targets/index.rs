//! `model.safetensors.index.json`.

#![no_main]

#[path = "../../tests/it/support/invariants.rs"]
mod invariants;

libfuzzer_sys::fuzz_target!(|data: &[u8]| invariants::documents::index(data));
