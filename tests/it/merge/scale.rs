//! A projector that is scaled: what it puts out is multiplied once, by its last layer.

use std::fs;
use std::path::Path;

use ckpt_doctor::knowledge::{Knowledge, Loader};
use ckpt_doctor::report::model::MergeReport;
use ckpt_doctor::{Merge, MergeStage};
use minijinja::context;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::law::bytes::{Tensors, read, values, write};
use crate::support::base::{copy, tensors};
use crate::support::knowledge;

/// Hosts with the tensors of the last layer of their projectors.
const LAST_LAYERS: [(&str, &[&str]); 8] = [
    ("llava", &["multi_modal_projector.linear_2.bias", "multi_modal_projector.linear_2.weight"]),
    ("vipllava", &["multi_modal_projector.linear_2.bias", "multi_modal_projector.linear_2.weight"]),
    // Stands among the features, after the projector.
    (
        "llava-onevision",
        &["image_newline", "multi_modal_projector.linear_2.bias", "multi_modal_projector.linear_2.weight"],
    ),
    ("paligemma", &["multi_modal_projector.linear.bias", "multi_modal_projector.linear.weight"]),
    ("idefics3", &["model.connector.modality_projection.proj.weight"]),
    ("internvl", &["model.multi_modal_projector.linear_2.bias", "model.multi_modal_projector.linear_2.weight"]),
    ("qwen2-vl", &["visual.merger.mlp.2.bias", "visual.merger.mlp.2.weight"]),
    ("qwen2.5-vl", &["model.visual.merger.mlp.2.bias", "model.visual.merger.mlp.2.weight"]),
];

/// The result of a merge that is written.
fn written(merge: &Merge, out: &Path) -> Tensors {
    let report = merge.run().unwrap_or_else(|e| panic!("{e}")).merge.unwrap();
    assert_eq!(report.stage, Some(MergeStage::Written), "{:?}", report.seams);
    read(out)
}

/// The tensors that are `factor` times those of the host; the others have its bytes.
fn scaled<'h>(host: &'h Tensors, result: &Tensors, factor: f32) -> Vec<&'h str> {
    let is_scaled = |name: &&String| {
        let ((dtype, _, before), (_, _, after)) = (&host[*name], &result[*name]);
        let pairs = || values(dtype, before).unwrap().into_iter().zip(values(dtype, after).unwrap());
        // A product is rounded to the eight bits of bfloat16.
        let is_product = pairs().all(|(before, after)| (before * factor - after).abs() <= after.abs() / 256.0);
        assert!(is_product || before == after, "{name}");
        is_product
    };
    host.keys().filter(is_scaled).map(String::as_str).collect()
}

#[test]
fn a_factor_on_a_projector_is_one_on_its_last_layer() {
    let (all, work) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    write(all.path());
    let recipe = json!({
        "recipe": "own", "summary": "s",
        "donors": [{ "role": "from", "what": "w", "architectures": ["*"] }],
        "documents": [{ "name": "config.json", "from": "from" }],
        "tensors": [{ "from": "from", "part": "projector", "scale": "2.0" }, { "from": "from" }],
        "files": [{ "copy": { "from": "from", "names": ["*"] } }],
    });
    let file = work.path().join("recipe.json5");
    fs::write(&file, recipe.to_string()).unwrap();
    for (host, expected) in LAST_LAYERS {
        let out = work.path().join(host);
        let merge = Merge::new(&out).recipe(file.to_str().unwrap()).donor("from", all.path().join(host));
        let (before, after) = (read(&all.path().join(host)), written(&merge, &out));
        assert_eq!(scaled(&before, &after, 2.0), expected, "{host}");
    }
}

