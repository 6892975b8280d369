//! Rows J1 to J6 and J8: documents as text.

use super::place::{Dir, INDEX, nested};
use super::run::large;
use super::{Case, bounded, case, clean};

const CONFIG: &str = "config.json";

pub fn cases() -> Vec<Case> {
    [depth(), ignored(), numbers(), encodings(), doubles(), slips(), size()].into_iter().flatten().collect()
}

fn config(
    row: &'static str,
    name: impl Into<String>,
    codes: &'static str,
    at: &'static str,
    text: impl Into<Vec<u8>>,
) -> Case {
    let text = text.into();
    case(row, name, codes, at, move |d| d.config(&text))
}

/// J1: nesting.
fn depth() -> Vec<Case> {
    let deep = |name: &str, text: String| config("J1", name, "JSN009", CONFIG, text);
    let other = |file: &'static str| {
        case("J1", file, "JSN009", file, move |d: &Dir| {
            d.llama();
            d.put(file, nested("[", "]", 100_000));
        })
    };
    vec![
        deep("128 arrays", nested("[", "]", 128)),
        deep("40 000 arrays", nested("[", "]", 40_000)),
        deep("100 000 arrays", nested("[", "]", 100_000)),
        deep("100 000 objects", nested("{\"a\":", "}", 100_000)),
        deep("both in turn", nested("[{\"a\":", "}]", 50_000)),
        deep("ten million brackets", "[".repeat(10_000_000)),
        deep("never closed", format!("{{\"a\":{}", "[".repeat(100_000))),
        other("tokenizer.json"),
        other("tokenizer_config.json"),
        other("generation_config.json"),
        other("special_tokens_map.json"),
        case("J1", "index", "JSN009", INDEX, |d| d.index(nested("{\"weight_map\":", "}", 100_000))),
        case("J1", "adapter", "JSN009", "adapter_config.json", |d| {
            d.small();
            d.put("adapter_config.json", nested("[", "]", 100_000));
        }),
        clean("J1", "127 levels", |d| {
            d.config(format!(
                r#"{{"model_type": "llama", "architectures": ["Unheard"], "a": {}}}"#,
                nested("[", "]", 126)
            ));
        }),
    ]
}

