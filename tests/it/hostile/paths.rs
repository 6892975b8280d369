//! Rows P: the index, and all strings used as paths.

use super::place::{Dir, INDEX, SHARD, entry, file, header, numbered};
use super::run::large;
use super::{Case, case, clean};

/// The two members of a sound `weight_map`.
const SOUND: &str = r#""a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors""#;

pub fn cases() -> Vec<Case> {
    [strings(), links(), shards(), sizes(), doubles(), many()].into_iter().flatten().collect()
}

/// P1: values of `weight_map` that are not plain names. Existing targets are watched.
fn strings() -> Vec<Case> {
    let to = |name: &str, path: &str| {
        let members = format!(r#"{SOUND}, "c": "{path}""#);
        case("P1", name, "IDX003", "/weight_map/c", move |d| d.map(&members))
    };
    let mut cases = vec![
        to("one up", "../evil.safetensors"),
        to("down and up", "x/../../evil.safetensors"),
        to("dot", "./model-00001-of-00002.safetensors"),
        to("a folder", "sub/model.safetensors"),
        to("absolute", "/etc/passwd"),
        to("two slashes", "//etc/passwd"),
        to("/dev/zero", "/dev/zero"),
        to("/proc/self/environ", "/proc/self/environ"),
        to("backslash", r"..\\evil.safetensors"),
        to("drive", "C:evil.safetensors"),
        to("UNC", r"\\\\host\\share\\x"),
        to("stream", "model.safetensors:x"),
        to("URL", "https://example.org/x.safetensors"),
        to("NUL", r"evil.safetensors\u0000.txt"),
        to("line break", r"a\nb.safetensors"),
        to("empty", ""),
        to("itself", "."),
        to("parent", ".."),
        to("5000 characters", &format!("{}.safetensors", "x".repeat(5000))),
        to("escape codes", r"\u001b[2J/x"),
        to("home", "~/../evil.safetensors/"),
    ];
    cases.push(case("P1", "absolute, to a file that is there", "IDX003", "/weight_map/c", |d| {
        d.map(&format!(r#"{SOUND}, "c": "{}""#, d.outer.join("evil.safetensors").display()));
    }));
    cases.push(case("P1", "a number", "IDX001", "/weight_map/c", |d| d.map(&format!(r#"{SOUND}, "c": 7"#))));
    cases.push(case("P1", "a name that expands", "IDX005", "c", |d| d.map(&format!(r#"{SOUND}, "c": "$(touch x)*""#))));
    cases
}

/// P2: symbolic links.
fn links() -> Vec<Case> {
    let leads = |name: &str, code, target: &'static str| {
        case("P2", name, code, SHARD, move |d| {
            d.small();
            d.link(SHARD, target);
        })
    };
    vec![
        case("P2", "out of the directory", "FIL006", SHARD, |d| {
            d.small();
            std::fs::create_dir(d.outer.join("elsewhere")).unwrap();
            std::fs::rename(d.root.join(SHARD), d.outer.join("elsewhere").join(SHARD)).unwrap();
            d.link(SHARD, "../elsewhere/model.safetensors");
        }),
        leads("to nothing", "FIL002", "nowhere"),
        leads("to itself", "FIL002", SHARD),
        leads("to /dev/zero", "FIL001", "/dev/zero"),
        leads("to /dev/tty", "FIL001", "/dev/tty"),
        leads("to a directory", "FIL001", "."),
        case("P2", "config to /dev/zero", "FIL001", "config.json", |d| {
            d.small();
            d.link("config.json", "/dev/zero");
        }),
        case("P2", "config to a file without end", "FIL014", "config.json", |d| {
            d.small();
            d.link("config.json", "/proc/self/status");
        }),
        case("P2", "module to /dev/urandom", "FIL001", "modeling_x.py", |d| {
            d.small();
            d.link("modeling_x.py", "/dev/urandom");
        }),
        clean("P2", "hub cache", hub_cache),
    ]
}

/// A snapshot of the hub cache, which consists of links to blobs.
pub fn hub_cache(d: &Dir) {
    d.small();
    let blobs = d.root.join("../blobs");
    std::fs::create_dir(&blobs).unwrap();
    std::fs::create_dir(d.root.join("../snapshots")).unwrap();
    for (number, name) in ["config.json", SHARD].into_iter().enumerate() {
        let blob = format!("{number:040x}");
        std::fs::rename(d.root.join(name), blobs.join(&blob)).unwrap();
        d.link(name, format!("../blobs/{blob}"));
    }
}

/// P3, P4, P5, P8: missing and additional shards.
fn shards() -> Vec<Case> {
    let map = |row, name: &str, code, at, members: &'static str| case(row, name, code, at, move |d| d.map(members));
    let one = || file(header(&entry("a", "U8", "[4]", 0, 4)), 4);
    vec![
        case("P3", "a shard missing", "IDX005", "model-00002-of-00002.safetensors", |d| {
            d.map(SOUND);
            d.remove(&numbered(2));
        }),
        case("P3", "no index", "IDX016", "", |d| {
            d.map(SOUND);
            d.remove(INDEX);
        }),
        case("P3", "two of three, no index", "IDX016", "", move |d| {
            d.small();
            d.remove(SHARD);
            d.put("model-00001-of-00003.safetensors", one());
            d.put("model-00003-of-00003.safetensors", file(header(&entry("c", "U8", "[4]", 0, 4)), 4));
        }),
        map(
            "P4",
            "mapped to the other shard",
            "IDX008",
            "a",
            r#""a": "model-00002-of-00002.safetensors", "b": "model-00002-of-00002.safetensors""#,
        ),
        map(
            "P4",
            "a tensor that is nowhere",
            "IDX009",
            "c",
            r#""a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors", "c": "model-00002-of-00002.safetensors""#,
        ),
        case("P4", "a tensor that is not named", "IDX010", "c", |d| {
            d.map(SOUND);
            let both = [entry("b", "U8", "[4]", 0, 4), entry("c", "U8", "[4]", 4, 8)].join(",");
            d.put(&numbered(2), file(header(&both), 8));
        }),
        case("P4", "a tensor in two shards", "IDX011", "a", |d| {
            d.map(SOUND);
            let both = [entry("b", "U8", "[4]", 0, 4), entry("a", "U8", "[4]", 4, 8)].join(",");
            d.put(&numbered(2), file(header(&both), 8));
        }),
        case("P5", "a shard of an older save", "IDX012", "model-00003-of-00003.safetensors", move |d| {
            d.map(SOUND);
            d.put("model-00003-of-00003.safetensors", one());
        }),
        case("P5", "a single file beside the index", "IDX013", SHARD, move |d| {
            d.map(SOUND);
            d.put(SHARD, one());
        }),
        case("P8", "case differs", "IDX007", "model-00002-of-00002.safetensors", |d| {
            d.map(SOUND);
            std::fs::rename(d.root.join(numbered(2)), d.root.join("Model-00002-of-00002.safetensors")).unwrap();
        }),
        case("P8", "normalisation differs", "IDX007", "mode\u{301}l.safetensors", |d| {
            d.map(r#""a": "model-00001-of-00002.safetensors", "b": "mod\u00e9l.safetensors""#);
            std::fs::rename(d.root.join(numbered(2)), d.root.join("mode\u{301}l.safetensors")).unwrap();
        }),
    ]
}

/// P6: `total_size`.
fn sizes() -> Vec<Case> {
    let is = |name: &str, codes, value: String| {
        case("P6", name, codes, "/metadata/total_size", move |d| {
            d.index(format!(r#"{{"metadata": {{"total_size": {value}}}, "weight_map": {{{SOUND}}}}}"#));
        })
    };
    vec![
        is("wrong", "IDX014", "9".to_owned()),
        is("a string", "IDX015", "\"8\"".to_owned()),
        is("NaN", "IDX015", "NaN".to_owned()),
        is("10^40", "IDX015", format!("1{}", "0".repeat(40))),
        is("10^400", "IDX015", "1e400".to_owned()),
        is("2^64", "IDX015", "18446744073709551616".to_owned()),
        is("2^63 as a float", "IDX015", "9223372036854775808.0".to_owned()),
        is("negative", "IDX015", "-8".to_owned()),
        is("a fraction", "IDX015", "8.5".to_owned()),
        is("null", "IDX015", "null".to_owned()),
        is("a list", "IDX015", "[8]".to_owned()),
        is("a million digits", "IDX015", "7".repeat(1_000_000)),
        clean("P6", "an equal float", |d| {
            d.index(format!(r#"{{"metadata": {{"total_size": 8.0}}, "weight_map": {{{SOUND}}}}}"#));
        }),
    ]
}

/// P7: duplicate keys, and an invalid index.
fn doubles() -> Vec<Case> {
    let is = |name: &str, code, text: String| case("P7", name, code, INDEX, move |d| d.index(&text));
    let meta = r#""metadata": {"total_size": 8}"#;
    vec![
        is("a tensor twice", "IDX004", format!(r#"{{{meta}, "weight_map": {{{SOUND}, "a": "x.safetensors"}}}}"#)),
        is("twice by escape", "IDX004", format!(r#"{{{meta}, "weight_map": {{{SOUND}, "\u0061": "x.safetensors"}}}}"#)),
        is("two weight_maps", "IDX004", format!(r#"{{{meta}, "weight_map": {{}}, "weight_map": {{{SOUND}}}}}"#)),
        is("metadata twice", "IDX004", format!(r#"{{{meta}, {meta}, "weight_map": {{{SOUND}}}}}"#)),
        is("no weight_map", "IDX001", format!("{{{meta}}}")),
        is("weight_map a list", "IDX001", format!(r#"{{{meta}, "weight_map": []}}"#)),
        is("weight_map null", "IDX001", format!(r#"{{{meta}, "weight_map": null}}"#)),
        is("no metadata", "IDX002", format!(r#"{{"weight_map": {{{SOUND}}}}}"#)),
        is("a list", "JSN012", "[]".to_owned()),
        is("cut off", "JSN016", format!(r#"{{{meta}, "weight_map": {{"a""#)),
    ]
}

/// P9: a hundred thousand findings.
fn many() -> Vec<Case> {
    let members = |value: fn(usize) -> String| {
        let members = (0..large(100_000)).map(|i| format!(r#""t{i}": "{}""#, value(i)));
        members.collect::<Vec<_>>().join(", ")
    };
    let of = |name: &str, code, value: fn(usize) -> String| {
        case("P9", name, code, "", move |d| d.map(&format!("{SOUND}, {}", members(value))))
    };
    vec![
        of("unsafe paths", "IDX003", |i| format!("../{i}.safetensors")),
        of("missing shards", "IDX005", |i| format!("model-{i}.safetensors")),
        of("tensors that are nowhere", "IDX009", |_| numbered(1)),
        case("P9", "keys twice", "IDX004", INDEX, move |d| {
            d.map(&[members(|_| numbered(1)), members(|_| numbered(2))].join(", "));
        }),
        case("P9", "empty shards", "SAF003", "", |d| {
            d.small();
            for number in 0..1000 {
                d.put(&format!("model-{number:05}.safetensors"), "");
            }
        }),
    ]
}
