//! Row J7: invalid config values, on a known class.

use serde_json::{Value, json};

use super::{Case, bounded, case};

const CONFIG: &str = "config.json";

pub fn cases() -> Vec<Case> {
    let set = |name: &str, codes, pointer: &'static str, value: Value| {
        case("J7", name, codes, "", move |d| d.set(pointer, &value))
    };
    let mut cases = vec![
        set("no heads", "ARC002", "/num_attention_heads", json!(0)),
        set("2^31 layers", "ARC002", "/num_hidden_layers", json!(1_u64 << 31)),
        set("2^63 layers", "ARC002", "/num_hidden_layers", json!(1_u64 << 63)),
        set("2^64 - 1 layers", "ARC002", "/num_hidden_layers", json!(u64::MAX)),
        set("ten thousand layers", "ARC002", "/num_hidden_layers", json!(10_000)),
        set("-1 layers", "ARC002", "/num_hidden_layers", json!(-1)),
        set("a string of layers", "ARC002", "/num_hidden_layers", json!("2")),
        set("2^63 wide", "ARC002", "/hidden_size", json!(1_u64 << 63)),
        set("2^53 wide", "CFG021", "/hidden_size", json!(1_u64 << 53)),
        set("2^32 rows", "CFG021", "/vocab_size", json!(1_u64 << 32)),
        set("the largest integer", "ARC002", "/hidden_size", json!(i64::MAX)),
        set("the smallest integer", "ARC002", "/hidden_size", json!(i64::MIN)),
    ];
    // The same invalid values for every key that determines sizes.
    let keys =
        ["hidden_size", "num_attention_heads", "num_key_value_heads", "head_dim", "intermediate_size", "vocab_size"];
    let values = [
        ("0", json!(0)),
        ("-1", json!(-1)),
        ("2^63", json!(1_u64 << 63)),
        ("1.5", json!(1.5)),
        ("1e308", json!(1e308)),
        ("null", json!(null)),
        ("a string", json!("16")),
        ("a list", json!([16])),
        ("an object", json!({ "a": 16 })),
        ("true", json!(true)),
    ];
    for key in keys {
        for (name, value) in values.clone() {
            cases.push(bounded("J7", format!("{key} is {name}"), move |d| d.set(&format!("/{key}"), &value)));
        }
    }
    for (name, key, value) in [
        ("architectures a string", "architectures", json!("LlamaForCausalLM")),
        ("architectures a number", "architectures", json!(7)),
        ("architectures empty", "architectures", json!([])),
        ("architectures of lists", "architectures", json!([["LlamaForCausalLM"]])),
        ("a hundred thousand classes", "architectures", json!(vec!["LlamaForCausalLM"; 100_000])),
        ("model_type an object", "model_type", json!({})),
        ("transformers_version a number", "transformers_version", json!(4.47)),
        ("transformers_version huge", "transformers_version", json!("99999999999999999999.9.9")),
        ("quantization_config a string", "quantization_config", json!("gptq")),
        (
            "quantization_config deep",
            "quantization_config",
            json!({ "quant_method": "gptq", "bits": 0, "group_size": 0 }),
        ),
        (
            "bits of 2^63",
            "quantization_config",
            json!({ "quant_method": "gptq", "bits": 1_u64 << 63, "group_size": -1 }),
        ),
        ("tied a string", "tie_word_embeddings", json!("yes")),
        ("eos a list of objects", "eos_token_id", json!([{}, null, -1])),
        ("rope_scaling a number", "rope_scaling", json!(2)),
        ("text_config itself a list", "text_config", json!([1])),
        ("pad_token_id 2^64 - 1", "pad_token_id", json!(u64::MAX)),
    ] {
        cases.push(bounded("J7", name, move |d| d.set(&format!("/{key}"), &value)));
    }
    for (name, file, pointer, value) in [
        (
            "token id 2^64 - 1",
            "tokenizer_config.json",
            "/added_tokens_decoder",
            json!({ "18446744073709551615": { "content": "<x>" } }),
        ),
        (
            "token ids that are words",
            "tokenizer_config.json",
            "/added_tokens_decoder",
            json!({ "x": {}, "-1": 7, "": null }),
        ),
        ("added tokens a list", "tokenizer_config.json", "/added_tokens_decoder", json!([1, 2])),
        ("a vocabulary of lists", "tokenizer.json", "/model", json!({ "vocab": [[1, 2], [], "x"] })),
        ("a vocabulary of negative ids", "tokenizer.json", "/model", json!({ "vocab": { "a": -1, "b": 1e9 } })),
        ("special tokens of numbers", "special_tokens_map.json", "/bos_token", json!(7)),
        ("generation of strings", "generation_config.json", "/eos_token_id", json!("2")),
    ] {
        cases.push(bounded("J7", name, move |d| {
            d.llama();
            d.edit(file, pointer, &value);
        }));
    }
    cases.push(case("J7", "an adapter of rank 0", "ADP009", "adapter_config.json", |d| {
        d.small();
        d.remove(CONFIG);
        d.put(
            "adapter_config.json",
            r#"{"peft_type": "LORA", "base_model_name_or_path": "x/y", "r": 0, "target_modules": ["q_proj"]}"#,
        );
    }));
    cases.push(bounded("J7", "an adapter of a pattern that backtracks", |d| {
        d.small();
        d.remove(CONFIG);
        let pattern = r"^(a+)+$|((.*)*)*\\1x";
        let config = format!(
            r#"{{"peft_type": "LORA", "base_model_name_or_path": "x/y", "r": 4, "target_modules": "{pattern}"}}"#
        );
        d.put("adapter_config.json", config);
        d.entries(
            &super::place::entry(&format!("base_model.model.{}!.lora_A.weight", "a".repeat(60)), "F32", "[4,1]", 0, 16),
            16,
        );
    }));
    cases
}
