//! Values that a class refuses, in configs alone.

use std::sync::Arc;

use ckpt_doctor::check::check;
use ckpt_doctor::checkpoint::{Checkpoint, MemoryFiles, Source};
use serde_json::{Value, json};

use crate::support::knowledge;

/// Pointers of the values that are refused.
fn refused(config: &Value) -> Vec<String> {
    reported(config, "CFG026")
}

/// Pointers of the findings of a rule.
fn reported(config: &Value, code: &str) -> Vec<String> {
    let files = [("config.json".to_owned(), config.to_string().into_bytes())];
    let checkpoint = Checkpoint::read(Source::Memory(MemoryFiles::new("model", files))).unwrap();
    let outcome = check(&Arc::new(checkpoint), &knowledge());
    let own = outcome.findings.into_iter().filter(|finding| finding.code == code);
    own.flat_map(|finding| finding.locations).filter_map(|location| location.pointer).collect()
}

/// `CLIPConfig` of transformers 4.47.0 and 4.57.6 takes the part from `text_config_dict` where there is one.
#[test]
fn a_part_that_another_one_replaces_refuses_nothing() {
    let part = json!({ "torch_dtype": "swoosh", "hidden_act": "swoosh" });
    let mut config = json!({ "architectures": ["CLIPModel"], "model_type": "clip", "transformers_version": "4.47.0",
        "text_config": part, "vision_config": {} });
    let found = refused(&config);
    assert!(found.iter().any(|at| at == "/text_config/torch_dtype"), "{found:?}");
    assert!(found.iter().any(|at| at == "/text_config/hidden_act"), "{found:?}");
    config["text_config_dict"] = json!({ "hidden_size": 512 });
    assert_eq!(refused(&config), [] as [&str; 0]);
}

/// `PreTrainedConfig.validate_rope` of transformers 5.23.0: a class without a rope does not fill in the length.
#[test]
fn a_rope_of_a_class_without_one_needs_its_length() {
    let with = |class: &str, model_type: &str, rope: Value| json!({ "architectures": [class], "model_type": model_type, "transformers_version": "5.23.0", "rope_scaling": rope });
    let yarn = json!({ "rope_type": "yarn", "factor": 4.0 });
    let whole = json!({ "rope_type": "yarn", "factor": 4.0, "original_max_position_embeddings": 32 });
    assert_eq!(refused(&with("GPT2LMHeadModel", "gpt2", yarn.clone())), ["/rope_scaling"]);
    assert_eq!(refused(&with("GPT2LMHeadModel", "gpt2", json!({ "rope_type": "yarn" }))), ["/rope_scaling"]);
    assert_eq!(refused(&with("GPT2LMHeadModel", "gpt2", whole)), [] as [&str; 0]);
    assert_eq!(refused(&with("LlamaForCausalLM", "llama", yarn)), [] as [&str; 0]);
}

/// 4.47 writes of a part what differs from its defaults; the activation is looked up all the same.
#[test]
fn the_activation_of_a_part_is_looked_up_in_every_version() {
    for version in ["4.47.0", "4.57.6", "5.23.0"] {
        let config = json!({ "architectures": ["Idefics3ForConditionalGeneration"], "model_type": "idefics3",
            "transformers_version": version, "text_config": { "model_type": "llama", "hidden_act": "swoosh" },
            "vision_config": { "hidden_act": "gelu" } });
        assert_eq!(refused(&config), ["/text_config/hidden_act"], "{version}");
    }
}

/// `HubertModel` of transformers 4.47.0 raises where its three lists of convolutions differ in length.
#[test]
fn a_list_of_another_length_than_those_beside_it_is_refused() {
    let with = |dims: &[u64], strides: &[u64]| {
        json!({ "architectures": ["HubertModel"], "model_type": "hubert", "transformers_version": "4.47.0",
            "conv_dim": dims, "conv_stride": strides, "conv_kernel": [10, 3], "num_feat_extract_layers": 2 })
    };
    assert_eq!(refused(&with(&[8, 8], &[5, 2])), [] as [&str; 0]);
    assert_eq!(refused(&with(&[8, 8, 8], &[5, 2])), ["/conv_dim"]);
    assert_eq!(refused(&with(&[8, 8], &[5])), ["/conv_stride"]);
}

