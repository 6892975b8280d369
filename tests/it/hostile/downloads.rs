//! Rows D: failed downloads, and files of another format.

use super::place::{INDEX, SHARD, entry, file, header};
use super::{Case, bounded, case};

/// A pointer that git-lfs leaves without downloading the content.
const POINTER: &str = "version https://git-lfs.github.com/spec/v1\noid sha256:\
    4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 4976698672\n";

pub fn cases() -> Vec<Case> {
    [pointers(), unfinished(), others(), pickles()].into_iter().flatten().collect()
}

/// D1: git-lfs pointers.
fn pointers() -> Vec<Case> {
    let weights = |name: &str, text: String| case("D1", name, "LFS001", SHARD, move |d| d.shard(&text));
    let document = |name: &'static str| {
        case("D1", name, "LFS002", name, move |d| {
            d.llama();
            d.put(name, POINTER);
        })
    };
    vec![
        weights("weights", POINTER.to_owned()),
        weights("CRLF", POINTER.replace('\n', "\r\n")),
        weights("hawser", POINTER.replace("git-lfs.github", "hawser.github")),
        weights("extension lines", POINTER.replace("oid", "ext-0-foo sha256:ab\noid")),
        weights("no last line break", POINTER.trim_end().to_owned()),
        document("config.json"),
        document("tokenizer.json"),
        document("tokenizer_config.json"),
        document("tokenizer.model"),
        document("generation_config.json"),
        document("modeling_x.py"),
        case("D1", "the index", "LFS002", INDEX, |d| d.index(POINTER)),
        case("D1", "every shard", "LFS001", "", |d| {
            d.index(r#"{"metadata": {}, "weight_map": {"a": "model-00001-of-00002.safetensors"}}"#);
            d.put("model-00001-of-00002.safetensors", POINTER);
            d.put("model-00002-of-00002.safetensors", POINTER);
        }),
    ]
}

/// D2, D3: unfinished downloads.
fn unfinished() -> Vec<Case> {
    let beside = |name: &'static str| {
        case("D2", name, "FIL005", name, move |d| {
            d.small();
            d.put(name, "partial");
        })
    };
    vec![
        beside("model.safetensors.incomplete"),
        beside("model.safetensors.aria2"),
        beside("model.safetensors.part"),
        beside("model.safetensors.crdownload"),
        case("D2", "the shard itself is missing", "FIL005 IDX005", "", |d| {
            d.map(r#""a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors""#);
            d.remove("model-00002-of-00002.safetensors");
            d.put("model-00002-of-00002.safetensors.incomplete", "partial");
        }),
        case("D3", "the end was never written", "SAF022", "b", |d| {
            let size = 1 << 20;
            let tensor = |name: &str, at: u64| entry(name, "U8", "[512,1024]", at, at + size / 2);
            let entries = [entry("a", "U8", "[1024,1024]", 0, size), tensor("b", size), tensor("c", size + size / 2)];
            let header = file(header(&entries.join(",")), 1 << 20);
            let whole = header.len() + (1 << 20);
            d.shard(header);
            let shard = std::fs::File::options().write(true).open(d.root.join(SHARD)).unwrap();
            shard.set_len(u64::try_from(whole).unwrap()).unwrap();
        }),
        case("D3", "nothing but the header was written", "SAF022", "b", |d| {
            let tensor = |name: &str, at: u64| entry(name, "U8", "[1024,2048]", at, at + (2 << 20));
            let header = file(header(&[tensor("a", 0), tensor("b", 2 << 20)].join(",")), 0);
            let whole = header.len() + (4 << 20);
            d.shard(header);
            let shard = std::fs::File::options().write(true).open(d.root.join(SHARD)).unwrap();
            shard.set_len(u64::try_from(whole).unwrap()).unwrap();
        }),
    ]
}

/// D4: other formats under the name of a shard or a document.
fn others() -> Vec<Case> {
    let files: [(&str, &[u8]); 14] = [
        ("web page", b"<!DOCTYPE html>\n<html><head><title>Sign in</title></head></html>"),
        ("web page after a blank line", b"\n\n<html lang=en>"),
        ("XML error", b"<?xml version=\"1.0\"?><Error><Code>AccessDenied</Code></Error>"),
        ("JSON error", br#"{"error":"Repository not found"}"#),
        ("plain text", b"Invalid username or password."),
        ("gzip", b"\x1f\x8b\x08\0\0\0\0\0\0\x03abcdefgh"),
        ("zip", b"PK\x03\x04\x14\0\0\0\0\0\0\0"),
        ("pickle", b"\x80\x04\x95\x10\0\0\0\0\0\0\0cos\nsystem\n"),
        ("GGUF", b"GGUF\x03\0\0\0\x01\0\0\0\0\0\0\0"),
        ("HDF5", b"\x89HDF\r\n\x1a\n\0\0\0\0\0\0\0\0"),
        ("NumPy", b"\x93NUMPY\x01\0\x76\0{'descr'"),
        ("ELF", b"\x7fELF\x02\x01\x01\0\0\0\0\0\0\0\0\0"),
        ("Zstandard", b"\x28\xb5\x2f\xfd\x04\x58\0\0\0\0\0\0"),
        ("nothing but NULs", &[0; 4096]),
    ];
    let shard =
        |(name, bytes): (&'static str, &'static [u8])| case("D4", name, "SAF002", SHARD, move |d| d.shard(bytes));
    let mut cases: Vec<_> =
        files.into_iter().map(|(name, bytes)| shard((name, Box::leak(bytes.to_vec().into_boxed_slice())))).collect();
    for (name, bytes) in [
        ("web page for a config", &b"<!DOCTYPE html><html>"[..]),
        ("gzip for a config", b"\x1f\x8b\x08\0\0\0"),
        ("pickle for a config", b"\x80\x04K\x01."),
    ] {
        cases.push(case("D4", name, "JSN015", "config.json", move |d| d.config(bytes)));
    }
    cases.push(case("D4", "text for a config", "JSN016", "config.json", |d| d.config("Entry not found")));
    cases.push(case("D4", "a string for a config", "JSN012", "config.json", |d| d.config("\"Entry not found\"")));
    cases
}

/// D6: pickles, which are never opened.
fn pickles() -> Vec<Case> {
    const EVIL: &[u8] = b"\x80\x04cposix\nsystem\n(S'touch ../pwned'\ntR.";
    vec![
        case("D6", "instead of safetensors", "PKL004", "pytorch_model.bin", |d| {
            d.small();
            d.remove(SHARD);
            d.put("pytorch_model.bin", EVIL);
        }),
        bounded("D6", "beside safetensors", |d| {
            d.small();
            d.put("pytorch_model.bin", EVIL);
            d.put("training_args.bin", EVIL);
            d.put("optimizer.pt", EVIL);
        }),
        case("D6", "an index of pickles", "PKL004", "pytorch_model", |d| {
            d.small();
            d.remove(SHARD);
            d.put("pytorch_model-00001-of-00001.bin", EVIL);
            let index = r#"{"metadata": {"total_size": 8}, "weight_map": {"a": "pytorch_model-00001-of-00001.bin"}}"#;
            d.put("pytorch_model.bin.index.json", index);
        }),
    ]
}
