//! Architectures of a user, evaluated on a config.
//!
//! The first byte selects the form of the rest: 0 to 3 are a whole file and a config, separated by 0xff; the others are lines
//! with the expressions of a small file, because most changes of a whole file are refused by its parser.

#![no_main]

use ckpt_doctor::knowledge::{Library, Loader};
use libfuzzer_sys::fuzz_target;
use serde_json::{Value, json};

/// A file with these expressions: four of `let`, a condition, a shape and the number of layers.
fn file(lines: &[&str]) -> Value {
    let line = |at: usize| lines.get(at).copied().unwrap_or("1");
    let names = ["v", "w", "x", "y"].map(|name| name.to_owned());
    let lets: serde_json::Map<String, Value> =
        names.into_iter().zip(0..).map(|(name, at)| (name, line(at).into())).collect();
    json!({
        "architecture": "x", "summary": "x", "model_types": ["x"], "sources": ["x"], "loaders": ["4.47.0"],
        "auto": { "model": "XModel" },
        "defaults": { "hidden_size": 8, "num_hidden_layers": 2, "list": [1, 2, 3], "text": "abc" },
        "require": [{ "that": line(4), "message": format!("{{{}}}", line(5)) }],
        "computed": { "heads": line(6) },
        "let": lets,
        "classes": [{
            "class": "XModel",
            "tensors": {
                "a.weight": { "shape": [line(7), "v"] },
                "layers.{i}.": { "repeat": { "i": line(8) }, "tensors": { "b": { "weight": ["w", "x"], "bias": "y" } } },
            },
        }],
    })
}

fn parts(data: &[u8]) -> Option<(String, Value)> {
    let (form, rest) = data.split_first()?;
    if form % 8 < 4 {
        let (file, config) = rest.split_at(rest.iter().position(|b| *b == 0xff)?);
        let config = serde_json::from_slice(config.get(1..)?).ok()?;
        return Some((std::str::from_utf8(file).ok()?.to_owned(), config));
    }
    let lines: Vec<&str> = std::str::from_utf8(rest).ok()?.split('\n').collect();
    Some((file(&lines).to_string(), json!({ "model_type": "x", "architectures": ["XModel"] })))
}

fuzz_target!(|data: &[u8]| {
    let Some((text, config)) = parts(data) else { return };
    let mut library = Library::default();
    if library.add("x.json5", &text).is_err() {
        return;
    }
    for loader in Loader::ALL {
        let Some(architecture) = library.find(&config, ["a.weight"], loader) else { continue };
        for class in architecture.siblings().chain([architecture]) {
            match class.expect(&config) {
                Ok(expected) => drop(format!("{expected:?}")),
                Err(refusal) => drop(format!("{refusal:?}")),
            }
        }
    }
});
