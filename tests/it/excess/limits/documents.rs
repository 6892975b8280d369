//! Limits on JSON documents, vocabularies and Python modules.

use serde_json::Value;

use super::{Files, Limit, base, config, findings, numbered, repeated};

/// A Git LFS pointer of so many bytes.
fn pointer(n: usize) -> Vec<u8> {
    let text = format!("version https://git-lfs.github.com/spec/v1\noid sha256:{}\nsize 1\next-0-x ", "0".repeat(64));
    format!("{text}{}", "x".repeat(n - text.len())).into_bytes()
}

/// Two members with one key, whose values of so many bytes differ in a space.
fn twins(n: usize, files: &Files) -> Vec<u8> {
    let text = "x".repeat(n - 5);
    config(files, &format!("\"x\": [ \"{text}\"], \"x\": [\"{text}\" ]"))
}

pub(super) const LIMITS: &[Limit] = &[
    Limit {
        of: "nesting of JSON",
        at: "src/checkpoint/scan.rs MAX_DEPTH",
        most: 127,
        file: "config.json",
        write: |n, files| config(files, &format!("\"x\": {}{}", "[".repeat(n - 1), "]".repeat(n - 1))),
        says: "deep",
    },
    Limit {
        of: "bytes of JSON",
        at: "src/checkpoint/open.rs JSON_CAP",
        most: 64 << 20,
        file: "special_tokens_map.json",
        write: |n, _| [b"{}".to_vec(), vec![b' '; n - 2]].concat(),
        says: "more than the 67.1 MB allowed",
    },
    Limit {
        of: "bytes of a vocabulary",
        at: "src/checkpoint/open.rs TOKENIZER_CAP",
        most: 64 << 20,
        file: "vocab.txt",
        write: |n, _| vec![b'x'; n],
        says: "more than the 67.1 MB allowed",
    },
    Limit {
        of: "bytes of a pointer of Git LFS",
        at: "src/checkpoint/lfs.rs MAX_POINTER",
        most: 1024,
        file: "special_tokens_map.json",
        write: |n, _| pointer(n),
        says: "special_tokens_map.json is not valid JSON",
    },
    Limit {
        of: "characters of a number",
        at: "src/checkpoint/document/read/build.rs MAX_DIGITS",
        most: 4300,
        file: "config.json",
        write: |n, files| config(files, &format!("\"x\": 1.{}", "0".repeat(n - 2))),
        says: "which readers cannot represent",
    },
    Limit {
        of: "bytes of values that are compared",
        at: "src/checkpoint/document/read/duplicates.rs COMPARE_CAP",
        most: 1 << 20,
        file: "config.json",
        write: |n, files| twins(n, files),
        says: "readers keep the last value",
    },
    Limit {
        of: "values of a document",
        at: "src/checkpoint/document/read/build.rs most_nodes",
        most: 100_000,
        file: "special_tokens_map.json",
        // The list and the object are two.
        write: |n, _| format!("{{\"x\":[0{}]}}", ",0".repeat(n - 3)).into_bytes(),
        says: "has more values than any checkpoint document",
    },
    Limit {
        of: "values of an index",
        at: "src/checkpoint/document/read/build.rs most_nodes",
        most: 400_000,
        file: "other.safetensors.index.json",
        write: |n, _| format!("{{\"weight_map\":{{}},\"x\":[0{}]}}", ",0".repeat(n - 4)).into_bytes(),
        says: "has more values than any checkpoint document",
    },
    Limit {
        of: "faults of a kind in a file",
        at: "src/checkpoint/fault.rs KIND_CAP",
        most: 64,
        file: "config.json",
        write: |n, files| config(files, &format!("\"x\": [1e999{}]", ",1e999".repeat(n - 1))),
        says: "(and 1 more)",
    },
    Limit {
        of: "findings of a rule",
        at: "src/check/evaluate.rs CAP",
        most: 1000,
        file: "special_tokens_map.json",
        write: |n, _| format!("{{\"x\": [NaN{}]}}", ",NaN".repeat(n - 1)).into_bytes(),
        says: "(and 1 more)",
    },
    Limit {
        of: "bytes of a module",
        at: "src/checkpoint/open.rs MODULE_CAP",
        most: 4 << 20,
        file: "modeling_x.py",
        write: |n, _| repeated("#", n),
        says: "more than the 4.19 MB allowed",
    },
    Limit {
        of: "bytes of a module that are parsed",
        at: "src/checkpoint/module/parse.rs MAX_BYTES",
        most: 512 << 10,
        file: "modeling_x.py",
        write: |n, _| repeated("#", n),
        says: "modeling_x.py was not read: it is too large or too deeply nested",
    },
    Limit {
        of: "nodes of a module",
        at: "src/checkpoint/module/parse.rs MAX_NODES",
        most: 1_000_000,
        file: "modeling_x.py",
        write: |n, _| nodes(n),
        says: "modeling_x.py was not read: it is too large or too deeply nested",
    },
    Limit {
        of: "entries of an auto_map",
        at: "src/check/modules.rs MAX_ENTRIES",
        most: 1000,
        file: "config.json",
        write: |n, files| config(files, &format!("\"auto_map\": {{{}}}", numbered("\"#\": null", ",", n))),
        says: "auto_map",
    },
    Limit {
        of: "classes of an entry of an auto_map",
        at: "src/check/modules.rs MAX_ENTRIES",
        most: 1000,
        file: "config.json",
        write: |n, files| {
            config(files, &format!("\"auto_map\": {{\"AutoTokenizer\": [null{}]}}", ", null".repeat(n - 1)))
        },
        says: "auto_map.AutoTokenizer is a list",
    },
    Limit {
        of: "tokens of a vocabulary",
        at: "src/checkpoint/tokenizer/vocabulary.rs MAX_TOKENS",
        most: 1_500_000,
        file: "vocab.txt",
        write: |n, _| repeated("\n", n),
        says: "a million and a half tokens",
    },
    Limit {
        of: "pieces of a sentencepiece model",
        at: "src/checkpoint/tokenizer/sentencepiece.rs MAX_PIECES",
        most: 1_500_000,
        file: "tokenizer.model",
        write: |n, _| repeated("\n\0", n),
        says: "a million and a half pieces",
    },
];

/// A module with so many nodes in its syntax tree.
fn nodes(n: usize) -> Vec<u8> {
    // The module, a statement and a name are three; each minus is two.
    format!("{}a{}", "-".repeat((n - 3) / 2), if n.is_multiple_of(2) { ";" } else { "" }).into_bytes()
}

/// Parts of a tokenizer have no limit of their own: 62 sequences and a document take 125 levels.
#[test]
fn parts_of_a_tokenizer_are_read_at_any_depth() {
    let mut files = base();
    let (open, close) = (r#"{"type": "Sequence", "pretokenizers": ["#, "]}");
    let part = format!("{}{{\"type\": \"Nothing\"}}{}", open.repeat(62), close.repeat(62));
    let mut value: Value = serde_json::from_slice(&files["tokenizer.json"]).unwrap();
    value["pre_tokenizer"] = Value::String("PART".to_owned());
    let text = value.to_string().replace("\"PART\"", &part);
    files.insert("tokenizer.json".to_owned(), text.into_bytes());
    let found = findings(files);
    assert!(found.iter().any(|finding| finding.contains("Nothing")), "{found:?}");
}
