//! Architectures with custom code, compared with the tensors that this code builds.
//!
//! Each line of `remote-code.jsonl` is a model built from its own code on torch's meta device, under transformers
//! 4.47.0. A line contains a config with names and shapes, but no code of the repositories.

use std::collections::BTreeSet;

use ckpt_doctor::knowledge::{Expected, Library, Loader};
use serde_json::{Value, json};

use super::total_bytes;
use crate::support::data::{Map, Record, records};

/// Decoders of transformers that a part may have and that the library lacks.
const DECODERS: [(&str, &str); 2] = [
    (
        "Qwen2ForCausalLM",
        r#"{
          architecture: "qwen2", summary: "", model_types: ["qwen2"], sources: [], loaders: ["4.47.0"],
          let: { h: "c.hidden_size", kv: "h / c.num_attention_heads * c.num_key_value_heads", ff: "c.intermediate_size" },
          classes: [{
            class: "Qwen2ForCausalLM",
            tensors: {
              "model.embed_tokens": { weight: ["c.vocab_size", "h"] },
              "model.layers.{i}.": {
                repeat: { i: "c.num_hidden_layers" },
                tensors: {
                  "self_attn.q_proj": { weight: ["h", "h"], bias: "true" },
                  "self_attn.k_proj": { weight: ["kv", "h"], bias: "true" },
                  "self_attn.v_proj": { weight: ["kv", "h"], bias: "true" },
                  "self_attn.o_proj": { weight: ["h", "h"] },
                  "self_attn.rotary_emb.inv_freq": { buffer: true },
                  "mlp.gate_proj": { weight: ["ff", "h"] },
                  "mlp.up_proj": { weight: ["ff", "h"] },
                  "mlp.down_proj": { weight: ["h", "ff"] },
                  "input_layernorm": { weight: ["h"] },
                  "post_attention_layernorm": { weight: ["h"] },
                },
              },
              "model.norm": { weight: ["h"] },
              "model.rotary_emb.inv_freq": { buffer: true },
              "lm_head": { weight: ["c.vocab_size", "h"] },
            },
          }],
        }"#,
    ),
    (
        "Phi3ForCausalLM",
        r#"{
          architecture: "phi3", summary: "", model_types: ["phi3"], sources: [], loaders: ["4.47.0"],
          let: { h: "c.hidden_size", kv: "h / c.num_attention_heads * c.num_key_value_heads", ff: "c.intermediate_size" },
          classes: [{
            class: "Phi3ForCausalLM",
            tensors: {
              "model.embed_tokens": { weight: ["c.vocab_size", "h"] },
              "model.layers.{i}.": {
                repeat: { i: "c.num_hidden_layers" },
                tensors: {
                  "self_attn.o_proj": { weight: ["h", "h"] },
                  "self_attn.qkv_proj": { weight: ["h + 2 * kv", "h"] },
                  "mlp.gate_up_proj": { weight: ["2 * ff", "h"] },
                  "mlp.down_proj": { weight: ["h", "ff"] },
                  "input_layernorm": { weight: ["h"] },
                  "post_attention_layernorm": { weight: ["h"] },
                },
              },
              "model.norm": { weight: ["h"] },
              "lm_head": { weight: ["c.vocab_size", "h"] },
            },
          }],
        }"#,
    ),
];

fn library() -> Library {
    let mut library = Library::embedded();
    for (class, text) in DECODERS {
        if library.class(class, Loader::V4_47_0).is_none() {
            library.add(class, text).expect("parses");
        }
    }
    library
}

fn expect(config: &Value) -> Expected {
    let library = library();
    let architecture = library.find(config, [], Loader::V4_47_0).expect("a known architecture");
    architecture.expect(config).unwrap_or_else(|e| panic!("{config}: {e:?}"))
}

fn found(config: &Value, loader: Loader) -> Option<String> {
    Library::embedded().find(config, [], loader).map(|a| a.name().to_owned())
}

fn shapes(expected: &Expected) -> Map {
    expected.tensors.iter().map(|(name, tensor)| (name.clone(), tensor.shape.clone())).collect()
}