/// Config classes refuse a `problem_type` that they do not know, in their parts as well: `PretrainedConfig.__init__` of 4.57.6.
#[test]
fn a_part_refuses_what_every_config_does() {
    let with = |model_type: &str, class: &str, value: &Value| {
        json!({ "architectures": [class], "model_type": model_type, "transformers_version": "4.57.6",
            "text_config": { "model_type": "bert", "problem_type": value }, "vision_config": {} })
    };
    let classes = [("qwen2_5_vl", "Qwen2_5_VLForConditionalGeneration"), ("llava", "LlavaForConditionalGeneration")];
    for (model_type, class) in classes {
        for value in [json!(true), json!("x")] {
            assert_eq!(refused(&with(model_type, class, &value)), ["/text_config/problem_type"], "{class} {value}");
        }
        for value in [json!(null), json!("regression")] {
            assert_eq!(refused(&with(model_type, class, &value)), [] as [&str; 0], "{class} {value}");
        }
    }
    // Not a config, but an object that the class keeps.
    assert_eq!(refused(&with("bert", "BertModel", &json!(true))), [] as [&str; 0]);
}

/// A generation config is made of the config of a class that can generate: `GenerationConfig.from_model_config`.
#[test]
fn values_of_generation_are_refused_by_classes_that_generate() {
    let with = |class: &str, value: Value| json!({ "architectures": [class], "model_type": "llama", "transformers_version": "4.57.6", "early_stopping": value });
    assert_eq!(refused(&with("LlamaForCausalLM", json!(1.5))), ["/early_stopping"]);
    assert_eq!(refused(&with("LlamaForCausalLM", json!("never"))), [] as [&str; 0]);
    assert_eq!(refused(&with("LlamaModel", json!(1.5))), [] as [&str; 0]);
}

/// The frequencies of `yarn` are computed of `head_dim`, which `MixtralConfig` leaves at `None` (4.57.6 and 5.23.0).
#[test]
fn a_type_of_rope_may_need_a_key() {
    let with = |head_dim: Value| {
        json!({ "architectures": ["MixtralForCausalLM"], "model_type": "mixtral", "transformers_version": "4.57.6",
            "head_dim": head_dim, "rope_scaling": { "rope_type": "yarn", "factor": 2.0 } })
    };
    assert_eq!(refused(&with(Value::Null)), ["/rope_scaling"]);
    assert_eq!(refused(&with(json!(128))), [] as [&str; 0]);
}

/// `AutoModel` opens the language model in the directory of the whole: the values outside `text_config` are not its own.
#[test]
fn the_class_of_a_part_reads_the_config_inside() {
    let with = |whole: Value, part: Value| {
        json!({ "architectures": ["MllamaTextModel"], "model_type": "mllama", "transformers_version": "4.57.6",
            "hidden_size": whole, "vision_config": {},
            "text_config": { "model_type": "mllama_text_model", "hidden_size": part } })
    };
    assert_eq!(refused(&with(json!("x"), json!(64))), [] as [&str; 0]);
    assert_eq!(refused(&with(json!(64), json!("x"))), ["/text_config/hidden_size"]);
    let mut config = with(json!(64), json!(64));
    config["text_config"]["torch_dtype"] = "swoosh".into();
    assert_eq!(refused(&config), ["/text_config/torch_dtype"]);
}

/// `JambaConfig._check_supported_offset` of transformers 4.57.6; the period is 8 where the config has none.
#[test]
fn a_number_that_has_to_be_smaller_than_another_is_refused() {
    let with = |offset: u64, period: Value| {
        let mut config = json!({ "architectures": ["JambaForCausalLM"], "model_type": "jamba",
            "transformers_version": "4.57.6", "attn_layer_offset": offset });
        if period.is_number() {
            config["attn_layer_period"] = period;
        }
        config
    };
    for (offset, period) in [(4, json!(8)), (7, json!(null)), (9, json!(10))] {
        assert_eq!(refused(&with(offset, period.clone())), [] as [&str; 0], "{offset} {period}");
    }
    for (offset, period) in [(4, json!(4)), (8, json!(null)), (11, json!(10))] {
        assert_eq!(refused(&with(offset, period.clone())), ["/attn_layer_offset"], "{offset} {period}");
    }
}

/// transformers 5 compares `layer_types` in every config that it makes. An object that `BertConfig` keeps is none.
#[test]
fn layer_types_are_counted_in_configs_alone() {
    let with = |model_type: &str, class: &str| {
        json!({ "architectures": [class], "model_type": model_type, "transformers_version": "5.23.0",
            "text_config": { "model_type": "llama", "num_hidden_layers": 2, "layer_types": ["full_attention"] } })
    };
    assert_eq!(reported(&with("llava", "LlavaForConditionalGeneration"), "CFG040").len(), 2);
    assert_eq!(reported(&with("bert", "BertModel"), "CFG040"), [] as [&str; 0]);
}
