//! Vocabularies and added tokens.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, LazyLock};

use ckpt_doctor::checkpoint::{Document, FaultKind, Tokenizer, Vocabulary};
use serde_json::json;

use super::{Case, hold, open_with};

/// A sentencepiece model with these pieces.
pub fn sentencepiece(pieces: &[&str]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for piece in pieces {
        // Field 1: the string; field 2: a float score; field 3: the type.
        let mut message = vec![0x0a, piece.len() as u8];
        message.extend(piece.as_bytes());
        message.extend([0x15, 0, 0, 0x80, 0x3f, 0x18, 1]);
        bytes.extend([0x0a, message.len() as u8]);
        bytes.extend(message);
    }
    // Field 2: the trainer's settings, skipped.
    bytes.extend([0x12, 2, 0xff, 0xff]);
    bytes
}

pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(cases);

fn cases() -> Vec<Case> {
    let model = |label, expected: &[FaultKind], bytes: &[u8]| {
        Case::new(label, expected, open_with("tokenizer.model", bytes).tokenizer.faults.clone())
    };
    let mut cut = sentencepiece(&["<unk>", "<s>", "</s>"]);
    cut.truncate(20);
    vec![
        model("model", &[], &sentencepiece(&["<unk>", "<s>", "</s>", "▁a"])),
        model("cut off", &[FaultKind::VocabularyMalformed], &cut),
        model("text", &[FaultKind::VocabularyMalformed], b"hello, this is not a protocol buffer"),
        model("number without end", &[FaultKind::VocabularyMalformed], &[0xff; 64]),
        model("length 2^63", &[FaultKind::VocabularyMalformed], b"\x0a\xff\xff\xff\xff\xff\xff\xff\xff\x7f"),
        model("empty", &[FaultKind::EmptyFile], b""),
        model(
            "pointer",
            &[FaultKind::LfsPointer],
            b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 9\n",
        ),
    ]
}

#[test]
fn faults_of_vocabularies() {
    hold(&CASES);
}

fn tokenizer(documents: Vec<Document>, model: Option<Vec<u8>>) -> Tokenizer {
    let mut files: BTreeSet<String> =
        documents.iter().map(|d| d.name.clone()).filter(|n| n == "tokenizer.json").collect();
    let mut vocabularies = BTreeMap::new();
    if let Some(bytes) = model {
        files.insert("tokenizer.model".into());
        vocabularies.insert("tokenizer.model".into(), Arc::new(Vocabulary::parse("tokenizer.model", &bytes).unwrap()));
    }
    Tokenizer::new(&documents.into_iter().map(|d| (d.name.clone(), Arc::new(d))).collect(), vocabularies, files)
}

fn document(name: &str, value: &serde_json::Value) -> Document {
    Document::parse(name, value.to_string().as_bytes())
}

#[test]
fn a_slow_tokenizer_counts_pieces_stated_tokens_and_missing_special_ones() {
    let config = json!({"tokenizer_class": "LlamaTokenizer", "added_tokens_decoder": {
        "0": {"content": "<unk>"}, "4": {"content": "<image>"}, "6": {"content": "<x>"}},
        "bos_token": {"content": "<s>"}, "pad_token": "<pad>"});
    let extra = document("added_tokens.json", &json!({"<image>": 9, "<other>": 10}));
    let tokenizer = tokenizer(
        vec![document("tokenizer_config.json", &config), extra],
        Some(sentencepiece(&["<unk>", "<s>", "</s>", "a"])),
    );
    assert_eq!(tokenizer.source.as_deref(), Some("tokenizer.model"));
    assert_eq!(tokenizer.base().unwrap().len(), 4);
    // 4 pieces, <image>, <x>, <pad>; added_tokens.json is ignored beside a decoder.
    assert_eq!(tokenizer.length(), Some(7));
    assert_eq!(tokenizer.id_of("<image>"), Some(4));
    assert_eq!(tokenizer.id_of("a"), Some(3));
    assert_eq!(tokenizer.id_of("<pad>"), Some(7));
    assert!(!tokenizer.contains("<other>"));
    assert_eq!(tokenizer.added_tokens_json.as_ref().unwrap().len(), 2);
    assert_eq!(tokenizer.stated().get(&6), Some(&"<x>"));
}

#[test]
fn a_fast_tokenizer_keeps_its_own_ids_and_appends_the_rest() {
    let fast = json!({"added_tokens": [{"id": 3, "content": "<image>", "special": true}],
        "model": {"type": "BPE", "vocab": {"<unk>": 0, "a": 1, "\u{e9}": 2}, "merges": []}});
    let config = json!({"added_tokens_decoder": {"7": {"content": "<image>"}, "9": {"content": "<late>"}}});
    let documents = vec![document("tokenizer.json", &fast), document("tokenizer_config.json", &config)];
    let tokenizer = tokenizer(documents.clone(), Some(sentencepiece(&["<unk>"])));
    assert_eq!(tokenizer.source.as_deref(), Some("tokenizer.json"));
    assert_eq!(tokenizer.length(), Some(5));
    assert_eq!(tokenizer.id_of("<image>"), Some(3));
    assert_eq!(tokenizer.id_of("<late>"), Some(4));
    assert_eq!(tokenizer.id_of("é"), Some(2));
    // Only the vocabulary is omitted from the value.
    assert_eq!(documents[0].get("/model/vocab"), Some(&json!({})));
    assert_eq!(documents[0].get("/model/type"), Some(&json!("BPE")));
    let omitted = ["/model/vocab", "/model/merges"].map(|pointer| documents[0].locate(pointer).unwrap());
    assert_eq!(documents[0].left_out, omitted);
}

#[test]
fn add_prefix_space_makes_llama_take_the_sentencepiece_model() {
    let fast = document("tokenizer.json", &json!({"model": {"vocab": [["<unk>", 0.0], ["a", -1.5]]}}));
    let config =
        document("tokenizer_config.json", &json!({"tokenizer_class": "LlamaTokenizer", "add_prefix_space": true}));
    let with = tokenizer(vec![fast.clone(), config], Some(sentencepiece(&["<unk>"])));
    assert_eq!((with.source.as_deref(), with.length()), (Some("tokenizer.model"), Some(1)));
    let without = tokenizer(vec![fast], Some(sentencepiece(&["<unk>"])));
    assert_eq!((without.source.as_deref(), without.length()), (Some("tokenizer.json"), Some(2)));
}

#[test]
fn an_unreadable_vocabulary_has_no_length() {
    let broken = Document::parse("tokenizer.json", b"{\"model\": {\"vocab\": {\"a\": 0");
    let config = document("tokenizer_config.json", &json!({"added_tokens_decoder": {"5": {"content": "<x>"}}}));
    let tokenizer = tokenizer(vec![broken, config], None);
    assert_eq!(tokenizer.length(), None);
    assert_eq!(tokenizer.id_of("<x>"), Some(5));
}
