//! Parts that do not belong into a model: of another kind, of another vocabulary, quantised.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use serde_json::{Map, Value, json};
use tempfile::TempDir;

use super::law::bytes::read;
use super::{content, doctor, text};
use crate::support::base::{copy, make, tensors};
use crate::support::change::apply_all;
use crate::support::{cases, knowledge, project};

fn run(words: &[&str], out: &Path) -> (Option<i32>, String) {
    let out = out.to_str().unwrap();
    let run = doctor(&[words, &["--out", out, "--output-format", "concise"]].concat());
    (run.status.code(), text(&run))
}

fn edit(file: &Path, change: impl Fn(&mut Value)) {
    let mut value: Value = serde_json::from_slice(&fs::read(file).unwrap()).unwrap();
    change(&mut value);
    fs::write(file, value.to_string()).unwrap();
}

/// A change of the part, by the file that it changes.
type Change = fn(&Path);

const CHANGES: &[(&str, Change)] = &[
    ("another model type", |part| {
        edit(&part.join("config.json"), |config| {
            config["model_type"] = json!("mistral");
            config["architectures"] = json!(["MistralForCausalLM"]);
        });
    }),
    ("another id of a token", |part| {
        edit(&part.join("tokenizer.json"), |tokenizer| {
            let vocabulary = tokenizer["model"]["vocab"].as_object_mut().unwrap();
            let ids: Vec<Value> = vocabulary.values().cloned().collect();
            let last = ids.len() - 1;
            for (token, id) in
                vocabulary.values_mut().zip([&ids[..last - 1], &[ids[last].clone(), ids[last - 1].clone()]].concat())
            {
                *token = id;
            }
        });
    }),
    ("a token less", |part| {
        edit(&part.join("tokenizer.json"), |tokenizer| {
            tokenizer["added_tokens"].as_array_mut().unwrap().pop();
        });
        edit(&part.join("tokenizer_config.json"), |config| {
            config["added_tokens_decoder"].as_object_mut().unwrap().remove("341");
            config.as_object_mut().unwrap().remove("pad_token");
        });
    }),
    ("another end of text", |part| {
        for file in ["tokenizer_config.json", "special_tokens_map.json"] {
            edit(&part.join(file), |tokens| tokens["eos_token"] = tokens["bos_token"].clone());
        }
    }),
    ("no tokenizer, another end of text", |part| {
        for file in ["tokenizer.json", "tokenizer_config.json", "special_tokens_map.json"] {
            fs::remove_file(part.join(file)).unwrap();
        }
        edit(&part.join("config.json"), |config| config["eos_token_id"] = json!(7));
    }),
];

/// `insert` keeps the tokenizer and the class of the model.
#[test]
fn a_part_of_another_kind_is_refused_with_the_command_that_exchanges_it() {
    let (work, knowledge) = (TempDir::new().unwrap(), knowledge());
    let (host, part) = (work.path().join("llava"), work.path().join("llama"));
    make("llava", &host, &knowledge);
    let words = |command: &'static str| [command, host.to_str().unwrap(), "--part", "language"].map(str::to_owned);
    let path = part.to_str().unwrap();
    let extract = words("extract");
    let extract: Vec<&str> = extract.iter().map(String::as_str).collect();
    assert_eq!(run(&extract, &part).0, Some(0));
    let mut table = String::new();
    let mut insert = |label: &str, path: &str| {
        let (insert, out) = (words("insert"), work.path().join(label));
        let insert: Vec<&str> = insert.iter().map(String::as_str).chain(["--from", path]).collect();
        let (code, said) = run(&insert, &out);
        let said = said.replace(work.path().to_str().unwrap(), "");
        let error = said.lines().find(|line| line.starts_with("error:")).unwrap_or("written");
        writeln!(table, "{label:<34} {code:?} {error}").unwrap();
        assert_eq!(out.exists(), error == "written", "{said}");
        out
    };
    let back = insert("unchanged", path);
    for (name, bytes) in content(&host) {
        assert!(name.ends_with("safetensors") || content(&back).get(&name) == Some(&bytes), "{name}");
    }
    for (label, change) in CHANGES {
        let changed = work.path().join("changed");
        copy(&part, &changed);
        change(&changed);
        insert(label, changed.to_str().unwrap());
        fs::remove_dir_all(changed).unwrap();
    }
    // As trainers leave it: another padding token, no tokenizer, or one value of the config.
    let trained: [(&str, Change); 3] = [
        ("another padding token", |part| {
            edit(&part.join("tokenizer_config.json"), |tokens| tokens["pad_token"] = tokens["eos_token"].clone());
        }),
        ("no tokenizer", |part| {
            for file in ["tokenizer.json", "tokenizer_config.json", "special_tokens_map.json"] {
                fs::remove_file(part.join(file)).unwrap();
            }
        }),
        ("another value of the config", |part| {
            edit(&part.join("config.json"), |config| config["rope_theta"] = json!(500_000.0));
        }),
    ];
    for (label, change) in trained {
        let changed = work.path().join("changed");
        copy(&part, &changed);
        change(&changed);
        insert(label, changed.to_str().unwrap());
        fs::remove_dir_all(changed).unwrap();
    }
    snapshot!("merge-foreign-parts", table);
}