/// A Gemma multiplies image features by the root of its width, which LLaVA's own language model does not.
#[test]
fn scale_fold_multiplies_what_the_projector_puts_out_once() {
    let (all, work) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    write(all.path());
    let file = |dir: &Path| -> Value { serde_json::from_slice(&fs::read(dir.join("config.json")).unwrap()).unwrap() };
    let gemma = all.path().join("llama");
    for host in ["llava", "llava-onevision", "internvl"] {
        let hidden = file(&all.path().join(host))["text_config"]["hidden_size"].clone();
        let mut config = file(&gemma);
        let changes = json!({ "model_type": "gemma", "architectures": ["GemmaForCausalLM"], "head_dim": 8,
            "hidden_act": "gelu", "hidden_size": hidden });
        config.as_object_mut().unwrap().extend(changes.as_object().unwrap().clone());
        fs::write(gemma.join("config.json"), config.to_string()).unwrap();
        tensors(&gemma, 1, &knowledge());
        let out = work.path().join(host);
        let merge = Merge::new(&out).recipe("swap-language-model").option("scale", "fold").loader("4.57.6").unwrap();
        let merge = merge.donor("vision", all.path().join(host)).donor("language", &gemma);
        let (before, after) = (read(&all.path().join(host)), written(&merge, &out));
        let is_projector = |name: &str| name.contains("multi_modal_projector.") || name == "image_newline";
        let projector: Tensors = before.into_iter().filter(|(name, _)| is_projector(name)).collect();
        let (_, expected) = LAST_LAYERS.iter().find(|(name, _)| *name == host).unwrap();
        #[expect(clippy::cast_possible_truncation, reason = "the test compares eight bits")]
        let factor = (1.0 / hidden.as_f64().unwrap().sqrt()) as f32;
        assert_eq!(scaled(&projector, &after, factor), *expected, "{host}");
    }
}

/// The starts that `rules/parts/` gives the last layer are those of tensors that the classes build.
#[test]
fn the_last_layer_of_each_projector_is_one_of_its_class() {
    let knowledge = Knowledge::embedded().unwrap();
    for model in knowledge.parts.iter() {
        let outputs = model.parts.get("projector").map_or(&[][..], |part| &part.outputs);
        let is_last = |name: &String| {
            let of_layout = |(part, inside): (&str, String)| {
                part == "projector" && outputs.iter().any(|start| inside.starts_with(start.as_str()))
            };
            model.all_layouts().any(|layout| layout.locate(name).is_some_and(of_layout))
        };
        // A class that cannot be built from its type alone is not compared.
        let class = |(architecture, loader): (&String, Loader)| {
            let config = json!({ "model_type": architecture });
            knowledge.library.find(&config, [], loader)?.expect(&config).ok()
        };
        let pairs = model.architectures.iter().flat_map(|name| Loader::ALL.map(|loader| (name, loader)));
        let mut classes = pairs.filter_map(class).peekable();
        let is_compared = !outputs.is_empty() && classes.peek().is_some();
        assert!(!is_compared || classes.any(|class| class.tensors.keys().any(is_last)), "{}", model.model);
    }
}

/// The guest `llama` of these donors, as a Granite with a chat template of text alone.
fn as_granite(dir: &Path, is_tied: bool) -> String {
    let file = |name: &str| -> Value { serde_json::from_slice(&fs::read(dir.join(name)).unwrap()).unwrap() };
    let mut config = file("config.json");
    config["model_type"] = json!("granite");
    config["architectures"] = json!(["GraniteForCausalLM"]);
    config["logits_scaling"] = json!(8.0);
    config["embedding_multiplier"] = json!(12.0);
    config["tie_word_embeddings"] = json!(is_tied);
    fs::write(dir.join("config.json"), config.to_string()).unwrap();
    tensors(dir, 1, &knowledge());
    let template = "{% for m in messages %}[{{ m['role'] }}] {{ m['content'] }}{% endfor %}";
    let mut tokenizer = file("tokenizer_config.json");
    tokenizer["chat_template"] = json!(template);
    fs::write(dir.join("tokenizer_config.json"), tokenizer.to_string()).unwrap();
    template.to_owned()
}

#[test]
fn a_factor_on_logits_is_folded_into_a_head_of_its_own() {
    for is_tied in [false, true] {
        let (all, work) = (TempDir::new().unwrap(), TempDir::new().unwrap());
        write(all.path());
        as_granite(&all.path().join("llama"), is_tied);
        let out = work.path().join("out");
        let mut merge = Merge::new(&out).recipe("swap-language-model").option("scale", "keep");
        merge = merge.donor("vision", all.path().join("internvl")).donor("language", all.path().join("llama"));
        let merge = merge.option("projector", "reinit").loader("4.57.6").unwrap();
        let report = merge.run().unwrap_or_else(|e| panic!("{e}")).merge.unwrap();
        assert_eq!(report.stage, Some(MergeStage::Written), "{:?}", report.seams);
        let config: Value = serde_json::from_slice(&fs::read(out.join("config.json")).unwrap()).unwrap();
        let stated = config["text_config"]["logits_scaling"].as_f64();
        let note = report.notes.iter().any(|note| note.contains("no longer tied to the embedding"));
        assert_eq!((stated, note), (Some(1.0), is_tied));
        assert_eq!(
            (&config["tie_word_embeddings"], &config["text_config"]["tie_word_embeddings"]),
            (&false.into(), &false.into())
        );
        let last = |tensors: &Tensors, end: &str| {
            let (_, (dtype, _, bytes)) = tensors.iter().find(|(name, _)| name.ends_with(end)).unwrap();
            values(dtype, bytes).unwrap()
        };
        let (donor, result) = (read(&all.path().join("llama")), read(&out));
        let of = if is_tied { "model.embed_tokens.weight" } else { "lm_head.weight" };
        let (before, after) = (last(&donor, of), last(&result, "lm_head.weight"));
        assert!(before.len() <= after.len());
        assert!(before.iter().zip(&after).all(|(before, after)| (before / 8.0 - after).abs() <= after.abs() / 256.0));
        let rows = last(&result, "embed_tokens.weight");
        assert!(
            last(&donor, "model.embed_tokens.weight")
                .iter()
                .zip(&rows)
                .all(|(before, after)| before.total_cmp(after).is_eq())
        );
    }
}

