//! Chat templates. Those of the allow list are rendered in this process, so they may cost neither time nor memory: `fuzz/run` sets
//! the limits.

#![no_main]

use ckpt_doctor::check::rendered_in_process;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let first = rendered_in_process(text);
    // What is said of a template does not depend on the run.
    assert!(first == rendered_in_process(text), "rendered otherwise");
});