/// The record of the class with this config value at a JSON pointer.
fn record(class: &str, pointer: &str, value: &Value) -> Record {
    let mut all = records("remote-code").into_iter();
    all.find(|r| r.class == class && r.config.pointer(pointer) == Some(value)).expect("a record")
}

#[test]
fn every_class_builds_what_its_own_code_builds() {
    let mut architectures = BTreeSet::new();
    let mut seen = 0;
    for record in records("remote-code") {
        let expected = expect(&record.config);
        let (built, state_dict) = (shapes(&expected), record.state_dict());
        let differ: Vec<_> = built.iter().filter(|(n, s)| state_dict.get(*n) != Some(*s)).take(9).collect();
        let lacking: Vec<_> = state_dict.keys().filter(|n| !built.contains_key(*n)).take(9).collect();
        assert!(differ.is_empty() && lacking.is_empty(), "{}: differ {differ:#?}, lacking {lacking:#?}", record.config);
        let ties = expected.tensors.iter().filter_map(|(n, t)| Some(vec![n.clone(), t.tied_to.clone()?]));
        assert_eq!(ties.collect::<Vec<_>>(), record.tied, "{}", record.config);
        // InternVL contains a copy of Phi-3 whose rotary embeddings are not buffers; in the class of transformers they
        // are.
        let copied = record.config.pointer("/llm_config/model_type") == Some(&"phi3".into());
        if let Some(buffers) = record.buffers.filter(|_| !copied) {
            assert_eq!(expected.buffers.into_iter().collect::<Vec<_>>(), buffers, "{}", record.config);
        }
        architectures.insert(expected.architecture);
        seen += 1;
    }
    let all = [
        "chatglm",
        "chatglm_6b",
        "deepseek_v2_remote",
        "deepseek_vl_v2",
        "florence2_remote",
        "intern_vit_6b",
        "internlm2",
        "internvl_chat",
        "minicpm",
        "minicpmv",
        "minicpmv_2",
        "minicpmv_2_5",
        "molmo",
        "openvla",
        "qwen",
    ];
    assert_eq!(architectures.iter().map(String::as_str).collect::<Vec<_>>(), all);
    assert_eq!(seen, 48, "records");
}

#[test]
fn published_indexes_have_the_bytes_that_follow_from_the_config() {
    // `metadata.total_size` of the published index, with two bytes per element. ChatGLM-6B stores its layer norms with
    // four bytes, and stores the tied head as well.
    let (norms, head) = (4096 * (28 * 4 + 2) * 2, 150_528 * 4096 * 2);
    for (class, pointer, value, total) in [
        ("ChatGLMModel", "/seq_length", json!(8192), 12_487_168_064),
        ("ChatGLMModel", "/vocab_size", json!(150_528), 13_744_473_856 - norms - head),
        ("QWenLMHeadModel", "/seq_length", json!(8192), 15_442_649_088),
        ("InternLM2ForCausalLM", "/vocab_size", json!(92_544), 15_475_417_088),
        ("MiniCPMV", "/vocab_size", json!(122_753), 6_869_931_584),
        ("OpenVLAForActionPrediction", "/text_config/vocab_size", json!(32_064), 15_082_474_368),
        // The index of a quantised model states the number of parameters.
        ("MolmoForCausalLM", "/vocab_size", json!(152_064), 2 * 8_021_025_280),
    ] {
        let expected = expect(&record(class, pointer, &value).config);
        assert_eq!(total_bytes(&expected, 2), Some(total), "{class} {value}");
    }
}

