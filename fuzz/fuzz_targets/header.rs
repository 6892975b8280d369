//! Shard headers.
//!
//! The first byte selects the input: 255 is a whole file; any other value is a header with that many bytes of data (0: as
//! many as its entries need). The length field is computed, because most inputs with a random one would be invalid.

#![no_main]

#[path = "../../tests/it/support/invariants.rs"]
mod invariants;

use std::cell::RefCell;

use ckpt_doctor::checkpoint::Shard;
use libfuzzer_sys::fuzz_target;

/// Maximum number of data bytes after a header.
const MOST: u64 = 1 << 16;

thread_local! {
    static FILE: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

fuzz_target!(|data: &[u8]| {
    let Some((mode, rest)) = data.split_first() else { return };
    if *mode == 255 {
        return invariants::header::hold(rest);
    }
    FILE.with_borrow_mut(|file| {
        let header = 8 + rest.len();
        if file.len() < header + MOST as usize {
            file.resize(header + MOST as usize, 0);
        }
        file[..8].copy_from_slice(&(rest.len() as u64).to_le_bytes());
        file[8..header].copy_from_slice(rest);
        let mut region = u64::from(*mode);
        if region == 0 {
            let shard = Shard::parse(invariants::header::NAME, header as u64, &file[..header]);
            region = shard.tensors.iter().map(|t| t.end).max().unwrap_or(0).min(MOST);
        }
        invariants::header::hold(&file[..header + region as usize]);
    });
});
