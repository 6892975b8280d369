//! Recipes of users: the ten in `fixtures/recipes`, those of `--rules`, and files beside a recipe.

use std::fmt::Write as _;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::{doctor, donor, json as report, names, text};
use crate::support::base::{copy, documents, tensors};
use crate::support::{knowledge, project, texts};

/// Donors of `fixtures/recipes`, with the changes of their configs.
fn donors(work: &Path) {
    let knowledge = knowledge();
    let recipes = project().join("fixtures/recipes/donors");
    for name in ["llava", "siglip", "idefics3", "t5"] {
        documents(&recipes.join(name), &work.join(name), 1, &knowledge);
    }
    let llama = project().join("fixtures/bases/llama");
    documents(&llama, &work.join("llama"), 2, &knowledge);
    let changed = |from: &Path, name: &str, changes: Value| {
        let to = work.join(name);
        copy(from, &to);
        let mut config: Value = serde_json::from_slice(&fs::read(to.join("config.json")).unwrap()).unwrap();
        let Value::Object(changes) = changes else { panic!("an object") };
        config.as_object_mut().unwrap().extend(changes);
        fs::write(to.join("config.json"), config.to_string()).unwrap();
        tensors(&to, 1, &knowledge);
    };
    changed(&llama, "llama-wide", json!({ "hidden_size": 32, "intermediate_size": 40 }));
    changed(&recipes.join("t5"), "t5-deep", json!({ "num_decoder_layers": 3 }));
    // transformers 4.57 writes the names that the class of 4.47 has.
    copy(&work.join("llava"), &work.join("llava-later"));
    let config = work.join("llava-later/config.json");
    fs::write(&config, fs::read_to_string(&config).unwrap().replace("4.47.0", "4.57.6")).unwrap();
}

/// A recipe with donors by role, and options.
type Run = (&'static str, &'static [(&'static str, &'static str)], &'static [&'static str]);

const RUNS: &[Run] = &[
    ("extract-language.json5", &[("from", "llava")], &[]),
    ("extract-vision.json5", &[("from", "llava")], &[]),
    ("llava-llama/recipe.json5", &[("vision", "llava"), ("language", "llama")], &[]),
    ("llava-llama/recipe.json5", &[("vision", "llava"), ("language", "llama-wide")], &[]),
    ("llava-llama/recipe.json5", &[("vision", "llava"), ("language", "llama-wide")], &["projector=reinit"]),
    ("llava-llama/recipe.json5", &[("vision", "llava-later"), ("language", "llama-wide")], &["projector=reinit"]),
    ("llava-tower.json5", &[("from", "llava"), ("tower", "siglip")], &[]),
    ("idefics3-llama.json5", &[("vision", "idefics3"), ("language", "llama")], &["connector=reinit"]),
    ("t5-halves.json5", &[("encoder", "t5"), ("decoder", "t5-deep")], &[]),
    ("llama-embedding.json5", &[("words", "llama"), ("body", "llama")], &[]),
    ("reshard.json5", &[("from", "idefics3")], &["shard-size=20KB"]),
    ("add-prefix.json5", &[("from", "llama")], &["prefix=x."]),
    ("llava-names.json5", &[("from", "llava")], &[]),
    ("cast.json5", &[("from", "siglip")], &["dtype=float32"]),
];

#[test]
fn the_recipes_of_the_fixtures_run() {
    let work = TempDir::new().unwrap();
    donors(work.path());
    let mut table = String::new();
    for (number, (recipe, roles, options)) in RUNS.iter().enumerate() {
        let path = project().join("fixtures/recipes").join(recipe);
        let out = work.path().join(format!("out-{number}"));
        let mut args = vec!["merge".to_owned(), "--recipe".to_owned(), path.display().to_string()];
        for (role, name) in *roles {
            args.extend(["--donor".to_owned(), format!("{role}={}", work.path().join(name).display())]);
        }
        for option in *options {
            args.extend(["--set".to_owned(), (*option).to_owned()]);
        }
        args.extend(["--out", out.to_str().unwrap(), "--output-format", "json"].map(str::to_owned));
        let run = doctor(&args.iter().map(String::as_str).collect::<Vec<_>>());
        let merge = &report(&run)["merge"];
        writeln!(table, "{recipe} {} -> {:?}", options.join(" "), run.status.code()).unwrap();
        for stage in merge["stages"].as_array().unwrap() {
            writeln!(table, "  {}: {}", stage["name"].as_str().unwrap(), stage["outcome"].as_str().unwrap()).unwrap();
        }
        for seam in merge["seams"].as_array().into_iter().flatten() {
            writeln!(table, "  seam: {}, {}", seam["message"].as_str().unwrap(), seam["options"]).unwrap();
        }
        if out.exists() {
            let files: Vec<String> = names(&out).into_iter().filter(|name| !name.starts_with("merge-")).collect();
            writeln!(table, "  {}\n  {}", merge["transforms"], files.join(" ")).unwrap();
        }
    }
    snapshot!("merge-recipes-of-users", table);
}

