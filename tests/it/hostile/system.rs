//! Rows F: entries that are not files, unusual names, and loops.

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::net::UnixListener;

use super::place::{Dir, INDEX, SHARD, entry, file, header};
use super::run::large;
use super::{Case, bounded, case, clean};

pub fn cases() -> Vec<Case> {
    [irregular(), names(), loops()].into_iter().flatten().collect()
}

/// F1: entries that would block a reader or never end.
fn irregular() -> Vec<Case> {
    let files = [
        "config.json",
        "generation_config.json",
        "tokenizer.json",
        "tokenizer_config.json",
        "special_tokens_map.json",
        "tokenizer.model",
        "vocab.txt",
        "vocab.json",
        "modeling_x.py",
        SHARD,
        INDEX,
    ];
    let mut cases = Vec::new();
    let mut add = |what: &str, name: &'static str, make: fn(&Dir, &str)| {
        cases.push(case("F1", format!("{what} {name}"), "FIL001", name, move |d| {
            d.llama();
            make(d, name);
        }));
    };
    for name in files {
        add("FIFO", name, Dir::fifo);
    }
    for name in ["config.json", "tokenizer.json", SHARD] {
        add("socket", name, |d, name| {
            let _ = std::fs::remove_file(d.root.join(name));
            // An absolute path would exceed the limit of a socket's address, so the name is relative to the directory.
            let listener = UnixListener::bind(d.root.join("s")).unwrap();
            std::fs::rename(d.root.join("s"), d.root.join(name)).unwrap();
            drop(listener);
        });
        add("directory", name, Dir::folder);
        add("link to a device", name, |d, name| d.link(name, "/dev/zero"));
        add("link to a FIFO", name, |d, name| {
            d.fifo("pipe");
            d.link(name, "pipe");
        });
    }
    let device = |d: &Dir, name: &str| d.link(name, "/dev/zero");
    for (what, make) in [("FIFO", Dir::fifo as fn(&Dir, &str)), ("link to a device", device)] {
        cases.push(bounded("F1", format!("{what} as a shard of the base model of an adapter"), move |d| {
            d.put("adapter_config.json", r#"{"peft_type": "LORA", "base_model_name_or_path": "./base", "r": 4}"#);
            d.folder("base");
            d.put("base/config.json", "{}");
            make(d, "base/model.safetensors");
            let name = "base_model.model.h.lora_A.weight";
            d.put("adapter_model.safetensors", file(header(&entry(name, "F32", "[4,8]", 0, 128)), 128));
        }));
    }
    cases
}

/// F4: names of files.
fn names() -> Vec<Case> {
    let shard = || file(header(&entry("b", "U8", "[1]", 0, 1)), 1);
    let named = |name: &'static str| {
        bounded("F4", name.escape_default().to_string(), move |d: &Dir| {
            d.small();
            d.put(name, shard());
        })
    };
    vec![
        named("line\nbreak.safetensors"),
        named("\u{1b}[2J\u{1b}]0;x\u{7}.safetensors"),
        named("gnp.\u{202e}srosnetefas.safetensors"),
        named("zero\u{200b}width.safetensors"),
        named("-rf.safetensors"),
        named("$(touch pwned).safetensors"),
        named("a`id`;id|id.safetensors"),
        named("*.safetensors"),
        named(".safetensors"),
        named("a\\b.safetensors"),
        named("C:x.safetensors"),
        named("config.json "),
        named("::error::x.safetensors"),
        bounded("F4", "255 bytes", move |d| {
            d.small();
            d.put(&format!("{}.safetensors", "x".repeat(243)), shard());
        }),
        bounded("F4", "not UTF-8", move |d| {
            d.small();
            std::fs::write(d.root.join(OsStr::from_bytes(b"\xff\xfe.safetensors")), shard()).unwrap();
        }),
        bounded("F4", "twenty thousand files", |d| {
            d.small();
            for i in 0..large(20_000) {
                d.put(&format!("{i}.txt"), "");
            }
        }),
        bounded("F4", "a document with escape codes in its name", |d| {
            d.small();
            d.put("\u{1b}[31mconfig.json", "{,}");
        }),
    ]
}

/// F5, F13: link loops, and a directory without write permission.
fn loops() -> Vec<Case> {
    vec![
        case("F5", "a shard that is itself", "FIL002", SHARD, |d| {
            d.small();
            d.link(SHARD, SHARD);
        }),
        case("F5", "two links that are each other", "FIL002", "config.json", |d| {
            d.small();
            d.link("config.json", "other.json");
            d.link("other.json", "config.json");
        }),
        case("F5", "a chain of fifty links", "FIL002", SHARD, |d| {
            d.small();
            std::fs::rename(d.root.join(SHARD), d.root.join("link0")).unwrap();
            for i in 0..50 {
                d.link(&format!("link{}", i + 1), format!("link{i}"));
            }
            d.link(SHARD, "link50");
        }),
        clean("F5", "the directory in itself", |d| {
            d.small();
            d.link("again", ".");
            d.link("up", "..");
        }),
        clean("F13", "a directory that is read-only", |d| {
            use std::os::unix::fs::PermissionsExt as _;
            d.small();
            std::fs::set_permissions(&d.root, std::fs::Permissions::from_mode(0o555)).unwrap();
        }),
    ]
}
