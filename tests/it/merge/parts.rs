//! Parts of models: what `rules/parts/` says of them against what the architectures build.

use std::collections::BTreeMap;

use ckpt_doctor::knowledge::parts::ModelParts;
use ckpt_doctor::knowledge::{Architecture, Knowledge, Loader};
use serde_json::{Value, json};

/// Keys that add tensors to a part, or rows to them.
const SIZES: [&str; 3] = ["vocab_size", "num_hidden_layers", "depth"];

/// Shapes of the tensors of a class by name; none when the class cannot be built from this config.
fn shapes(class: Architecture<'_>, config: &Value) -> Option<BTreeMap<String, Vec<u64>>> {
    let tensors = class.expect(config).ok()?.tensors;
    Some(tensors.into_iter().map(|(name, tensor)| (name, tensor.shape)).collect())
}

/// The part that a tensor of a class belongs to, in the layout that names it so.
fn part_of(model: &ModelParts, name: &str) -> Option<String> {
    model.all_layouts().find_map(|layout| layout.locate(name).map(|(part, _)| part.to_owned()))
}

/// Each tensor of a class belongs to a part, and a config of a part that changes changes the tensors of that part alone, or of
/// parts without a config of their own.
#[test]
fn parts_stand_where_the_architectures_build_them() {
    let knowledge = Knowledge::embedded().unwrap();
    let mut changed: BTreeMap<&str, usize> = BTreeMap::new();
    for model in knowledge.parts.iter() {
        for (architecture, loader) in model.architectures.iter().flat_map(|a| Loader::ALL.map(|loader| (a, loader))) {
            let config = json!({ "model_type": architecture });
            let Some(class) = knowledge.library.find(&config, [], loader) else { continue };
            let Ok(built) = class.expect(&config) else { continue };
            let before = shapes(class, &built.config).unwrap_or_default();
            let strays: Vec<&String> = before.keys().filter(|name| part_of(model, name).is_none()).collect();
            assert!(
                strays.iter().all(|name| !name.contains("layers.") && !name.contains("embed_tokens")),
                "{architecture} {loader}: {strays:?} belong to no part"
            );
            for (name, part) in &model.parts {
                let Some(at) = part.pointer(&built.config) else { continue };
                for pointer in SIZES.map(|key| format!("{at}/{key}")) {
                    let mut config = built.config.clone();
                    let Some(size) = config.pointer(&pointer).and_then(Value::as_u64) else { continue };
                    *config.pointer_mut(&pointer).unwrap() = json!(size + 1);
                    let after = shapes(class, &config).unwrap_or_default();
                    for (tensor, _) in after.iter().filter(|(tensor, shape)| before.get(*tensor) != Some(shape)) {
                        let own = part_of(model, tensor).unwrap_or_default();
                        let has_none = model.parts.get(&own).is_some_and(|part| part.config.is_empty());
                        assert!(own == *name || has_none, "{architecture} {loader} {pointer}: {tensor} is of {own}");
                        *changed.entry(&model.model).or_default() += 1;
                    }
                }
            }
        }
    }
    for model in [
        "aya_vision",
        "deepseek_vl",
        "gemma3",
        "glm4v",
        "idefics3",
        "internvl",
        "llava",
        "llava_next_video",
        "llava_onevision",
        "mistral3",
        "paligemma",
        "qwen2_5_vl",
        "qwen2_vl",
        "qwen3_vl",
        "video_llava",
        "vipllava",
        "clip",
    ] {
        assert!(changed.get(model).is_some_and(|count| *count > 10), "{model}: {changed:?}");
    }
}
