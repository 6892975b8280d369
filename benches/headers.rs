//! Measures the time for reading headers: `cargo bench --bench headers [-- SHARD...]`
//!
//! Without a shard, the bench generates a header of forty thousand tensors, as in a mixture-of-experts model.
//! `tools/overflow-checks` runs it with and without overflow checks.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]
#![allow(
    clippy::arithmetic_side_effects,
    clippy::disallowed_methods,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a bench stops at the first error"
)]

use std::fmt::Write as _;
use std::hint::black_box;
use std::time::Instant;

use ckpt_doctor::checkpoint::Shard;

fn main() {
    let files: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let mut headers: Vec<(String, Vec<u8>)> = Vec::new();
    for file in files {
        let mut bytes = std::fs::read(&file).expect("a file");
        let length = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"));
        bytes.truncate(usize::try_from(length).expect("small") + 8);
        headers.push((file, bytes));
    }
    if headers.is_empty() {
        headers.push(("experts".to_owned(), experts()));
    }
    for (name, bytes) in headers {
        let read = || Shard::parse("model.safetensors", 1 << 50, black_box(&bytes));
        let tensors = read().tensors.len();
        // The fastest of many runs, because disturbances only make a run slower.
        let fastest = (0..100).map(|_| {
            let begun = Instant::now();
            black_box(read());
            begun.elapsed()
        });
        println!("{name}: {tensors} tensors, {} us", fastest.min().unwrap_or_default().as_micros());
    }
}

/// A header of 128 experts in 80 layers.
fn experts() -> Vec<u8> {
    let mut header = String::from(r#"{"__metadata__":{"format":"pt"}"#);
    let mut at = 0_u64;
    for (layer, expert) in (0..80).flat_map(|layer| (0..128).map(move |expert| (layer, expert))) {
        for module in ["gate_proj", "up_proj", "down_proj", "router"] {
            let (begin, end) = (at, at + 2 * 1536 * 4096);
            let name = format!("model.layers.{layer}.mlp.experts.{expert}.{module}.weight");
            let _ =
                write!(header, r#","{name}":{{"dtype":"BF16","shape":[1536,4096],"data_offsets":[{begin},{end}]}}"#);
            at = end;
        }
    }
    header.push('}');
    [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat()
}