#[test]
fn a_folder_of_rules_adds_recipes_and_processors() {
    let work = TempDir::new().unwrap();
    donors(work.path());
    let rules = work.path().join("rules");
    fs::create_dir_all(rules.join("processors")).unwrap();
    let fixtures = project().join("fixtures/recipes");
    // A folder with processors alone is enough.
    fs::copy(fixtures.join("llava-llama/image-token.json5"), rules.join("processors/image.json5")).unwrap();
    let rules_arg = rules.to_str().unwrap();
    assert_eq!(doctor(&["recipes", "--rules", rules_arg]).status.code(), Some(0));

    fs::create_dir_all(rules.join("recipes")).unwrap();
    let recipe = fs::read_to_string(fixtures.join("llava-llama/recipe.json5")).unwrap();
    let recipe = recipe.replace("image-token.json5", "image-token");
    fs::write(rules.join("recipes/llava-llama.json5"), &recipe).unwrap();
    let list = report(&doctor(&["recipes", "--output-format", "json", "--rules", rules_arg]));
    let own = list["recipes"].as_array().unwrap().iter().find(|r| r["name"] == "llava-llama").expect("the own recipe");
    assert!(own["file"].as_str().unwrap().ends_with("rules/recipes/llava-llama.json5"), "{own}");
    assert_eq!(own["options"][0]["values"], json!(["keep", "reinit"]));

    let page = text(&doctor(&["explain", "llava-llama", "--rules", rules_arg]));
    snapshot!("merge-page-of-a-recipe", page.replace(work.path().to_str().unwrap(), ""));
    let printed = doctor(&["merge", "--recipe", "llava-llama", "--print-recipe", "--rules", rules_arg]);
    assert_eq!(String::from_utf8(printed.stdout).unwrap(), recipe);
    let help = text(&doctor(&["merge", "--recipe", "llava-llama", "--help", "--rules", rules_arg]));
    assert!(help.starts_with(&page), "{help}");

    let out = work.path().join("out");
    let path = |name: &str| work.path().join(name).display().to_string();
    let args = ["merge", "--vision", &path("llava"), "--language", &path("llama"), "--out", out.to_str().unwrap()];
    let run = doctor(&[args.as_slice(), &["--rules", rules_arg]].concat());
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let config: Value = serde_json::from_slice(&fs::read(out.join("config.json")).unwrap()).unwrap();
    assert_eq!((&config["image_token_index"], &config["text_config"]["vocab_size"]), (&json!(16), &json!(17)));
}

/// A recipe with an entry of `files`, and with a processor.
fn recipe(file: &Value, processor: Option<&str>) -> String {
    let mut recipe = json!({
        "recipe": "x", "summary": "s",
        "donors": [{ "role": "from", "what": "w", "architectures": ["*"] }],
        "documents": [{ "name": "config.json", "from": "from" }],
        "tensors": [{ "from": "from", "names": "." }],
        "files": [file],
    });
    if let Some(processor) = processor {
        recipe["tokens"] = json!({ "base": "from", "processor": processor });
    }
    recipe.to_string()
}

