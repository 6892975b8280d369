//! Recipes and merge files that are refused when they are read: each error names the place, the word and the nearest known
//! one.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;

use ckpt_doctor::HashAlgorithm;
use ckpt_doctor::knowledge::recipe::Recipe;
use ckpt_doctor::merge::{self, MergeRequest, validate};
use serde_json::{Value, json};
use tempfile::TempDir;

use super::{doctor, donor, text};
use crate::support::{knowledge, texts};

#[test]
fn built_in_recipes_are_valid() {
    let knowledge = knowledge();
    for (path, text) in texts("rules/recipes") {
        let recipe = Recipe::parse(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        validate(&recipe, &path, &text, &knowledge).unwrap_or_else(|e| panic!("{e}"));
    }
}

/// A recipe that reaches the planner without validation: the plan itself is refused.
#[test]
fn a_plan_that_changes_what_no_entry_names_is_refused() {
    let work = TempDir::new().unwrap();
    for (entry, how) in [
        (json!({ "from": "from", "names": "norm", "scale": "2.0" }), "convert"),
        (json!({ "from": "from", "fit": "'reinit-always'" }), "reinit"),
    ] {
        let text = recipe(json!({ "tensors": [entry] })).to_string().replace("\"llama\"", "\"llava_llama\"");
        let request = MergeRequest {
            recipe: Some(Recipe::parse("own.json5", &text).unwrap()),
            donors: [("from".to_owned(), donor("llava3d-tiny"))].into(),
            options: BTreeMap::new(),
            versions: Vec::new(),
            tolerate: Vec::new(),
            out: work.path().join("out"),
            dry_run: true,
            hash: HashAlgorithm::None,
            hash_donors: false,
        };
        let seams_or_error = match merge::run(&request, &knowledge(), &|_, _| {}) {
            Err(error) => error.to_string(),
            Ok(run) => run.record.seams.iter().map(|seam| seam.message.clone()).collect(),
        };
        let says = how == "convert" && seams_or_error.contains("would be changed (convert");
        let is_unknown = how == "reinit" && seams_or_error.contains("cannot be reinitialised");
        assert!(says || is_unknown, "{entry}: {seams_or_error}");
    }
}

/// A sound recipe, with the changed members of a case.
fn recipe(changes: Value) -> Value {
    let mut recipe = json!({
        "recipe": "x", "summary": "s",
        "donors": [{ "role": "from", "what": "a checkpoint", "architectures": ["llama"] }],
        "options": [{ "name": "rows", "help": "h", "values": ["grow", "keep"], "default": "grow" }],
        "documents": [{ "name": "config.json", "from": "from" }],
        "tensors": [{ "from": "from", "names": "." }],
    });
    let Value::Object(changes) = changes else { panic!("an object") };
    recipe.as_object_mut().unwrap().extend(changes);
    recipe
}

fn edit(edit: &Value) -> Value {
    json!({ "documents": [{ "name": "config.json", "from": "from", "edits": [edit] }] })
}

fn set(at: &str, to: &str) -> Value {
    edit(&json!({ "set": { "at": at, "to": to } }))
}

fn file(file: &Value) -> Value {
    json!({ "files": [file] })
}

fn roles() -> Vec<(&'static str, Value)> {
    let tensors = |more: (&str, Value)| json!({ "tensors": [{ "from": "from", "names": ".", more.0: more.1 }] });
    let role = |role: &str| json!({ "role": role, "what": "w", "architectures": ["llama"] });
    vec![
        ("role of a document", json!({ "documents": [{ "name": "config.json", "from": "form" }] })),
        ("role of a graft", edit(&json!({ "graft": { "at": "/text_config", "from": "form" } }))),
        ("role of tensors", json!({ "tensors": [{ "from": "form", "names": "." }] })),
        ("role of a seam", tensors(("meets", json!({ "from": "form", "name": "x" })))),
        ("role of a pattern for rows", tensors(("like", json!({ "from": "form", "name": "x" })))),
        ("role of a copy", file(&json!({ "copy": { "from": "form", "names": ["tokenizer.model"] } }))),
        ("role of modules", file(&json!({ "modules": { "from": ["form"], "roots": ["x"] } }))),
        ("role of tokens", json!({ "tokens": { "base": "form", "processor": "paligemma" } })),
        ("role in a function", json!({ "let": [{ "name": "n", "is": "shape('form', 'x')[0]" }] })),
        ("role in an expression", set("/hidden_size", "form.hidden_size")),
        ("role twice", json!({ "donors": [role("from"), role("from")] })),
        ("role that is no variable", json!({ "donors": [role("from"), role("my donor")] })),
        ("role with a meaning", json!({ "donors": [role("from"), role("opt")] })),
    ]
}

fn names() -> Vec<(&'static str, Value)> {
    let donor = |key: &str, words: Value| {
        let mut donor = json!({ "role": "from", "what": "w" });
        donor[key] = words;
        json!({ "donors": [donor] })
    };
    let option =
        |default: &str| json!({ "options": [{ "name": "o", "values": ["a"], "default": default, "help": "h" }] });
    let tensors = |key: &str, value: Value| json!({ "tensors": [{ "from": "from", "names": ".", key: value }] });
    vec![
        ("architecture", donor("architectures", json!(["lama"]))),
        ("rule", donor("tolerates", json!(["ARC099"]))),
        ("part that is used", donor("only_part", json!("langauge"))),
        ("part that is not used", donor("without_part", json!("{otp.part}"))),
        ("processor", json!({ "tokens": { "base": "from", "processor": "paligema" } })),
        ("template", file(&json!({ "template": { "name": "x.py", "text": "nope.py" } }))),
        ("option", set("/x", "opt.row")),
        ("option of an argument", set("/x", "arg['row']")),
        ("option of a seam", tensors("options", json!(["row=grow"]))),
        ("value of a seam", tensors("options", json!(["rows=grown"]))),
        ("default", option("b")),
        ("name", set("/x", "hiden + 1")),
        ("tokens without tokens", set("/x", "tokens.length")),
        ("function", set("/x", "shap('from', 'x')")),
        ("template of a note", json!({ "notes": [{ "when": "true", "say": "{hiden} wide" }] })),
        ("name twice", json!({ "let": [{ "name": "a", "is": "1" }, { "name": "a", "is": "2" }] })),
        ("name before its definition", json!({ "let": [{ "name": "a", "is": "b" }, { "name": "b", "is": "2" }] })),
        ("regular expression", json!({ "tensors": [{ "from": "from", "names": "^(model" }] })),
        ("large regular expression", tensors("names", json!("^a(\\pL{50}){50}"))),
        ("long regular expression", tensors("names", json!("a".repeat(2_001)))),
        ("long name in the result", tensors("as", json!("$1".repeat(1_001)))),
        ("very many entries", json!({ "tensors": vec![json!({ "from": "from", "names": "." }); 201] })),
        (
            "treatment",
            json!({ "tensors": [{ "from": "from", "names": "^lm_head", "fit": "opt.rows == 'grow' ? 'grow-row' : 'copy'" }] }),
        ),
        ("change of any tensor", tensors("fit", json!("'pad'"))),
        ("factor on any tensor", json!({ "tensors": [{ "from": "from", "scale": "2.0" }] })),
        (
            "second entry that names nothing",
            json!({ "tensors": [
                { "from": "from", "names": "^lm_head", "fit": "'pad'" },
                { "from": "from", "names": "^.*norm", "fit": "'pad'" },
            ] }),
        ),
        ("no tensors", json!({ "tensors": [] })),
        ("only dropped tensors", tensors("drop", json!("why"))),
    ]
}

fn places() -> Vec<(&'static str, Value)> {
    let document = |name: &str| json!({ "documents": [{ "name": name, "from": "from" }] });
    let deep = "/a".repeat(100);
    vec![
        ("folder above", document("../x.json")),
        ("absolute path", document("/tmp/x.json")),
        ("folder", document("sub/x.json")),
        ("drive", document("C:x.json")),
        ("control character", document("a\nb.json")),
        ("hidden", document(".x.json")),
        ("long", document(&"x".repeat(300))),
        ("not JSON", document("x.py")),
        ("manifest", document("merge-manifest.json")),
        ("index", document("Model.safetensors.index.JSON")),
        ("document twice", json!({ "documents": [{ "name": "config.json" }, { "name": "Config.json" }] })),
        ("name of a template", file(&json!({ "template": { "name": "../x.py", "text": "x" } }))),
        ("name of a copy", file(&json!({ "copy": { "from": "from", "names": ["a", "../x"] } }))),
        ("shard", file(&json!({ "copy": { "from": "from", "names": ["model.safetensors"] } }))),
        ("root", file(&json!({ "modules": { "from": ["from"], "roots": ["../x"] } }))),
        ("keyword as a root", file(&json!({ "modules": { "from": ["from"], "roots": ["import"] } }))),
        ("pointer", set("hidden_size", "1")),
        ("escape of a pointer", set("/a~2", "1")),
        ("deep pointer", set(&deep, "1")),
        ("switch", set("/use_kernels", "true")),
        ("nested auto_map", set("/text_config/auto_map", "{}")),
        ("grafted auto_map", edit(&json!({ "graft": { "at": "/auto_map", "from": "from" } }))),
    ]
}

fn keys_of_users() -> Vec<(&'static str, Value)> {
    let donor =
        |architectures: &[&str]| json!({ "donors": [{ "role": "from", "what": "w", "architectures": architectures }] });
    let option = |kind: &str, default: &str, values: &[&str]| json!({ "options": [{ "name": "o", "help": "h", "kind": kind, "default": default, "values": values }] });
    let tokens =
        |value: Value, expression: &str| json!({ "tokens": value, "let": [{ "name": "n", "is": expression }] });
    vec![
        ("any and another", donor(&["llama", "*"])),
        ("pattern of architectures", donor(&["lla*"])),
        ("choice without values", option("choice", "a", &[])),
        ("integer with values", option("integer", "1", &["1"])),
        ("integer", option("integer", "1.5", &[])),
        ("text of two lines", option("text", "a\nb", &[])),
        ("kind", option("number", "1", &[])),
        ("id without tokens", json!({ "let": [{ "name": "n", "is": "id_of('<pad>')" }] })),
        ("name near id_of", tokens(json!({ "base": "from" }), "idof('<pad>')")),
        ("token without a processor", tokens(json!({ "base": "from" }), "tokens.image")),
        ("role of a stored config", set("/x", "stored.form.hidden_size")),
        ("role with the name stored", json!({ "donors": [{ "role": "stored", "what": "w" }] })),
        ("expression in a pointer", set("/x/{opt.nothing}", "1")),
        ("pointer with an expression", set("x/{opt.rows}", "1")),
        ("switch with an expression", set("/use_kernels/{opt.rows}", "1")),
        ("pattern", file(&json!({ "copy": { "from": "from", "names": ["{tokenizer"] } }))),
        ("model card", file(&json!({ "copy": { "from": "from", "names": ["readme.MD"] } }))),
        ("tolerated rule", json!({ "tolerates": ["ARC099"] })),
    ]
}

#[test]
fn a_recipe_is_refused_before_a_donor_is_opened() {
    let work = TempDir::new().unwrap();
    let mut table = String::new();
    for (label, changes) in [roles(), names(), places(), keys_of_users()].concat() {
        let file = work.path().join("r.json5");
        fs::write(&file, serde_json::to_string_pretty(&recipe(changes)).unwrap()).unwrap();
        // The donor does not exist: an error about it would show that it was opened first.
        let run = doctor(&[
            "build-merged",
            "--recipe",
            file.to_str().unwrap(),
            "--donor",
            "from=/none",
            "--out",
            "/none/out",
        ]);
        assert_eq!(run.status.code(), Some(2), "{label}: {}", text(&run));
        let error = text(&run).replace(work.path().to_str().unwrap(), "");
        writeln!(table, "{label:<28} {}", error.trim_end().trim_start_matches("error: ")).unwrap();
    }
    snapshot!("merge-refused-recipes", table);
}

#[test]
fn a_merge_file_is_refused_with_its_place() {
    let work = TempDir::new().unwrap();
    let file = work.path().join("merge.json5");
    let mut table = String::new();
    for (donors, options) in [
        ("visoin: '/none', language: '/none'", ""),
        ("vision: '/none', language: '/none'", "projecter: 'pad'"),
        ("vision: '/none', language: '/none'", "projector: 'fold'"),
        ("vision: '/none', language: '/none'", "alias: 'forward:a.import.b'"),
        ("vision: '/none', language: '/none'", "alias: 'forward:None'"),
    ] {
        let text_of_file = format!(
            "{{\n  recipe: 'spatialvla-llava3d',\n  donors: {{ {donors} }},\n  options: {{ {options} }},\n  out: 'o',\n}}"
        );
        fs::write(&file, text_of_file).unwrap();
        let run = doctor(&["build-merged", file.to_str().unwrap()]);
        assert_eq!(run.status.code(), Some(2), "{}", text(&run));
        table.push_str(&text(&run).replace(work.path().to_str().unwrap(), ""));
    }
    snapshot!("merge-refused-files", table);
}

/// What only the donors can tell is explained in words.
#[test]
fn an_expression_that_fails_is_explained() {
    let work = TempDir::new().unwrap();
    let (file, out) = (work.path().join("r.json5"), work.path().join("out"));
    let language = donor("llava3d-tiny");
    let mut table = String::new();
    for changes in [
        set("/x", "from.hidden_sise"),
        set("/x", "from.hidden_size.x"),
        set("/x", "from.mm_projector_type.size()[7]"),
        set("/x", "1 / (from.hidden_size - from.hidden_size)"),
        set("/x", "pow(2, -1)"),
        set("/x", "from.hidden_size < 'a'"),
        set("/x", "[1, 2]['a']"),
        set("/x", "stored.from.nothing"),
        set("/x/{from.nothing}", "1"),
        json!({ "seams": [{ "that": "from.hidden_size", "message": "m" }] }),
        json!({ "let": [{ "name": "n", "is": "shape('from', 'nothing')[0]" }] }),
        json!({ "tensors": [{ "from": "from", "names": "^nothing$" }] }),
    ] {
        let mut recipe = recipe(changes);
        recipe["donors"][0]["architectures"] = json!(["llava_llama"]);
        fs::write(&file, recipe.to_string()).unwrap();
        let donor = format!("from={}", language.display());
        let args =
            ["build-merged", "--recipe", file.to_str().unwrap(), "--donor", &donor, "--out", out.to_str().unwrap()];
        let run = doctor(&args);
        assert_eq!(run.status.code(), Some(2), "{}", text(&run));
        assert!(!out.exists());
        let said = text(&run);
        let reason = said.lines().find(|line| line.starts_with("error: ") || line.starts_with("    recipe x, "));
        table.push_str(reason.expect("a seam or an error").trim_start());
        table.push('\n');
    }
    snapshot!("merge-unevaluated", table);
}
