//! JSON documents: values, faults and their places.

#![no_main]

#[path = "../../tests/it/support/invariants.rs"]
mod invariants;

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    invariants::documents::hold("config.json", data);
});
