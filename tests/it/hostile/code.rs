//! Rows X: code from the model.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::run::large;
use super::{Case, bounded, case};

const MODULE: &str = "modeling_x.py";
/// Everything that a module can do during import.
const PAYLOAD: &str = "import os, subprocess, urllib.request\nopen('../pwned', 'w').write('x')\nos.system('touch ../pwned')\n\
    subprocess.run(['sh', '-c', 'touch ../pwned'])\nclass XModel:\n    def __init_subclass__(cls):\n        exec('1')\n";

pub fn cases() -> Vec<Case> {
    [payloads(), switches(), auto_maps(), exhausting()].into_iter().flatten().collect()
}

/// X1: no code runs.
fn payloads() -> Vec<Case> {
    vec![
        bounded("X1", "a module with a payload", |d| {
            d.set("/auto_map", &json!({ "AutoModelForCausalLM": "modeling_x.XModel" }));
            d.put(MODULE, PAYLOAD);
        }),
        bounded("X1", "modules that Python runs unasked", |d| {
            d.small();
            for name in ["sitecustomize.py", "usercustomize.py", "__init__.py", "conftest.py", "setup.py"] {
                d.put(name, PAYLOAD);
            }
        }),
        bounded("X1", "a template with a payload", |d| {
            d.llama();
            d.put("chat_template.jinja", "{{ ''.__class__.__mro__[1].__subclasses__() }}");
        }),
        case("X1", "a module that does not parse", "AUT011", MODULE, |d| {
            d.small();
            d.put(MODULE, "class A(:\n  pass\n");
        }),
        case("X1", "a module with escape codes", "AUT011", MODULE, |d| {
            d.small();
            d.put(MODULE, "class \u{1b}[31mA\u{202e}:\n  pass\n");
        }),
    ]
}

/// X2: config keys that make a loader download or run code.
fn switches() -> Vec<Case> {
    let set = |key: &'static str, value: Value| {
        case("X2", key, "SEC001", "config.json", move |d| d.set(&format!("/{key}"), &value))
    };
    vec![
        set("trust_remote_code", json!(true)),
        set("_attn_implementation_internal", json!("evil/kernel")),
        set("_attn_implementation", json!("evil/kernel:x")),
        set("attn_implementation", json!("evil/kernel")),
        set("_experts_implementation_internal", json!("evil/kernel")),
    ]
}

/// X3: strings of `auto_map`, used as paths.
fn auto_maps() -> Vec<Case> {
    let of = |name: &str, codes, value: Value| {
        case("X3", name, codes, "config.json", move |d| d.set("/auto_map", &json!({ "AutoModelForCausalLM": value })))
    };
    vec![
        of("out of the directory", "AUT004", json!("../../evil.X")),
        of("one up", "AUT004", json!("../evil.X")),
        of("absolute", "AUT004", json!("/tmp/evil.X")),
        of("backslash", "AUT004", json!("..\\evil.X")),
        of("another repository", "AUT005", json!("org/repo--modeling_x.X")),
        of("another repository, out of it", "AUT004", json!("org/repo--../../evil.X")),
        of("no class", "AUT003", json!("modeling_x")),
        of("no module", "AUT004", json!(".X")),
        of("empty", "AUT003", json!("")),
        of("a number", "AUT003", json!(7)),
        of("an object", "AUT003", json!({ "a": 1 })),
        of("NUL", "AUT004", json!("evil\u{0}.X")),
        of("escape codes", "AUT004", json!("\u{1b}[2Jevil.X")),
        of("a module that is not there", "AUT001", json!("gone.X")),
        of("dunder", "AUT001", json!("__init__.X")),
        of("a megabyte", "AUT001", json!(format!("{}.X", "m".repeat(200)))),
        case("X3", "auto_map a string", "AUT003", "config.json", |d| d.set("/auto_map", &json!("modeling_x.X"))),
        case("X3", "ninety thousand entries", "AUT003 AUT004", "config.json", |d| {
            let entries = (0..large(90_000)).map(|i| (format!("Auto{i}"), json!(format!("../evil{i}.X"))));
            d.set("/auto_map", &Value::Object(entries.collect()));
        }),
        case("X3", "a module that is a FIFO", "FIL001", MODULE, |d| {
            d.set("/auto_map", &json!({ "AutoModelForCausalLM": "modeling_x.X" }));
            d.fifo(MODULE);
        }),
        case("X3", "a relative import out of the directory", "AUT002", MODULE, |d| {
            d.set("/auto_map", &json!({ "AutoModelForCausalLM": "modeling_x.X" }));
            d.put(MODULE, "from ...evil import Y\nfrom .gone import Z\nclass X: pass\n");
        }),
    ]
}

/// X4: modules that exhaust a parser.
fn exhausting() -> Vec<Case> {
    let of = |name: &str, text: String| {
        bounded("X4", name, move |d| {
            d.set("/auto_map", &json!({ "AutoModelForCausalLM": "modeling_x.X" }));
            d.put(MODULE, &text);
        })
    };
    let mut classes = String::new();
    let mut ifs = String::new();
    for depth in 0..2000 {
        let indent = " ".repeat(depth);
        let _ = writeln!(classes, "{indent}class A{depth}:");
        let _ = writeln!(ifs, "{indent}if a:");
    }
    let mut imports = String::new();
    for i in 0..50_000 {
        let _ = writeln!(imports, "from .m{i} import a{i}");
    }
    vec![
        of("brackets", "(".repeat(100_000)),
        of("brackets, closed", format!("{}{}", "(".repeat(100_000), ")".repeat(100_000))),
        of("four megabytes of brackets", "[".repeat(4_000_000)),
        of("four megabytes of statements", "a;".repeat(2_000_000)),
        of("four megabytes of one name", "a".repeat(4_000_000)),
        of("four megabytes of NULs", "\0".repeat(4_000_000)),
        of("nested classes", classes),
        of("nested conditions", ifs),
        of("operators", format!("a = {}1\n", "1 + ".repeat(200_000))),
        of("not not not", format!("a = {}1\n", "not ".repeat(200_000))),
        of("lambdas", format!("a = {}1\n", "lambda: ".repeat(100_000))),
        of("strings in strings", format!("a = {}\n", "f'{".repeat(50_000))),
        of("attributes", format!("a{}\n", ".b".repeat(300_000))),
        of("fifty thousand imports", imports),
        of("a string that never ends", format!("a = \"\"\"{}", "x".repeat(3_000_000))),
        of("tabs and spaces", "\tif a:\n        b\n".repeat(50_000)),
        case("X4", "more than is read of a module", "FIL003", MODULE, |d| {
            d.small();
            d.put(MODULE, "a = 1\n".repeat(1_000_000));
        }),
        bounded("X4", "modules that import each other", |d| {
            d.set("/auto_map", &json!({ "AutoModelForCausalLM": "modeling_x.X" }));
            d.put(MODULE, "from .b import Y\nfrom .modeling_x import X\nclass X: pass\n");
            d.put("b.py", "from .modeling_x import X\nfrom .b import Y\nclass Y: pass\n");
        }),
        bounded("X4", "a thousand modules in a chain", |d| {
            d.set("/auto_map", &json!({ "AutoModelForCausalLM": "m0.X" }));
            for i in 0..1000 {
                d.put(&format!("m{i}.py"), format!("from .m{} import X\nfrom .m0 import X\n", (i + 1) % 1000));
            }
        }),
    ]
}