/// The guest `llama` of these donors, as a Falcon with a tied head: its tensors have other names.
fn as_falcon(dir: &Path) {
    let config = json!({
        "architectures": ["FalconForCausalLM"], "model_type": "falcon", "transformers_version": "4.57.6", "torch_dtype": "float32",
        "vocab_size": 300, "hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 4, "num_kv_heads": 2,
        "new_decoder_architecture": true, "bias": false, "tie_word_embeddings": true, "bos_token_id": 1, "eos_token_id": 2,
    });
    fs::write(dir.join("config.json"), config.to_string()).unwrap();
    tensors(dir, 1, &knowledge());
}

#[test]
fn a_language_model_keeps_its_own_names_in_a_host_and_out_of_it() {
    let (all, work) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    write(all.path());
    as_falcon(&all.path().join("llama"));
    let (out, back) = (work.path().join("out"), work.path().join("back"));
    let merge = Merge::new(&out).recipe("swap-language-model").option("projector", "reinit").option("scale", "keep");
    let merge = merge.donor("vision", all.path().join("internvl")).donor("language", all.path().join("llama"));
    let report = merge.clone().loader("4.57.6").unwrap().run().unwrap();
    let mut findings = report.checkpoints.iter().flat_map(|checkpoint| &checkpoint.findings);
    assert!(findings.any(|finding| finding.code == "CFG028"));
    assert_eq!(report.merge.unwrap().stage, Some(MergeStage::Planned));
    written(&merge.loader("5.23.0").unwrap(), &out);
    let (guest, result) = (read(&all.path().join("llama")), read(&out));
    let named = |inside: &str| format!("model.language_model.{inside}");
    let layer = |tensors: &Tensors, name: &str| tensors.get(name).unwrap_or_else(|| panic!("{name}")).clone();
    for (name, tensor) in guest.iter().filter(|(name, _)| name.contains(".h.")) {
        let inside = name.strip_prefix("transformer.").unwrap();
        assert_eq!(layer(&result, &named(inside)), *tensor, "{name}");
    }
    // The head is the embedding, as a tensor of its own.
    assert_eq!(layer(&result, "lm_head.weight"), layer(&result, &named("word_embeddings.weight")));
    let extract = Merge::new(&back).recipe("extract").donor("model", &out).option("part", "language");
    written(&extract.loader("5.23.0").unwrap(), &back);
    let again = read(&back);
    assert!(guest.keys().all(|name| again.contains_key(name)), "{:?}", again.keys());
}

