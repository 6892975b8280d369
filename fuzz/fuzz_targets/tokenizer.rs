//! The files of a tokenizer. The first byte selects the file; 0xff bytes separate several files.

#![no_main]

#[path = "../../tests/it/support/invariants.rs"]
mod invariants;

use libfuzzer_sys::fuzz_target;

const FILES: [&str; 7] = [
    "tokenizer.model",
    "vocab.txt",
    "tokenizer.json",
    "vocab.json",
    "tokenizer_config.json",
    "added_tokens.json",
    "special_tokens_map.json",
];

fuzz_target!(|data: &[u8]| {
    let Some((first, rest)) = data.split_first() else { return };
    if *first == 0 {
        // A protocol buffer may contain any byte.
        return invariants::documents::tokenizer(&[("tokenizer.model", rest)]);
    }
    let mut files = Vec::with_capacity(4);
    for part in data.split(|b| *b == 0xff).take(4) {
        if let Some((which, bytes)) = part.split_first() {
            files.push((FILES[usize::from(*which) % FILES.len()], bytes));
        }
    }
    invariants::documents::tokenizer(&files);
});
