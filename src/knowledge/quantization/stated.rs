//! Every place where a config says that weights are quantised, whether or not a loader reads it.

use serde_json::Value;

use crate::checkpoint::pointer;

/// Keys whose object describes quantised weights. `compression_config` is what compressed-tensors wrote before 2024-08; MLX
/// writes `quantization`, a name that audio codecs have for other things.
const BLOCKS: [&str; 3] = ["quantization_config", "compression_config", "quantization"];

/// Keys that a block of MLX has.
const OF_MLX: [&str; 2] = ["bits", "group_size"];

/// The first place, with its JSON pointer and the method that it names. Called for donors of merges, which are refused whatever
/// loader reads the place.
#[must_use]
pub fn stated(config: &Value) -> Option<(String, &str)> {
    let mut left = vec![(String::new(), config)];
    while let Some((at, value)) = left.pop() {
        let Value::Object(map) = value else { continue };
        if let Some(method) = map.get("quant_method").and_then(Value::as_str) {
            return Some((at, method));
        }
        let block = BLOCKS.into_iter().find(|key| map.get(*key).is_some_and(|block| is_block(key, block)));
        if let Some(key) = block {
            let method = map.get(key).and_then(|block| block.get("quant_method")?.as_str());
            return Some((pointer::join(&at, key), method.unwrap_or("no method is named")));
        }
        left.extend(map.iter().rev().map(|(key, value)| (pointer::join(&at, key), value)));
    }
    None
}

fn is_block(key: &str, block: &Value) -> bool {
    block.is_object() && (key != "quantization" || OF_MLX.iter().any(|own| block.get(own).is_some()))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_block_is_found_at_any_depth() {
        for (config, expected) in [
            (json!({}), None),
            (json!({ "quantization_config": null, "text_config": { "quantization_config": null } }), None),
            // Of a codec.
            (json!({ "quantization": { "codebook_size": 1024 } }), None),
            (json!({ "quantization_config": { "quant_method": "gptq" } }), Some(("/quantization_config", "gptq"))),
            (json!({ "quantization_config": {} }), Some(("/quantization_config", "no method is named"))),
            (json!({ "quantization": { "bits": 4 } }), Some(("/quantization", "no method is named"))),
            (
                json!({ "llm_config": { "quantization_config": { "quant_method": "awq" } } }),
                Some(("/llm_config/quantization_config", "awq")),
            ),
            (json!({ "a": { "b": { "quant_method": "fp8" } } }), Some(("/a/b", "fp8"))),
        ] {
            let found = stated(&config);
            assert_eq!(found.as_ref().map(|(at, method)| (at.as_str(), *method)), expected, "{config}");
        }
    }
}