#[test]
fn the_config_distinguishes_classes_of_one_name() {
    let named = |class: &str, model_type: &str, more: Value| {
        let mut config = json!({ "architectures": [class], "model_type": model_type, "auto_map": {} });
        config.as_object_mut().expect("object").extend(more.as_object().expect("object").clone());
        found(&config, Loader::V4_47_0)
    };
    let some = |name: &str| Some(name.to_owned());
    assert_eq!(named("ChatGLMModel", "chatglm", json!({})), some("chatglm"));
    assert_eq!(named("ChatGLMModel", "chatglm", json!({ "position_encoding_2d": true })), some("chatglm_6b"));
    assert_eq!(
        named("ChatGLMModel", "chatglm", json!({ "position_encoding_2d": true, "pre_seq_len": 128 })),
        None,
        "later code of the first generation, which is not known"
    );
    let v2 = json!({ "hidden_size": 2304, "query_num": 64 });
    assert_eq!(named("MiniCPMV", "minicpmv", v2), some("minicpmv_2"));
    assert_eq!(named("MiniCPMV", "minicpmv", json!({ "hidden_size": 4096, "query_num": 96 })), some("minicpmv_2_5"));
    assert_eq!(named("MiniCPMV", "minicpmv", json!({ "version": 2.6, "query_num": 64 })), some("minicpmv"));
    assert_eq!(named("MiniCPMV", "minicpmv", json!({ "version": 4.5, "query_num": 64 })), None);
    assert_eq!(named("MolmoForCausalLM", "molmo", json!({ "moe_num_experts": 64 })), None);
    assert_eq!(named("DeepseekOCRForCausalLM", "deepseek_vl_v2", json!({})), None);
    assert_eq!(named("InternVLChatModel", "internvl_chat", json!({})), some("internvl_chat"));
    assert_eq!(named("InternVLChatModel", "internvl_chat", json!({ "use_llm_lora": 16 })), None);
    let qwen3 = json!({ "llm_config": { "model_type": "qwen3" } });
    assert_eq!(named("InternVLChatModel", "internvl_chat", qwen3), None);
}

#[test]
fn remote_code_is_known_for_the_loaders_it_was_built_with() {
    let config = json!({ "architectures": ["InternLM2ForCausalLM"], "model_type": "internlm2", "auto_map": {} });
    assert_eq!(found(&config, Loader::V4_47_0).as_deref(), Some("internlm2"));
    assert_eq!(found(&config, Loader::V5_23_0), None, "its code raises there");
    // transformers 5 has its own classes of these names, with other tensors.
    for (class, model_type, own) in [
        ("Florence2ForConditionalGeneration", "florence2", "florence2_remote"),
        ("DeepseekV2ForCausalLM", "deepseek_v2", "deepseek_v2_remote"),
    ] {
        let config = json!({ "architectures": [class], "model_type": model_type });
        assert_eq!(found(&config, Loader::V4_47_0).as_deref(), Some(own));
        assert_ne!(found(&config, Loader::V5_23_0).as_deref(), Some(own));
    }
}

#[test]
fn transformers_5_does_not_tie_what_remote_code_does_not_declare() {
    let library = Library::embedded();
    let config = json!({ "architectures": ["QWenLMHeadModel"], "tie_word_embeddings": true, "num_hidden_layers": 1 });
    for (loader, tied) in [(Loader::V4_47_0, true), (Loader::V5_23_0, false)] {
        let expected = library.find(&config, [], loader).expect("known").expect(&config).expect("built");
        assert_eq!(expected.tensors.get("lm_head.weight").expect("a head").tied_to.is_some(), tied, "{loader}");
    }
}

#[test]
fn remote_configs_are_refused_with_a_message() {
    let refuse = |config: Value| {
        let library = Library::embedded();
        let architecture = library.find(&config, [], Loader::V4_47_0).expect("known");
        architecture.expect(&config).expect_err("refused").to_string()
    };
    let openvla = |id: &str| json!({ "architectures": ["OpenVLAForActionPrediction"], "vision_backbone_id": id });
    assert_eq!(refuse(openvla("vit")), "vision_backbone_id is vit, which the class does not know");
    let qwen = json!({ "architectures": ["QWenLMHeadModel"], "visual": {} });
    let refusal = refuse(qwen);
    assert!(refusal.contains("visual"), "{refusal}");
    let florence =
        json!({ "architectures": ["Florence2ForConditionalGeneration"], "vision_config": { "depths": [1] } });
    assert!(refuse(florence).starts_with("vision_config lacks one of dim_embed"));
    let deepseek = json!({ "architectures": ["DeepseekVLV2ForCausalLM"] });
    assert_eq!(refuse(deepseek), "tile_tag is tile_tag; the class builds 2D");
}
