//! Each limit at one less, at itself and at one more: a finding tells that one more is too much, and nothing else changes.

use std::fs;
use std::path::Path;

use serde_json::json;
use tempfile::TempDir;

use crate::support::pickle::{Pickler, StateDict, archive};
use crate::support::{knowledge, look, make_base};

/// A limit: what it is on, its value, the file with so many, and a part of the finding on one more.
struct Limit {
    of: &'static str,
    most: usize,
    file: &'static str,
    write: fn(usize, &Path) -> Vec<u8>,
    says: &'static str,
}

fn repeated(part: &str, n: usize) -> Vec<u8> {
    part.repeat(n).into_bytes()
}

/// config.json of a tiny Llama with another key.
fn config(dir: &Path, value: &str) -> Vec<u8> {
    let text = fs::read_to_string(dir.join("config.json")).unwrap();
    text.replacen('{', &format!("{{\"x\": {value},"), 1).into_bytes()
}

/// A shard with one tensor of no byte that has this name and rank.
fn shard(name: &str, rank: usize) -> Vec<u8> {
    let header = json!({ name: { "dtype": "F32", "shape": vec![0; rank], "data_offsets": [0, 0] } }).to_string();
    [&(header.len() as u64).to_le_bytes()[..], header.as_bytes()].concat()
}

/// A state dict whose tensor has so many dimensions.
fn dimensions(n: usize) -> Vec<u8> {
    let mut dict = StateDict::default();
    dict.add("weight", "F32", &vec![1; n], vec![0; 4]);
    dict.zip()
}

/// A pickle with these imports.
fn imports(imports: impl Iterator<Item = String>) -> Vec<u8> {
    let mut pickle = Pickler::new();
    pickle.op(b'(');
    for name in imports {
        pickle.import("a", &name);
    }
    pickle.op(b't');
    archive(&[("archive/data.pkl".to_owned(), pickle.stop()), ("archive/version".to_owned(), b"3\n".to_vec())])
}

const LIMITS: [Limit; 13] = [
    Limit {
        of: "bytes of a template",
        most: 60_000,
        file: "chat_template.jinja",
        write: |n, _| repeated("x", n),
        says: "it has 60001 bytes, more than 60000",
    },
    Limit {
        of: "operators of a tag",
        most: 250,
        file: "chat_template.jinja",
        // The braces of a tag are four.
        write: |n, _| format!("{{{{ x{} }}}}", "-x".repeat(n - 4)).into_bytes(),
        says: "more than 250 operators",
    },
    Limit {
        of: "sums of a template",
        most: 20,
        file: "chat_template.jinja",
        write: |n, _| repeated("{{ a + b }}", n),
        says: "sums may double a list",
    },
    Limit {
        of: "branches of a template",
        most: 300,
        file: "chat_template.jinja",
        write: |n, _| format!("{{% if a %}}{}{{% endif %}}", "{% elif b %}".repeat(n)).into_bytes(),
        says: "more than 300 branches",
    },
    Limit {
        of: "indent of tojson",
        most: 8,
        file: "chat_template.jinja",
        write: |n, _| format!("{{{{ [1]|tojson({n}) }}}}").into_bytes(),
        says: "tojson indents by 9 spaces",
    },
    Limit {
        of: "nesting of a template",
        most: 16,
        file: "chat_template.jinja",
        write: |n, _| repeated("{% set a = [a] %}", n),
        says: "nested in themselves",
    },
    Limit {
        of: "nesting of JSON",
        most: 127,
        file: "config.json",
        write: |n, dir| config(dir, &format!("{}{}", "[".repeat(n - 1), "]".repeat(n - 1))),
        says: "deep",
    },
    Limit {
        of: "bytes of JSON",
        most: 64 << 20,
        file: "special_tokens_map.json",
        write: |n, _| [b"{}".to_vec(), vec![b' '; n - 2]].concat(),
        says: "more than the 67.1 MB allowed",
    },
    Limit {
        of: "bytes of a module",
        most: 4 << 20,
        file: "modeling_x.py",
        write: |n, _| repeated("#", n),
        says: "more than the 4.19 MB allowed",
    },
    Limit {
        of: "dimensions in a header",
        most: 1024,
        file: "extra.safetensors",
        write: |n, _| shard("x", n),
        says: "extra.safetensors",
    },
    Limit {
        of: "bytes of a usual name in a header",
        most: 1 << 10,
        file: "extra.safetensors",
        write: |n, _| shard(&"x".repeat(n), 1),
        says: "longer than 1 KiB",
    },
    Limit {
        of: "dimensions in a pickle",
        most: 64,
        file: "pytorch_model.bin",
        write: |n, _| dimensions(n),
        says: "dimensions",
    },
    Limit {
        of: "bytes of an imported name",
        most: 256,
        file: "optimizer.pt",
        write: |n, _| imports(std::iter::once("x".repeat(n))),
        says: "names",
    },
];

/// Findings as `code message`, without figures that count.
fn findings(limit: &Limit, n: usize) -> Vec<String> {
    let room = TempDir::new().unwrap();
    let dir = room.path().join("model");
    make_base("llama", &dir);
    let bytes = (limit.write)(n, &dir);
    fs::write(dir.join(limit.file), bytes).unwrap();
    let outcome = look(&dir, false, &knowledge());
    outcome.findings.iter().map(|finding| format!("{} {}", finding.code, finding.message)).collect()
}

#[test]
fn one_more_than_a_limit_is_told() {
    let mut wrong = Vec::new();
    for limit in &LIMITS {
        let [less, most, more] = [limit.most - 1, limit.most, limit.most + 1].map(|n| findings(limit, n));
        let is_told = |found: &[String]| found.iter().any(|finding| finding.contains(limit.says));
        if is_told(&less) || is_told(&most) || !is_told(&more) {
            wrong.push(format!("{}:\n  {less:?}\n  {most:?}\n  {more:?}", limit.of));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