#[test]
fn files_of_a_recipe_lie_in_its_folder() {
    let work = TempDir::new().unwrap();
    let (folder, out) = (work.path().join("r"), work.path().join("out"));
    fs::create_dir_all(folder.join("deep")).unwrap();
    fs::write(work.path().join("outside.py"), "secret = 1\n").unwrap();
    fs::write(folder.join("deep/inside.py"), "inside = '{{kind}}'\n").unwrap();
    symlink("../outside.py", folder.join("link.py")).unwrap();
    symlink("deep/inside.py", folder.join("inner.py")).unwrap();
    fs::write(folder.join("broken.json5"), "{ processor: 'x', ad: [] }").unwrap();
    fs::write(folder.join("class.json5"), "{ processor: 'x', architectures: ['lama'], add: [] }").unwrap();
    fs::write(folder.join("name.json5"), "{ processor: 'x', add: [{ content: '<a{j}>', count: 'n' }] }").unwrap();
    let llama = donor("llava3d-tiny");
    let given = format!("from={}", llama.display());
    let run = |text: &str| {
        fs::write(folder.join("r.json5"), text).unwrap();
        let file = folder.join("r.json5");
        let run =
            doctor(&["merge", "--recipe", file.to_str().unwrap(), "--donor", &given, "--out", out.to_str().unwrap()]);
        (
            run.status.code(),
            super::text(&run)
                .replace(&work.path().canonicalize().unwrap().display().to_string(), "")
                .replace(work.path().to_str().unwrap(), ""),
        )
    };
    let template =
        |text: &str| json!({ "template": { "name": "x.py", "text": text, "fill": { "kind": "from.model_type" } } });
    let copy = json!({ "copy": { "from": "from", "names": [] } });
    let mut table = String::new();
    for text in ["../outside.py", "link.py", "/etc/passwd", "deep/../../outside.py", "nothing.py", "deep", ""] {
        let (code, error) = run(&recipe(&template(text), None));
        assert_eq!(code, Some(2), "{text}: {error}");
        writeln!(table, "{text:<22} {}", error.trim_end()).unwrap();
    }
    for processor in ["../x.json5", "nothing.json5", "broken.json5", "class.json5", "name.json5"] {
        let (code, error) = run(&recipe(&copy, Some(processor)));
        assert_eq!(code, Some(2), "{processor}: {error}");
        writeln!(table, "{processor:<22} {}", error.trim_end()).unwrap();
    }
    snapshot!("merge-files-beside-a-recipe", table);
    for text in ["deep/inside.py", "inner.py"] {
        let (code, error) = run(&recipe(&template(text), None));
        assert_eq!(code, Some(0), "{text}: {error}");
        assert_eq!(fs::read_to_string(out.join("x.py")).unwrap(), "inside = 'llava_llama'\n");
        fs::remove_dir_all(&out).unwrap();
    }
}