/// J2: nesting under a key that no reader uses.
fn ignored() -> Vec<Case> {
    let under = |name: &str, file: &'static str, depth| {
        case("J2", name, "JSN009", file, move |d| {
            d.llama();
            d.put(file, format!(r#"{{"nobody_reads_this": {}}}"#, nested("[", "]", depth)));
        })
    };
    vec![
        under("of config.json", CONFIG, 200),
        under("of generation_config.json", "generation_config.json", 5000),
        under("of tokenizer.json", "tokenizer.json", 100_000),
        case("J2", "of the index", "JSN009", INDEX, |d| {
            d.index(format!(r#"{{"metadata": {{}}, "weight_map": {{}}, "x": {}}}"#, nested("{\"a\":", "}", 1000)));
        }),
    ]
}

/// J3, J6: numbers.
fn numbers() -> Vec<Case> {
    let of = |row, name: &str, codes, literal: &str| {
        config(
            row,
            name,
            codes,
            CONFIG,
            format!(r#"{{"architectures": ["Unheard"], "model_type": "llama", "x": {literal}}}"#),
        )
    };
    vec![
        of("J3", "NaN", "JSN001", "NaN"),
        of("J3", "Infinity", "JSN001", "Infinity"),
        of("J3", "-Infinity", "JSN001", "[1, -Infinity]"),
        of("J3", "five thousand of them", "JSN001", &format!("[{}NaN]", "NaN,".repeat(5000))),
        of("J3", "nan", "JSN016", "nan"),
        of("J3", "+Infinity", "JSN016", "+Infinity"),
        of("J6", "10^400 in digits", "JSN010", &format!("1{}", "0".repeat(400))),
        of("J6", "1e400", "JSN010", "1e400"),
        of("J6", "-1e400", "JSN010", "-1e400"),
        of("J6", "4301 digits", "JSN010", &"7".repeat(4301)),
        of("J6", "a million digits", "JSN010", &"7".repeat(1_000_000)),
        of("J6", "a million digits after the point", "JSN010", &format!("0.{}", "7".repeat(1_000_000))),
        of("J6", "an exponent of a million digits", "JSN010", &format!("1e{}", "9".repeat(1_000_000))),
        of("J6", "leading zero", "JSN016", "007"),
        of("J6", "hexadecimal", "JSN016", "0xff"),
        clean("J6", "1e-400", |d| d.config(r#"{"architectures": ["Unheard"], "model_type": "llama", "x": 1e-400}"#)),
        clean("J6", "31 digits", |d| {
            d.config(r#"{"architectures": ["Unheard"], "model_type": "llama", "x": 1000000000000000019884624838656}"#);
        }),
    ]
}

/// J4: encodings.
fn encodings() -> Vec<Case> {
    let text = r#"{"architectures": ["Unheard"], "model_type": "llama"}"#;
    let utf16 = |little: bool| -> Vec<u8> {
        text.encode_utf16().flat_map(|u| if little { u.to_le_bytes() } else { u.to_be_bytes() }).collect()
    };
    let utf32 = |little: bool| -> Vec<u8> {
        text.chars().map(u32::from).flat_map(|u| if little { u.to_le_bytes() } else { u.to_be_bytes() }).collect()
    };
    let is = |name: &str, code, bytes: Vec<u8>| config("J4", name, code, CONFIG, bytes);
    vec![
        is("UTF-8 with a mark", "JSN007", [b"\xef\xbb\xbf", text.as_bytes()].concat()),
        is("UTF-16LE with a mark", "JSN008", [vec![0xff, 0xfe], utf16(true)].concat()),
        is("UTF-16BE with a mark", "JSN008", [vec![0xfe, 0xff], utf16(false)].concat()),
        is("UTF-16LE", "JSN008", utf16(true)),
        is("UTF-16BE", "JSN008", utf16(false)),
        is("UTF-32LE", "JSN008", utf32(true)),
        is("UTF-32BE with a mark", "JSN008", [vec![0, 0, 0xfe, 0xff], utf32(false)].concat()),
        is("Latin-1", "JSN008", b"{\"model_type\": \"caf\xe9\"}".to_vec()),
        is("overlong", "JSN008", b"{\"model_type\": \"\xc0\xae\"}".to_vec()),
        is("half of a UTF-16 unit", "JSN008", [vec![0xff, 0xfe], utf16(true), vec![0x7b]].concat()),
        is("NUL bytes after it", "JSN008", [text.as_bytes(), &[0; 100]].concat()),
        is("a NUL byte inside", "JSN016", b"{\"model_type\": \"a\0b\"}".to_vec()),
        is("nothing but NULs", "JSN008", vec![0; 4096]),
        is("empty", "JSN011", Vec::new()),
        is("blank", "JSN011", b" \n\t\n".to_vec()),
        is("half a surrogate", "JSN017", br#"{"model_type": "unheard", "x": "\ud83d"}"#.to_vec()),
        is("escape codes", "JSN016", b"{\"model_type\": \"\x1b[31m\"}".to_vec()),
        config(
            "J4",
            "escape codes in values",
            "ARC001",
            CONFIG,
            r#"{"architectures": ["\u001b[2J\u202e"], "model_type": "\u001b]0;x\u0007"}"#,
        ),
    ]
}

/// J5: duplicate keys.
fn doubles() -> Vec<Case> {
    let is = |name: &str, at, text: &str| config("J5", name, "JSN002", at, text);
    vec![
        is("of the object", "/model_type", r#"{"model_type": "a", "x": 1, "model_type": "b"}"#),
        is("by escape", "/model_type", r#"{"model_type": "a", "\u006dodel_type": "b"}"#),
        is("nested", "/a/0/b", r#"{"model_type": "a", "a": [{"b": 1, "b": 2}]}"#),
        is("with equal values", "/x", r#"{"model_type": "a", "x": [1], "x": [1]}"#),
        is("empty keys", "", r#"{"model_type": "a", "": 1, "": 2}"#),
        config("J5", "a hundred thousand", "JSN002", CONFIG, format!("{{{}\"x\":0}}", "\"x\":0,".repeat(100_000))),
        config("J5", "around ever larger values", "JSN002", CONFIG, {
            let body: Vec<_> = (0..2000).map(|i| format!("\"x\":\"{}\"", "y".repeat(i))).collect();
            format!("{{{}}}", body.join(","))
        }),
    ]
}

/// Slips of hand-written JSON, and markers of a merge.
fn slips() -> Vec<Case> {
    let is = |name: &str, code, text: &str| config("J3", name, code, CONFIG, text);
    vec![
        is("comma at the end", "JSN003", r#"{"model_type": "a",}"#),
        is("comma missing", "JSN004", "{\"model_type\": \"a\"\n \"x\": 1}"),
        is("comment", "JSN005", "{\"model_type\": \"a\" // b\n}"),
        is("comment that never ends", "JSN016", "{\"model_type\": \"a\" /* b"),
        is("single quotes", "JSN006", "{'model_type': 'a'}"),
        is("two values", "JSN013", "{\"model_type\": \"a\"}\n{}"),
        is("merge conflict", "JSN014", "{\n<<<<<<< HEAD\n\"a\": 1\n=======\n\"a\": 2\n>>>>>>> b\n}\n"),
        is("cut off", "JSN016", "{\"model_type\": \"a\", \"x\": {\"y"),
        is("string that never ends", "JSN016", &format!("{{\"a\": \"{}", "x".repeat(1_000_000))),
        is("a hundred thousand slips", "JSN004", &format!("{{\"a\": [{}1]}}", "1 ".repeat(100_000))),
        is("a hundred thousand comments", "JSN005", &format!("{{{}}}", "/**/".repeat(100_000))),
    ]
}

/// J8: documents that do not fit into memory.
fn size() -> Vec<Case> {
    let sparse = |name: &'static str| {
        case("J8", format!("6 GiB {name}"), "FIL003", name, move |d| {
            d.llama();
            d.sparse(name, 6 << 30);
        })
    };
    let cap = 64 << 20;
    vec![
        sparse(CONFIG),
        sparse("generation_config.json"),
        sparse("tokenizer_config.json"),
        sparse("tokenizer.json"),
        sparse("tokenizer.model"),
        sparse("vocab.json"),
        sparse("vocab.txt"),
        sparse("modeling_x.py"),
        sparse(INDEX),
        case("J8", "64 MiB of NULs", "JSN008", CONFIG, move |d| {
            d.small();
            d.sparse(CONFIG, cap);
        }),
        case("J8", "500 MiB tokenizer.json of NULs", "FIL003", "tokenizer.json", |d| {
            d.small();
            d.sparse("tokenizer.json", 500 << 20);
        }),
        case("J8", "500 MiB vocab.txt of NULs", "FIL003", "vocab.txt", |d| {
            d.small();
            d.sparse("vocab.txt", 500 << 20);
        }),
        config("J8", "two million zeros", "JSN018", CONFIG, format!("{{\"a\":[{}0]}}", "0,".repeat(2_100_000))),
        config(
            "J8",
            "a million objects",
            "JSN018",
            CONFIG,
            format!("{{\"model_type\":\"a\",\"x\":[{}{{}}]}}", "{\"a\":0},".repeat(900_000)),
        ),
        config("J8", "a million keys", "JSN018", CONFIG, {
            let keys: Vec<_> = (0..1_000_000).map(|i| format!("\"k{i}\":0")).collect();
            format!("{{{}}}", keys.join(","))
        }),
        case("J8", "a string of 60 MB", "JSN018", CONFIG, |d| {
            d.config(format!("{{\"model_type\":\"{}\"}}", "x".repeat(60_000_000)));
        }),
        bounded("J8", "a hundred thousand values", |d| {
            d.config(format!("{{\"model_type\":\"x\",\"x\":[{}0]}}", "0,".repeat(99_000)));
        }),
        bounded("J8", "fifty thousand objects", |d| {
            d.config(format!("{{\"model_type\":\"x\",\"x\":[{}0]}}", "{\"a\":0},".repeat(49_000)));
        }),
        bounded("J8", "a string of 9 MB", |d| d.config(format!("{{\"model_type\":\"{}\"}}", "x".repeat(9_000_000)))),
        case("J8", "a vocabulary of two million tokens", "TOK008", "tokenizer.json", |d| {
            d.llama();
            let tokens: Vec<_> = (0..2_000_000).map(|i| format!("\"{i}\":{i}")).collect();
            d.put("tokenizer.json", format!("{{\"model\":{{\"vocab\":{{{}}}}}}}", tokens.join(",")));
        }),
        case("J8", "thirty million empty words", "TOK008", "vocab.txt", |d| {
            d.llama();
            d.put("vocab.txt", "\n".repeat(30_000_000));
        }),
        bounded("J8", "60 MB of spaces", |d| {
            d.config(format!("{{{}\"model_type\":\"x\"}}", " ".repeat(large(60_000_000))));
        }),
    ]
}