/// transformers 4.57 writes the values of Qwen2-VL's language model into `text_config`, under the names of 4.47, which does not
/// read them there.
#[test]
fn a_model_takes_its_own_part_in_the_form_of_a_later_version() {
    let (work, knowledge) = (TempDir::new().unwrap(), knowledge());
    let (host, out) = (work.path().join("host"), work.path().join("out"));
    make("qwen2-vl", &host, &knowledge);
    edit(&host.join("config.json"), |config| {
        let whole = config.as_object_mut().unwrap();
        let of_whole = |key: &str| key == "vision_config" || key == "model_type" || key.ends_with("_token_id");
        let inner: Vec<String> = whole.keys().filter(|key| !of_whole(key)).cloned().collect();
        let mut text: Map<String, Value> =
            inner.into_iter().map(|key| (key.clone(), whole.remove(&key).unwrap())).collect();
        text.insert("model_type".to_owned(), json!("qwen2_vl_text"));
        whole.insert("text_config".to_owned(), text.into());
        whole.insert("transformers_version".to_owned(), json!("4.57.6"));
    });
    let part = host.to_str().unwrap();
    let (code, said) = run(&["insert", part, "--part", "language", "--from", part], &out);
    assert_eq!(code, Some(0), "{said}");
    assert!(read(&host) == read(&out), "{said}");
}

/// The sound quantised checkpoints of `fixtures/sound`, as the guest of every recipe that puts a language model into another one.
#[test]
fn a_quantised_donor_is_put_into_no_model() {
    let (work, knowledge) = (TempDir::new().unwrap(), knowledge());
    let at = |name: &str| work.path().join(name).to_str().unwrap().to_owned();
    for name in ["llava", "paligemma", "llama"] {
        make(name, Path::new(&at(name)), &knowledge);
    }
    let recipes = project().join("fixtures/recipes");
    let user = |name: &str| recipes.join(name).to_str().unwrap().to_owned();
    let guest = at("guest");
    let donors = [
        format!("vision={}", at("llava")),
        format!("language={guest}"),
        format!("words={}", at("llama")),
        format!("body={guest}"),
    ];
    let (llava, paligemma) = (at("llava"), at("paligemma"));
    let (own, words) = (user("llava-llama/recipe.json5"), user("llama-embedding.json5"));
    let runs: [&[&str]; 5] = [
        &["build-merged", "--vision", &llava, "--language", &guest],
        &[
            "build-merged",
            "--recipe",
            "paligemma-llama",
            "--vision",
            &paligemma,
            "--language",
            &guest,
            "--set",
            "projector=pad",
        ],
        &["insert", &llava, "--part", "language", "--from", &guest],
        &["build-merged", "--recipe", &own, "--donor", &donors[0], "--donor", &donors[1]],
        &["build-merged", "--recipe", &words, "--donor", &donors[2], "--donor", &donors[3]],
    ];
    let mut table = String::new();
    let quantised: Vec<_> = cases().into_iter().filter(|case| case.name.starts_with("sound/quantized-")).collect();
    assert!(quantised.len() > 10, "{}", quantised.len());
    for case in &quantised {
        let dir = Path::new(&guest);
        make(&case.base, dir, &knowledge);
        apply_all(&case.name, &case.changes, dir);
        for words in runs {
            let out = work.path().join("out");
            let (code, said) = run(words, &out);
            let error = said.lines().find(|line| line.starts_with("error:")).unwrap_or(&said);
            assert!(
                code == Some(2) && error.contains(" donor is quantised (") && !out.exists(),
                "{} {words:?}: {said}",
                case.name
            );
            if words == runs[0] {
                writeln!(table, "{:<40} {error}", case.name).unwrap();
            }
        }
        fs::remove_dir_all(dir).unwrap();
    }
    snapshot!("merge-quantised-guests", table);
}

/// A quantised model as a host, and as the donor of a part alone; what has one donor and every tensor of it is copied.
#[test]
fn a_part_is_not_taken_out_of_a_quantised_model() {
    let (work, knowledge) = (TempDir::new().unwrap(), knowledge());
    let (llava, guest, out) = (work.path().join("llava"), work.path().join("llama"), work.path().join("out"));
    make("llava", &llava, &knowledge);
    make("llama", &guest, &knowledge);
    let block = json!({ "quant_method": "bitsandbytes", "load_in_8bit": true });
    let places = ["/quantization_config", "/text_config/quantization_config", "/vision_config/quantization_config"];
    for place in places {
        let host = work.path().join("host");
        copy(&llava, &host);
        edit(&host.join("config.json"), |config| {
            let (parent, key) = place.rsplit_once('/').unwrap();
            config.pointer_mut(parent).unwrap()[key] = block.clone();
        });
        tensors(&host, 1, &knowledge);
        let (host_path, guest_path) = (host.to_str().unwrap(), guest.to_str().unwrap());
        for words in [
            &["build-merged", "--vision", host_path, "--language", guest_path][..],
            &["extract", host_path, "--part", "language"],
        ] {
            let (code, said) = run(words, &out);
            let stopped = said.contains(&format!("donor is quantised (config.json {place}: bitsandbytes)"));
            // A checkpoint that declares what it does not store stops as a donor.
            assert!(code == Some(2) || code == Some(1), "{said}");
            assert!((stopped || said.contains("QNT")) && !out.exists(), "{words:?}: {said}");
        }
        fs::remove_dir_all(&host).unwrap();
    }
    make("llama-gptq", &work.path().join("gptq"), &knowledge);
    let (reshard, from) =
        (project().join("fixtures/recipes/reshard.json5"), format!("from={}", work.path().join("gptq").display()));
    let words = ["build-merged", "--recipe", reshard.to_str().unwrap(), "--donor", &from];
    let (code, said) = run(&words, &out);
    assert_eq!(code, Some(0), "{said}");
}