/// A pattern copies neither weights nor code, and nothing that another entry writes.
#[test]
fn patterns_leave_out_weights_code_and_what_is_written() {
    let work = TempDir::new().unwrap();
    let (from, out, file) = (work.path().join("from"), work.path().join("out"), work.path().join("r.json5"));
    super::copy(&donor("llava3d-tiny"), &from);
    for name in
        ["README.md", "readme.MD", "evil.py", "pytorch_model.bin", "a.gguf", "merge-report.md", "notes.txt", ".hidden"]
    {
        fs::write(from.join(name), "x = 1\n").unwrap();
    }
    fs::write(from.join("extra.json"), r#"{ "auto_map": { "AutoModel": "evil.X" }, "a": 1 }"#).unwrap();
    fs::create_dir(from.join("folder")).unwrap();
    let run = |names: Value| {
        fs::write(&file, recipe(&json!({ "copy": { "from": "from", "names": names } }), None)).unwrap();
        let given = format!("from={}", from.display());
        let args = ["merge", "--recipe", file.to_str().unwrap(), "--donor", &given, "--out", out.to_str().unwrap()];
        let run = doctor(&args);
        assert_eq!(run.status.code(), Some(0), "{}", text(&run));
        let copied = names_without_weights(&out);
        let extra = fs::read_to_string(out.join("extra.json")).unwrap_or_default();
        assert!(!extra.contains("auto_map"), "{extra}");
        fs::remove_dir_all(&out).unwrap();
        copied
    };
    let all = [
        "config.json",
        "extra.json",
        "generation_config.json",
        "notes.txt",
        "special_tokens_map.json",
        "tokenizer.model",
        "tokenizer_config.json",
    ];
    assert_eq!(run(json!(["*"])), all);
    assert_eq!(
        run(json!(["tokenizer*", "*.model", "{extra,no}.json"])),
        ["config.json", "extra.json", "tokenizer.model", "tokenizer_config.json"]
    );
    // A name is meant.
    assert_eq!(run(json!(["evil.py", "*.txt"])), ["config.json", "evil.py", "notes.txt"]);
}

fn names_without_weights(out: &Path) -> Vec<String> {
    let own = |name: &String| !name.contains("safetensors") && !name.starts_with("merge-") && name != "README.md";
    names(out).into_iter().filter(own).collect()
}

/// Numbers and texts of options, in pointers and values.
#[test]
fn options_have_kinds_and_pointers_are_templates() {
    let work = TempDir::new().unwrap();
    let (out, file) = (work.path().join("out"), work.path().join("r.json5"));
    let mut whole: Value =
        serde_json::from_str(&recipe(&json!({ "copy": { "from": "from", "names": [] } }), None)).unwrap();
    whole["options"] = json!([
        { "name": "n", "help": "h", "kind": "integer", "default": "7" },
        { "name": "key", "help": "h", "kind": "text", "default": "a:b" },
    ]);
    whole["tokens"] = json!({ "base": "from" });
    whole["documents"][0]["edits"] = json!([
        { "set": { "at": "/x_{opt.n}", "to": "opt.n + 1" } },
        { "set": { "at": "/{opt.key}", "to": "{'id': id_of('<s>'), 'none': id_of('<nothing>'), 'length': tokens.length}" } },
        { "set": { "at": "/stored", "to": "has(stored.from.pad_token_id)", "when": "opt.n < 100" } },
        { "remove": { "at": ["/{['mm', 'vision', 'tower'].filter(x, x != '').map(x, x)[0]}_vision_tower"] } },
    ]);
    fs::write(&file, whole.to_string()).unwrap();
    let given = format!("from={}", donor("llava3d-tiny").display());
    let args = ["merge", "--recipe", file.to_str().unwrap(), "--donor", &given, "--out", out.to_str().unwrap()];
    let run = doctor(&args);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let read = |name: &str| -> Value { serde_json::from_slice(&fs::read(name).unwrap()).unwrap() };
    let before = read(donor("llava3d-tiny").join("config.json").to_str().unwrap());
    let config = read(out.join("config.json").to_str().unwrap());
    assert_eq!(config["x_7"], 8);
    assert_eq!(config["a:b"], json!({ "id": 1, "none": null, "length": config["a:b"]["length"] }));
    assert!(config["a:b"]["length"].as_u64().unwrap() >= 340);
    assert_eq!(config["stored"], before.get("pad_token_id").is_some());
    assert!(before.get("mm_vision_tower").is_some() && config.get("mm_vision_tower").is_none(), "{config}");

    fs::remove_dir_all(&out).unwrap();
    for (option, reason) in [
        ("n=x", "n=x is not an integer"),
        ("key=use_kernels", "use_kernels makes a loader run code"),
        ("key=auto_map", "Nothing written: the planned checkpoint has errors"),
        ("key=a\u{7}", "control character"),
    ] {
        let run = doctor(&[args.as_slice(), &["--set", option]].concat());
        assert_eq!(run.status.code(), Some(2), "{option}: {}", text(&run));
        assert!(text(&run).contains(reason), "{option}: {}", text(&run));
        assert!(!out.exists());
    }
}

/// The recipes that docs/recipes.md quotes are those of the fixtures, and its tables name what the code defines.
#[test]
fn the_page_of_recipes_quotes_and_names_what_exists() {
    let page = fs::read_to_string(project().join("docs/recipes.md")).unwrap();
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let recipes: Vec<String> = texts("fixtures/recipes").iter().map(|(_, text)| words(text)).collect();
    let blocks: Vec<&str> = page.split("```json5\n").skip(1).map(|rest| rest.split("```").next().unwrap()).collect();
    for block in &blocks {
        assert!(recipes.iter().any(|recipe| recipe.contains(&words(block))), "no recipe contains:\n{block}");
    }
    assert!(blocks.len() >= 10, "{} blocks", blocks.len());
    for (path, _) in texts("fixtures/recipes").iter().filter(|(_, text)| text.contains("donors:")) {
        let name = path.strip_prefix("fixtures/recipes/").unwrap();
        assert!(page.contains(&format!("`{name}`")), "{name} is missing from the page");
    }

    let code = ["src/knowledge/expression/functions.rs", "src/merge/context.rs", "src/merge/functions.rs"]
        .map(|path| fs::read_to_string(project().join(path)).unwrap());
    let name = regex::Regex::new(r#"scope\.(?:function[12]?|add|bind)\("([a-z_]+)""#).unwrap();
    let named: Vec<&str> =
        code.iter().flat_map(|code| name.captures_iter(code)).map(|c| c.get(1).unwrap().as_str()).collect();
    assert!(named.len() > 15, "{named:?}");
    for name in named {
        let call = page.contains(&format!("`{name}(")) || page.contains(&format!("`{name}`"));
        assert!(call, "the function or variable {name} is missing from docs/recipes.md");
    }
}
