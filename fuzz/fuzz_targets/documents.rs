//! JSON documents: read, faults explained, places found again.

#![no_main]

#[path = "../../tests/laws/mod.rs"]
mod laws;

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    laws::documents::hold("config.json", data);
});
