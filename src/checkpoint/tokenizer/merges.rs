//! The merges of tokenizer.json, held against its vocabulary.
//!
//! Source: the deserialisation of `BPE` in tokenizers 0.21.4 to 0.23.3. Merges are texts of two tokens with a blank between, or
//! pairs of tokens; both tokens and what they make together must be in the vocabulary.

use std::collections::HashSet;

use super::super::Document;
use super::super::scan::{Scanner, Token};
use super::Vocabulary;

/// What the library does with merges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Merges {
    /// It reads them.
    Fit,
    /// It refuses the one at this index.
    Unfit(usize),
    /// They are of a kind that is not modelled.
    Unknown,
}

impl Merges {
    /// The merges of a document. Called once for each checkpoint with a tokenizer.json.
    pub(super) fn of(document: &Document, vocabulary: &Vocabulary) -> Self {
        Self::read(document, vocabulary).unwrap_or(Self::Unknown)
    }

    fn read(document: &Document, vocabulary: &Vocabulary) -> Option<Self> {
        let prefix = document.get("/model/continuing_subword_prefix").and_then(serde_json::Value::as_str);
        if prefix.is_some_and(|prefix| !prefix.is_empty()) {
            return None;
        }
        let text = document.text.as_deref()?;
        let mut scanner = Scanner::lenient(text, document.locate("/model/merges")?.start);
        if scanner.next().ok()??.0 != Token::BeginArray {
            return None;
        }
        let known: HashSet<&str> = vocabulary.iter().map(|(token, _)| token).collect();
        let (mut made, mut is_paired) = (String::new(), None);
        for at in 0.. {
            let first = scanner.next().ok()??.0;
            let is_pair = match first {
                Token::EndArray => return Some(Self::Fit),
                Token::BeginArray => true,
                Token::String(_) => false,
                _ => return None,
            };
            // All are of one form.
            if *is_paired.get_or_insert(is_pair) != is_pair {
                return Some(Self::Unfit(at));
            }
            let (pair, whole);
            let (left, right) = if let Token::String(merge) = first {
                whole = merge.decode().0;
                if whole.starts_with("#version") {
                    return None;
                }
                let Some(parts) = whole.split_once(' ').filter(|(_, right)| !right.contains(' ')) else {
                    return Some(Self::Unfit(at));
                };
                parts
            } else {
                let parts = [scanner.next().ok()??.0, scanner.next().ok()??.0];
                let [Token::String(left), Token::String(right)] = parts else { return Some(Self::Unfit(at)) };
                if scanner.next().ok()??.0 != Token::EndArray {
                    return Some(Self::Unfit(at));
                }
                pair = (left.decode().0, right.decode().0);
                (&*pair.0, &*pair.1)
            };
            made.clear();
            made.push_str(left);
            made.push_str(right);
            if ![left, right, made.as_str()].into_iter().all(|token| known.contains(token)) {
                return Some(Self::Unfit(at));
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::Merges;
    use crate::checkpoint::tokenizer::Vocabulary;
    use crate::checkpoint::{Document, files};

    fn of(merges: &serde_json::Value, prefix: &str) -> Merges {
        let vocab = json!({ "a": 0, "b": 1, "ab": 2, "é": 3, "aé": 4 });
        let model = json!({ "type": "BPE", "continuing_subword_prefix": prefix, "vocab": vocab, "merges": merges });
        let document = Document::from_value(files::TOKENIZER, json!({ "model": model }));
        let vocabulary = Vocabulary::from_document(&document, "/model/vocab").unwrap().unwrap();
        Merges::of(&document, &vocabulary)
    }

    #[test]
    fn merges_are_pairs_of_tokens_whose_whole_is_a_token() {
        for (merges, found) in [
            (json!([]), Merges::Fit),
            (json!(["a b", "a é"]), Merges::Fit),
            (json!([["a", "b"], ["a", "é"]]), Merges::Fit),
            (json!(["a b", "b a"]), Merges::Unfit(1)),
            (json!(["a b", ["a", "b"]]), Merges::Unfit(1)),
            (json!([["a", "b"], "a b"]), Merges::Unfit(1)),
            (json!(["a  b"]), Merges::Unfit(0)),
            (json!(["ab"]), Merges::Unfit(0)),
            (json!([["a", "b", "a"]]), Merges::Unfit(0)),
            (json!([["a"]]), Merges::Unfit(0)),
            (json!(["a c"]), Merges::Unfit(0)),
            (json!([["c", "a"]]), Merges::Unfit(0)),
            (json!(["#version: 0.2"]), Merges::Unknown),
            (json!([7]), Merges::Unknown),
            (json!({}), Merges::Unknown),
        ] {
            assert_eq!(of(&merges, ""), found, "{merges}");
        }
        assert_eq!(of(&json!(["a b"]), "##"), Merges::Unknown);
    }
}