#[test]
fn a_chat_template_writes_what_the_processor_needs_for_an_image() {
    let (all, work) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    write(all.path());
    let template = as_granite(&all.path().join("llama"), false);
    let out = work.path().join("out");
    let merge = Merge::new(&out).recipe("swap-language-model").option("projector", "reinit").option("scale", "keep");
    let merge = merge.donor("vision", all.path().join("internvl")).donor("language", all.path().join("llama"));
    written(&merge.loader("5.23.0").unwrap(), &out);
    let text = fs::read_to_string(out.join("chat_template.jinja")).unwrap();
    assert!(text.ends_with(&template) && text.contains(r#"turn.text ~ "<IMG_CONTEXT>\n""#), "{text}");
    for name in ["chat_template.json", "tokenizer_config.json"] {
        let document: Value = serde_json::from_slice(&fs::read(out.join(name)).unwrap()).unwrap();
        assert_eq!(document["chat_template"], text, "{name}");
    }
    let mut engine = minijinja::Environment::new();
    engine
        .set_syntax(minijinja::syntax::SyntaxConfig::builder().trim_blocks(true).lstrip_blocks(true).build().unwrap());
    let parts = vec![context! { type => "image" }, context! { type => "text", text => "what is it?" }];
    let first = context! { role => "system", content => "be brief" };
    let chat = context! { messages => vec![first, context! { role => "user", content => parts }] };
    let written = engine.render_str(&text, chat).unwrap();
    assert_eq!(written, "[system] be brief[user] <IMG_CONTEXT>\nwhat is it?");
}

/// The plan of a host of `all` with the language model of another model there.
fn planned(all: &Path, host: &str, guest: &str, version: &str) -> MergeReport {
    let out = all.join("out");
    let merge = Merge::new(&out).recipe("swap-language-model").option("projector", "reinit").option("scale", "keep");
    let merge = merge.donor("vision", all.join(host)).donor("language", all.join(guest));
    merge.loader(version).unwrap().plan().unwrap().merge.unwrap()
}

/// LLaVA's processor opens tokenizer.json as it is in transformers 5, and a Qwen2 alone builds its tokenizer itself.
#[test]
fn a_tokenizer_that_a_version_opens_in_another_way_is_told() {
    let all = TempDir::new().unwrap();
    write(all.path());
    let notes = |host: &str, version: &str| {
        let notes = planned(all.path(), host, "qwen2-vl", version).notes;
        notes.into_iter().filter(|note| note.contains("opens tokenizer.json")).collect::<Vec<_>>()
    };
    assert_eq!(notes("llava", "4.57.6"), Vec::<String>::new());
    let told = notes("llava", "5.23.0");
    assert!(
        told.len() == 1 && told[0].contains("as it is in the result, and as Qwen2Tokenizer in its donor"),
        "{told:?}"
    );
    assert_eq!(notes("qwen2.5-vl", "5.23.0"), Vec::<String>::new());
}

/// The language model may come from a model that sees, too; prompts are those of the host.
#[test]
fn a_prompt_is_written_for_the_host() {
    let all = TempDir::new().unwrap();
    write(all.path());
    for (host, text) in [("llava", r#"text = "<image>\nWhat is in the picture?""#), ("paligemma", r#"text = "What is"#)]
    {
        let prompt = planned(all.path(), host, "qwen2-vl", "4.57.6").prompt;
        assert!(prompt.iter().any(|line| line.starts_with(text)), "{host}: {prompt:?}");
    }
}

/// Transformers 4.57 writes `architectures` of a Qwen2-VL into its text config, which the guest's replaces.
#[test]
fn a_result_names_the_class_of_a_host_that_does_not() {
    let (all, work) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    write(all.path());
    let path = all.path().join("qwen2.5-vl/config.json");
    let mut config: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let class = config.as_object_mut().unwrap().remove("architectures").unwrap();
    fs::write(&path, config.to_string()).unwrap();
    let out = work.path().join("out");
    let mut merge = Merge::new(&out).recipe("swap-language-model").option("projector", "reinit");
    merge = merge.donor("vision", all.path().join("qwen2.5-vl")).donor("language", all.path().join("qwen2"));
    written(&merge.loader("4.57.6").unwrap(), &out);
    let config: Value = serde_json::from_slice(&fs::read(out.join("config.json")).unwrap()).unwrap();
    assert_eq!(config["architectures"], class);
}

#[test]
fn a_pair_that_no_test_runs_was_not_tried() {
    let all = TempDir::new().unwrap();
    write(all.path());
    as_granite(&all.path().join("llama"), false);
    // A model that no test puts into a host.
    let ernie = all.path().join("ernie");
    copy(&all.path().join("llama"), &ernie);
    let mut config: Value = serde_json::from_slice(&fs::read(ernie.join("config.json")).unwrap()).unwrap();
    config["model_type"] = json!("ernie4_5");
    config["architectures"] = json!(["Ernie4_5ForCausalLM"]);
    config["transformers_version"] = json!("5.23.0");
    fs::write(ernie.join("config.json"), config.to_string()).unwrap();
    tensors(&ernie, 1, &knowledge());
    let is_noted = |guest: &str| {
        let notes = planned(all.path(), "internvl", guest, "5.23.0").notes;
        assert!(!notes.is_empty(), "{guest} was not planned");
        notes.iter().any(|note| note.starts_with("Not tried"))
    };
    assert_eq!(["llama", "ernie"].map(is_noted), [false, true]);
}
