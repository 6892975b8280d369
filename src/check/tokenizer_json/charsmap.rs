//! The table of a `Precompiled` normalizer: base64 of the size of a trie in bytes, the trie, and the texts that it leads to.
//!
//! Source: `Precompiled` of the crate `spm_precompiled`, with which tokenizers 0.21.4 to 0.23.3 read it.

use data_encoding::{BASE64, BASE64_NOPAD};

/// Bytes of the size.
const SIZE: usize = 4;

/// Whether the library reads a table. Called for each such normalizer of a tokenizer.json.
pub(super) fn is_charsmap(text: &str) -> bool {
    // With its padding or without. `BASE64` also reads padding before the end.
    if text.trim_end_matches('=').contains('=') {
        return false;
    }
    let Ok(bytes) = BASE64.decode(text.as_bytes()).or_else(|_| BASE64_NOPAD.decode(text.as_bytes())) else {
        return false;
    };
    let Some((size, rest)) = bytes.split_first_chunk::<SIZE>() else { return false };
    let units = u32::from_le_bytes(*size) / 4;
    let trie = usize::try_from(units).ok().and_then(|units| units.checked_mul(SIZE));
    trie.and_then(|trie| rest.get(trie..)).is_some_and(|texts| std::str::from_utf8(texts).is_ok())
}

#[cfg(test)]
mod tests {
    use super::is_charsmap;
    use crate::knowledge::tokenizer_values::TokenizerValues;

    /// The table has those of them that the library reads: `CHARSMAPS` of `tools/loader_tokenizer_values.py`.
    #[test]
    fn a_table_has_a_whole_trie_and_texts_in_utf_8() {
        let values = TokenizerValues::embedded().unwrap();
        let read = values.words("normalizer Precompiled/precompiled_charsmap").unwrap();
        assert!(read.iter().all(|text| is_charsmap(text)));
        for (text, is_read) in [
            ("BAAAAAAAAABhYgA=", true),
            // No texts.
            ("BAAAAAAAAAA=", true),
            // A trie of five bytes has one unit.
            ("BQAAAAAAAABhYgA=", true),
            ("AAAAAAAAAABhYgA=", true),
            // Without padding.
            ("BAAAAAAAAABhYg", true),
            ("BAAAAAAAAABhYg==", true),
            // A trie that is longer than the rest.
            ("kAEAAAAAAABhYgA=", false),
            // No UTF-8.
            ("BAAAAAAAAABhYgD/", false),
            ("", false),
            ("YWJj", false),
            ("BAAAAAAAAABhYgA=\n", false),
            ("*AAAAAAAAABhYgA=", false),
            ("BAAAAAAAAABhYgA_", false),
            // Bits after the last byte.
            ("BAAAAAAAAABhYB==", false),
            // Padding in the middle, and too much of it.
            ("BAAAAAAAAABhYg==BAAAAAAAAABhYgA=", false),
            ("BAAAAAAAAABhYgA==", false),
        ] {
            assert_eq!((is_charsmap(text), read.contains(text)), (is_read, is_read), "{text}");
        }
    }
}
