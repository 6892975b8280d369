//! Generates merges: a sound recipe with one to three changes, donors for its roles, and options.

use std::path::Path;

use serde_json::{Value, json};

use crate::support::Draw;

/// A merge to be tried.
pub struct Request {
    pub recipe: Value,
    /// Directories of donors by role.
    pub donors: Vec<(&'static str, &'static str)>,
    pub options: Vec<(&'static str, String)>,
}

/// A recipe that merges without changes.
fn sound() -> Value {
    json!({
        "recipe": "x", "summary": "s",
        "donors": [
            { "role": "a", "what": "w", "architectures": ["llama"] },
            { "role": "b", "what": "w", "architectures": ["llama"] },
            { "role": "c", "what": "w", "optional": true },
        ],
        "options": [
            { "name": "alias", "help": "h", "values": ["own", "forward:"], "default": "own" },
            { "name": "shard-size", "help": "h", "default": "5GB" },
        ],
        "let": [{ "name": "hidden", "is": "a.hidden_size" }, { "name": "own", "is": "opt.alias == 'own'" }],
        "documents": [
            { "name": "config.json", "from": "a", "edits": [{ "set": { "at": "/hidden_size", "to": "hidden" } }] },
            { "name": "generation_config.json", "from": "b", "optional": true, "edits": [] },
        ],
        "tensors": [{ "from": "a", "names": "." }],
        "files": [
            { "copy": { "from": "b", "names": ["chat_template.json"] } },
            { "modules": { "from": ["a", "c"], "roots": ["configuration_x"], "when": "own" } },
            { "template": {
                "name": "configuration_spatialvla_llava3d.py",
                "text": "spatialvla-llava3d/forward/configuration_spatialvla_llava3d.py",
                "fill": { "package": "arg.alias" }, "when": "!own",
            } },
        ],
        "notes": [{ "when": "hidden > 0", "say": "{hidden} wide" }],
    })
}

/// Places of names of files in the sound recipe.
const NAMES: [&str; 5] = [
    "/documents/0/name",
    "/documents/1/name",
    "/files/0/copy/names/0",
    "/files/1/modules/roots/0",
    "/files/2/template/name",
];
/// Places of roles.
const ROLES: [&str; 7] = [
    "/donors/0/role",
    "/documents/0/from",
    "/documents/1/from",
    "/tensors/0/from",
    "/files/0/copy/from",
    "/files/1/modules/from/0",
    "/files/1/modules/from/1",
];
/// Places of expressions and templates.
const EXPRESSIONS: [&str; 5] = [
    "/let/0/is",
    "/documents/0/edits/0/set/to",
    "/files/2/template/fill/package",
    "/files/2/template/when",
    "/notes/0/say",
];

impl Request {
    /// A request that follows from the state of the generator; `folder` is a place outside of the target.
    pub fn new(draw: &mut Draw, folder: &Path) -> Self {
        let mut recipe = sound();
        let changes = if draw.below(3) == 0 { 2 } else { 1 };
        for _ in 0..changes {
            change(draw, &mut recipe, folder);
        }
        let bin = draw.below(20) == 0;
        let mut donors = vec![("a", if bin { "bin" } else { "one" }), ("b", "two")];
        if draw.below(3) == 0 {
            donors.push(("c", "code"));
        }
        let mut options = Vec::new();
        if draw.below(3) == 0 {
            options.push(("alias", draw.one(ALIASES).to_owned()));
        }
        if draw.below(8) == 0 {
            options.push((draw.one(&["shard-size", "alias", "nothing", "../x"]), draw.one(WORDS).to_owned()));
        }
        Self { recipe, donors, options }
    }
}

const ALIASES: &[&str] = &[
    "own",
    "forward:pkg.sub",
    "forward:pkg",
    "forward:a.import.b",
    "forward:a.None",
    "forward:class",
    "forward:a.match.b",
    "forward:os; import x",
    "forward:",
    "forward:a\nimport os",
    "forward:ü",
];

const WORDS: &[&str] = &["", "x", "1", "300B", "..", "/", "a b", "\0", "opt", "tokens", "{", "'", "9999999999999TB"];

const TARGETS: &[&str] = &[
    "/extra",
    "/x",
    "/x/0",
    "",
    "/auto_map",
    "/auto_map/AutoConfig",
    "/use_kernels",
    "/x/auto_map",
    "/extra",
    "/x/y/z",
    "/extra/deeper/0",
    "x",
];

const VALUES: &[&str] = &[
    "a.extra",
    "a",
    "b.extra.auto_map",
    "a.map",
    "{'auto_map': {'AutoConfig': 'evil/repo--m.X'}}",
    "{'AutoConfig': 'evil/repo--m.X'}",
    "{'AutoConfig': 'configuration_x.X'}",
    "{'AutoConfig': 'nothing.X'}",
    "'evil/repo--m.X'",
    "'configuration_x.X'",
    "[{'trust_remote_code': true, 'k': [{'kernel_config': 1}]}]",
    "true",
    "7",
];

fn name(draw: &mut Draw, folder: &Path) -> String {
    let inside = |file: &str| folder.join(file).to_str().unwrap().to_owned();
    match draw.below(12) {
        10 | 11 => draw.one(&["notes.json", "chat_template.json", "helper.py", "x.json"]).to_owned(),
        0 => inside("absolute.json"),
        1 => format!("../{}.json", draw.below(3)),
        2 => "x".repeat(300),
        _ => draw.one(NAMES_OF_FILES).to_owned(),
    }
}

const NAMES_OF_FILES: &[&str] = &[
    "",
    ".",
    "..",
    ".hidden.json",
    "../../up.json",
    "../evil.py",
    "sub/x.json",
    "sub\\x.json",
    "C:x.json",
    "a\nb.json",
    "a\u{1b}[31m.json",
    "a\0.json",
    "config.json",
    "Config.JSON",
    "notes.json",
    "added_tokens.json",
    "vocab.json",
    "merge-manifest.json",
    "merge-report.md",
    "model.safetensors",
    "model.safetensors.index.json",
    "model-00001-of-00002.safetensors",
    "x.py",
    "x.json",
    "broken",
    "broken.py",
    "keyword",
    "keyword.py",
    "helper",
    "pytorch_model.bin",
    "\u{202e}nosj.json",
    "a b.json",
];

const ROLE_NAMES: &[&str] = &["a", "b", "c", "d", "", "opt", "tokens", "hidden", "a b", "../a", "in"];

const FORMULAS: &[&str] = &[
    "a.hidden_sise",
    "d.hidden_size",
    "opt.nothing",
    "tokens.length",
    "shape('d', 'x')",
    "shape('a', 'x')[0]",
    "shap('a')",
    "c.x",
    "1 / 0",
    "'a.import.b'",
    "'x\nimport os'",
    "[1, 2].map(x, x + hidden)",
    "a",
    "null",
    "(",
    "{hidden",
    "'../x'",
    "9223372036854775807 + 1",
];

fn push(recipe: &mut Value, list: &str, item: Value) {
    if let Some(list) = recipe.pointer_mut(list).and_then(Value::as_array_mut) {
        list.push(item);
    }
}

fn put(recipe: &mut Value, at: &str, value: Value) {
    if let Some(place) = recipe.pointer_mut(at) {
        *place = value;
    }
}

fn change(draw: &mut Draw, recipe: &mut Value, folder: &Path) {
    match draw.below(16) {
        0 | 1 => {
            let name = name(draw, folder);
            put(recipe, draw.one(&NAMES), json!(name));
        }
        2 => {
            let (name, from) = (name(draw, folder), draw.one(ROLE_NAMES));
            push(recipe, "/documents", json!({ "name": name, "from": from, "optional": draw.below(2) == 0 }));
        }
        3 => {
            let text =
                draw.one(&["modeling_spatialvla_llava3d.py", "../../checks/aut/AUT011.json5", "/etc/passwd", "no"]);
            let template = json!({ "name": name(draw, folder), "text": format!("spatialvla-llava3d/{text}") });
            push(recipe, "/files", json!({ "template": template }));
        }
        4 | 5 => {
            let names = [name(draw, folder), draw.one(NAMES_OF_FILES).to_owned()];
            push(recipe, "/files", json!({ "copy": { "from": draw.one(&["a", "b", "c"]), "names": names } }));
        }
        6 => {
            let root = draw.one(&["configuration_x", "helper", "broken", "keyword", "../x", "a.b", "nothing", ""]);
            push(recipe, "/files", json!({ "modules": { "from": ["c", "b"], "roots": [root] } }));
        }
        7..=9 => {
            let edit = json!({ "set": { "at": draw.one(TARGETS), "to": draw.one(VALUES) } });
            push(recipe, &format!("/documents/{}/edits", draw.below(2)), edit);
        }
        10 => {
            let graft = json!({ "graft": { "at": draw.one(TARGETS), "from": draw.one(&["a", "b", "c", "d"]) } });
            push(recipe, "/documents/0/edits", graft);
        }
        11 => put(recipe, draw.one(&ROLES), json!(draw.one(ROLE_NAMES))),
        12 => put(recipe, draw.one(&EXPRESSIONS), json!(draw.one(FORMULAS))),
        13 => tensors(draw, recipe),
        14 => swap_type(draw, recipe),
        _ => {
            let name = draw.one(&["notes.json", "chat_template.json", "added_tokens.json"]);
            push(recipe, "/documents", json!({ "name": name, "from": "b", "edits": [] }));
        }
    }
}

fn tensors(draw: &mut Draw, recipe: &mut Value) {
    let (key, value) = match draw.below(6) {
        0 => ("names", "^nothing$"),
        1 => ("names", "("),
        2 => ("as", draw.one(&["same", "../$0", "", "x.$0", "{hidden}$0"])),
        3 => ("drop", "no"),
        4 => ("fit", draw.one(&["'bogus'", "'pad'", "'reinit'", "opt.alias", "own ? 'copy' : 'x'"])),
        _ => ("when", draw.one(&["false", "own", "7"])),
    };
    if let Some(entry) = recipe.pointer_mut("/tensors/0").and_then(Value::as_object_mut) {
        if key == "fit" && draw.below(4) > 0 {
            entry.insert("names".to_owned(), json!("^(?:model|lm_head)\\."));
        }
        entry.insert(key.to_owned(), json!(value));
    }
}

/// Replaces a random value anywhere in the recipe by one of another type, or removes a key.
fn swap_type(draw: &mut Draw, value: &mut Value) {
    let size = value.as_object().map_or(0, serde_json::Map::len) + value.as_array().map_or(0, Vec::len);
    if size == 0 || draw.below(4) == 0 {
        let values = [json!(null), json!(3), json!([]), json!({}), json!(true), json!("x".repeat(5000)), json!(-0.5)];
        *value = values[draw.below(values.len())].clone();
        return;
    }
    match value {
        Value::Object(map) => {
            let key = map.keys().nth(draw.below(size)).unwrap().clone();
            if draw.below(12) == 0 {
                map.remove(&key);
            } else {
                swap_type(draw, &mut map[&key]);
            }
        }
        Value::Array(items) => {
            let at = draw.below(size);
            swap_type(draw, &mut items[at]);
        }
        _ => unreachable!(),
    }
}
