//! Architectures against the tensor maps of real and tiny checkpoints, name for name and shape for shape.

use ckpt_doctor::knowledge::{Evidence, Expected, Library, Loader, Refusal};
use serde_json::{Value, json};

use super::total_bytes;
use crate::support::data::{Map, config, map, records};

fn expect(config: &Value, stored: &Map) -> Expected {
    let library = Library::embedded();
    let evidence: Evidence = stored.iter().map(|(name, shape)| (name.clone(), Some(shape.clone()))).collect();
    let architecture =
        library.find(config, stored.keys().map(String::as_str), Loader::V4_47_0).expect("a known architecture");
    architecture.expect_given(config, &evidence).unwrap_or_else(|e| panic!("{e:?}"))
}

fn shapes(expected: &Expected) -> Map {
    expected.tensors.iter().map(|(name, tensor)| (name.clone(), tensor.shape.clone())).collect()
}

/// Compares in small pieces, because a diff of a thousand lines is not readable.
fn assert_same(expected: &Map, stored: &Map, what: &str) {
    let missing: Vec<_> = expected.keys().filter(|n| !stored.contains_key(*n)).take(9).collect();
    let unexpected: Vec<_> = stored.keys().filter(|n| !expected.contains_key(*n)).take(9).collect();
    let other: Vec<_> = expected.iter().filter(|(n, s)| stored.get(*n).is_some_and(|t| t != *s)).take(9).collect();
    assert!(
        missing.is_empty() && unexpected.is_empty() && other.is_empty(),
        "{what}: missing {missing:#?}, unexpected {unexpected:#?}, other shape (as expected) {other:#?}"
    );
}

/// Builds from the config alone, and again with the stored names as evidence.
fn assert_predicted(config: &Value, name: &str, tensors: usize, bytes: u64) {
    let stored = map(name);
    for evidence in [&Map::new(), &stored] {
        let expected = expect(config, evidence);
        assert_same(&shapes(&expected), &stored, name);
        assert_eq!((expected.tensors.len(), total_bytes(&expected, 2)), (tensors, Some(bytes)), "{name}");
    }
}

#[test]
fn real_maps_follow_from_their_configs_alone() {
    assert_predicted(&config("spatialvla-4b-224"), "spatialvla-4b-224", 1382, 8_055_709_462);
    assert_predicted(&config("llava3d-7b"), "llava3d-7b", 698, 14_161_528_832);
    assert_predicted(&config("merged"), "merged", 1384, 15_224_707_862);
}

#[test]
fn a_merged_config_with_everything_off_is_the_minimal_map() {
    let mut config = config("merged");
    config["use_vision_zoe"] = json!(false);
    config["use_spatial_token"] = json!(false);
    config["text_config"]["vocab_size"] = json!(32000);
    assert_predicted(&config, "merged-minimal", 730, 14_311_161_312);
}

#[test]
fn wrapped_names_choose_the_wrapped_layout() {
    let mut config = config("merged");
    config["text_config"]["vocab_size"] = json!(32000);
    let stored = map("merged-wrapped");
    let expected = expect(&config, &stored);
    assert_eq!(expected.architecture, "spatialvla_wrapped");
    assert_same(&shapes(&expected), &stored, "merged-wrapped");
    assert_eq!(expected.tensors.len(), 731);
    assert_eq!(expect(&config, &Map::new()).architecture, "spatialvla");
}

#[test]
fn a_language_model_without_its_vision_tower_is_complete() {
    let config = config("llava3d-7b");
    let mut stored = map("llava3d-7b");
    stored.retain(|name, _| !name.starts_with("model.vision_tower."));
    let mut expected = expect(&config, &stored);
    expected.drop_absent_groups(|name| stored.contains_key(name));
    assert_same(&shapes(&expected), &stored, "without the tower");
    assert_eq!((expected.tensors.len(), total_bytes(&expected, 2)), (307, Some(13_554_513_920)));
}

#[test]
fn tiny_donors_follow_from_their_configs() {
    for name in ["spatialvla-tiny", "llava3d-tiny"] {
        let stored = map(name);
        assert_same(&shapes(&expect(&config(name), &stored)), &stored, name);
    }
}

#[test]
fn every_class_builds_the_state_dict_transformers_builds() {
    let mut seen = 0;
    for record in records("sample").into_iter().chain(records("omitted-keys")) {
        let expected = expect(&record.config, &Map::new());
        assert_same(&shapes(&expected), &record.state_dict(), &record.class);
        if let Some(buffers) = &record.buffers {
            assert_eq!(&expected.buffers.iter().cloned().collect::<Vec<_>>(), buffers, "{}", record.class);
            let ties = expected
                .tensors
                .iter()
                .filter_map(|(n, t)| Some(vec![n.clone(), t.tied_to.clone()?]))
                .collect::<Vec<_>>();
            assert_eq!(ties, record.tied, "{}", record.class);
        }
        seen += 1;
    }
    assert_eq!(seen, 15, "records");
}

#[test]
fn a_base_class_has_the_names_of_its_base_module() {
    let config = json!({ "architectures": ["LlamaModel"], "num_hidden_layers": 1, "tie_word_embeddings": true });
    let expected = expect(&config, &Map::new());
    assert_eq!(expected.tensors.len(), 11);
    assert!(expected.tensors.contains_key("layers.0.self_attn.q_proj.weight") && !expected.has_head);
    assert!(expected.buffers.contains("rotary_emb.inv_freq"));
}

#[test]
fn hostile_configs_are_refused_with_a_message() {
    let llama = |patch: Value| {
        let mut config = json!({ "architectures": ["LlamaForCausalLM"], "model_type": "llama" });
        config.as_object_mut().expect("object").extend(patch.as_object().expect("object").clone());
        Library::embedded().find(&config, [], Loader::V4_47_0).expect("llama").expect(&config)
    };
    for (patch, message) in [
        (json!({ "num_hidden_layers": 2_147_483_648_u64 }), "more than 60000 tensors"),
        (json!({ "num_hidden_layers": 199_999 }), "more than 60000 tensors"),
        (json!({ "num_attention_heads": 0 }), "num_attention_heads is 0"),
        (json!({ "num_attention_heads": null }), "num_attention_heads"),
        (json!({ "hidden_size": -1 }), "hidden_size is -1"),
        (json!({ "hidden_size": "4096" }), "hidden_size"),
        (
            json!({ "hidden_size": 9_223_372_036_854_775_807_i64, "head_dim": 128, "num_attention_heads": 1 }),
            "hidden_size",
        ),
        (json!({ "num_key_value_heads": 9_223_372_036_854_775_807_i64 }), "num_key_value_heads"),
        (json!({ "vocab_size": 1e300 }), "vocab_size"),
    ] {
        let refusal = llama(patch.clone()).expect_err(&patch.to_string()).to_string();
        assert!(refusal.contains(message), "{patch}: {refusal}");
    }
    assert!(Library::embedded().class("LlamaForCausalLM", Loader::NEWEST).expect("llama").expect(&json!([1])).is_err());
}

#[test]
fn compositions_name_the_part_that_cannot_be_built() {
    let library = Library::embedded();
    let refuse = |config: Value| {
        library.find(&config, [], Loader::V4_47_0).expect("known").expect(&config).expect_err("refused").to_string()
    };
    let refusal = refuse(
        json!({ "model_type": "spatialvla", "text_config": { "model_type": "mamba" } , "use_vision_zoe": false }),
    );
    assert_eq!(refusal, "text_config (model type mamba) is not known here");
    // Its defaults are evaluated on the part, and fail first.
    let refusal = refuse(json!({ "model_type": "llava", "text_config": { "model_type": "mamba_9" } }));
    assert_eq!(refusal, "text_config (model type mamba_9) is not known here");
    let refusal = refuse(json!({ "model_type": "spatialvla", "vision_zoe_config": null }));
    assert_eq!(refusal, "vision_zoe_config is null, which is not described here");
    let refusal = refuse(json!({ "model_type": "llava", "vision_config": { "patch_size": 0 } }));
    assert!(refusal.starts_with("vision_config") && refusal.contains("patch_size"), "{refusal}");
    let refusal = refuse(
        json!({ "model_type": "zoedepth", "bin_configurations": [{ "name": "x".repeat(2000), "n_bins": 1 }, { "name": "y", "n_bins": 1 }],
        "num_patch_transformer_layers": 0, "patch_transformer_hidden_size": 8 , "patch_transformer_intermediate_size": 8 }),
    );
    assert!(refusal.contains("a tensor name of"), "{refusal}");
}

/// `Florence2Config` opens its vision config as one class, whatever it names: 5.23.0 builds these 920 tensors.
#[test]
fn a_part_of_a_fixed_class_may_have_another_model_type() {
    let library = Library::embedded();
    let config = |model_type: &str| {
        json!({ "model_type": "florence2", "text_config": { "d_model": 1024 },
            "vision_config": { "model_type": model_type, "patch_size": [7, 3, 3, 3], "depths": [1, 1, 9, 1] } })
    };
    let class = library.find(&config("davit"), [], Loader::V5_23_0).expect("known");
    let shapes = |model_type: &str| -> Vec<_> {
        let expected = class.expect(&config(model_type)).expect("built");
        expected.tensors.into_iter().map(|(name, tensor)| (name, tensor.shape)).collect()
    };
    assert_eq!(shapes("davit").len(), 920);
    assert_eq!(shapes("davit"), shapes("florence_vision"));
}

/// `LlamaForTokenClassification` of 5.23.0 raises with such an object, and `LlamaModel` does not: neither is predicted.
#[test]
fn a_text_config_that_stays_an_object_is_told_apart() {
    let library = Library::embedded();
    let config = |model_type: &str| json!({ "model_type": model_type, "text_config": { "hidden_size": 8 } });
    let leaves = |class: &str, model_type: &str| {
        let class = library.class(class, Loader::V5_23_0).expect("known");
        class.leaves_text_config(&config(model_type))
    };
    assert!(leaves("LlamaForTokenClassification", "llama") && leaves("LlamaModel", "llama"));
    assert!(!leaves("LlavaForConditionalGeneration", "llava"));
}

#[test]
fn the_class_decides_unless_the_model_type_is_of_another() {
    let library = Library::embedded();
    let found = |config: Value| library.find(&config, [], Loader::V4_47_0).map(|a| a.name().to_owned());
    let some = |name: &str| Some(name.to_owned());
    // The Auto classes build LlamaForCausalLM for it.
    assert_eq!(found(json!({ "architectures": ["Gemma2ForCausalLM"], "model_type": "llama" })), some("llama"));
    assert_eq!(found(json!({ "architectures": ["Gemma2ForCausalLM"], "model_type": "not_described" })), some("gemma2"));
    assert_eq!(found(json!({ "model_type": "clip_vision_model" })), some("clip_vision_model"));
    assert_eq!(found(json!({ "architectures": ["LlamaForNothing"], "model_type": "llama" })), None);
    assert_eq!(
        found(
            json!({ "architectures": ["MyAlias"], "model_type": "spatialvla", "auto_map": { "AutoModel": "alias.MyAlias" } })
        ),
        some("spatialvla")
    );
    assert_eq!(found(json!({ "model_type": "unheard-of" })), None);
    assert_eq!(found(json!({})), None);
    assert_eq!(found(json!("config")), None);
}

#[test]
fn a_user_adds_an_architecture_or_replaces_one() {
    let mut library = Library::embedded();
    let text = r#"{ architecture: "mlp", summary: "", sources: [], loaders: ["4.47.0"],
        classes: [{ class: "Mlp", tensors: { "l.{i}": { repeat: { i: "c.n" }, weight: ["2", "3"], bias: "i > 0" } } }] }"#;
    library.add("mlp.json5", text).expect("parses");
    let config = json!({ "architectures": ["Mlp"], "n": 2 });
    let expected = library.find(&config, [], Loader::V4_47_0).expect("added").expect(&config).expect("built");
    assert_eq!(expected.tensors.keys().collect::<Vec<_>>(), ["l.0.weight", "l.1.weight", "l.1.bias"]);
    let endless = r#"{ architecture: "m", summary: "", sources: [], loaders: ["4.47.0"],
        classes: [{ class: "M", tensors: { "": { part: { class: "M" } } } }] }"#;
    library.add("m.json5", endless).expect("parses");
    let refused = library.class("M", Loader::V4_47_0).expect("added").expect(&json!({})).expect_err("a part of itself");
    assert_eq!(refused.to_string(), "it is not known here: parts are nested more than 8 deep");
    let error = library.add("mlp.json5", &text.replace("bias", "bais")).expect_err("misspelt");
    assert!(error.to_string().contains("bais"), "{error}");
}

/// Two files in the form of derived ones: a composition whose parts differ by loader.
fn small_library() -> Library {
    let mut library = Library::embedded();
    library
        .add(
            "tower.json5",
            r#"{
  architecture: "tower", summary: "", sources: [], model_types: ["tower"], loaders: ["4.47.0", "5.23.0"], derived: {},
  auto: { model: "TowerModel" },
  defaults: { width: 2, depth: 1 },
  by_loader: { "5.23.0": { defaults: { depth: 2 }, auto: { model: "TowerForAll" } } },
  conversions: { tower: [{ kind: "WeightRenaming", from: ["old"], to: ["new"] }], TowerForAll: "tower" },
  let: { w: "c.width", unused: "c.only_some_have_it" },
  classes: [
    {
      class: "TowerModel", base_model_prefix: "tower", ignore_missing: ["position_ids"],
      tensors: {
        "layers.{i}.": { repeat: { i: "c.depth" }, tensors: { "fc": { when: "i != 1 || major == 5", weight: ["w", "w"], bias: "major == 5" } } },
        "pooler": { weight: ["w"] },
        "ids": { buffer: true },
      },
    },
    { class: "TowerForAll", loaders: ["5.23.0"], tensors: { "body.": { part: { class: "TowerModel", set: { width: "=w + 1" }, without: ["pooler."] } } } },
  ],
}"#,
        )
        .expect("parses");
    library
        .add(
            "house.json5",
            r#"{
  architecture: "house", summary: "", sources: [], model_types: ["house"], loaders: ["4.47.0", "5.23.0"], derived: {},
  configs: { inner: { absent: {}, defaults: { name: "x" } , computed: { rooms: "7" } }, tower_config: { type: "tower", absent: { width: "=c.n" } } },
  conversions: { HouseModel: [{ kind: "PrefixChange", from: ["^a"], to: ["b"], prefix_to_remove: "a" }] },
  classes: [
    {
      class: "HouseModel", base_model_prefix: "model", ignore_unexpected: ["junk"],
      tensors: {
        "tower.": { part: { auto: "model", config: "tower_config" } },
        "side.": { model: "TowerModel", model_type: "tower", tensors: {
          "w": { shape: ["c.inner.rooms"] },
          "deep.": { model: "TowerBlock", model_type: "tower", tensors: { "b": { buffer: true } } },
        } },
        "head.w": { shape: ["1"], tied_to: "side.w" },
      },
    },
    { class: "HouseForSale", base_model_prefix: "model", base_module: true, tensors: { "model.": { part: { class: "HouseModel" } } } },
  ],
}"#,
        )
        .expect("parses");
    library
}

#[test]
fn a_composition_takes_its_parts_as_each_loader_builds_them() {
    let library = small_library();
    let config = json!({ "architectures": ["HouseForSale"], "n": 3, "tower_config": { "depth": null } });
    let built = |config: &Value, loader| library.find(config, [], loader).expect("known").expect(config);
    let refused =
        built(&config, Loader::V5_23_0).expect_err("depth is null, and what the class makes of that is not known");
    assert!(matches!(refused, Refusal::NotCovered(_)), "{refused:?}");
    let config = json!({ "architectures": ["HouseForSale"], "n": 3 });

    let old = built(&config, Loader::V4_47_0).expect("built");
    let names: Vec<(&str, &[u64])> = old.tensors.iter().map(|(n, t)| (n.as_str(), t.shape.as_slice())).collect();
    assert_eq!(
        names,
        [
            ("model.tower.layers.0.fc.weight", [3, 3].as_slice()),
            ("model.tower.pooler.weight", &[3]),
            ("model.side.w", &[7]),
            ("model.head.w", &[1]),
        ]
    );
    assert_eq!(old.tensors["model.head.w"].tied_to.as_deref(), Some("model.side.w"));
    assert_eq!((old.has_head, old.class.as_str(), old.model_type.as_str()), (true, "HouseForSale", "house"));
    assert!(old.conversions.is_empty() && old.ignore_unexpected.is_empty(), "of the class alone");

    let new = built(&config, Loader::V5_23_0).expect("built");
    let names: Vec<&String> = new.tensors.keys().collect();
    assert_eq!(
        names,
        [
            "model.tower.body.layers.0.fc.weight",
            "model.tower.body.layers.0.fc.bias",
            "model.tower.body.layers.1.fc.weight",
            "model.tower.body.layers.1.fc.bias",
            "model.side.w",
            "model.head.w",
        ]
    );
    assert_eq!(new.tensors["model.tower.body.layers.0.fc.bias"].shape, [4]);
    assert_eq!((new.ignore_missing, new.ignore_unexpected), (vec!["position_ids".to_owned()], vec!["junk".to_owned()]));
    let steps: Vec<(&str, Option<&str>)> =
        new.conversions.iter().map(|c| (c.from[0].as_str(), c.scope.as_deref())).collect();
    // The part is found by class; by a class that shares another's tensors; by model type; a group is found by model
    // type, without its inner parts.
    assert_eq!(
        steps[..4],
        [("^a", Some("")), ("old", Some("tower")), ("old", Some("tower.body")), ("old", Some("side"))],
        "and then those for every model"
    );
    assert_eq!((steps.len(), steps[4]), (9, ("LayerNorm.gamma", None)));
    assert_eq!(new.conversions[0].extra["prefix_to_remove"], "a");
}

/// A class whose config class does to its keys all that one can say of it.
const RESHAPED: &str = r#"{
  architecture: "reshaped", summary: "for tests", model_types: ["reshaped"], sources: ["nobody"], loaders: ["4.47.0", "4.57.6", "5.23.0"],
  inside: "whole",
  defaults: { width: 8, heads: 2, kind: "plain", legacy: null, tied: null },
  aliases: { hidden: "width", n_head: { early: "heads" } },
  computed: {
    width: { always: "c.legacy != null ? c.legacy : c.width" },
    head_width: "c.width / c.heads",
    gated: { unless_given: "c.kind.startsWith('gated-')" },
    words: { always: "split(c.words, '|')" },
  },
  unvaried: { odd: 1 },
  refuses: [{ when: "c.width % c.heads != 0", error: "ValueError: {c.width} is no multiple of {c.heads}" }],
  by_loader: { "5.23.0": { aliases: { breadth: "width" } } },
  classes: [{
    class: "Reshaped",
    key_mapping: [["^old\\.(\\w+)", "new.\\1"]],
    not_predicted_when: [{ when: "c.adapter == true", why: "adapters are not described" }],
    tensors: {
      a: { shape: ["c.width", "c.head_width"] },
      b: { when: "c.gated == true", shape: ["1"] },
      c: { when: "'x' in c.words", shape: ["1"] },
      d: { when: "release >= 457", shape: ["1"] },
    },
  }],
}"#;

fn reshaped(config: &Value, loader: Loader) -> Result<Expected, Refusal> {
    let mut library = Library::default();
    library.add("reshaped.json5", RESHAPED).expect("a file");
    library.class("Reshaped", loader).expect("known").expect(config)
}

#[track_caller]
fn assert_reshaped(mut config: Value, a: [u64; 2], others: &[&str]) {
    config["words"] = config.get("words").cloned().unwrap_or_else(|| json!([]));
    config["adapter"] = config.get("adapter").cloned().unwrap_or_else(|| json!(false));
    let built = reshaped(&config, Loader::V4_47_0).expect("built");
    assert_eq!(built.tensors["a"].shape, a, "{config}");
    assert_eq!(built.tensors.keys().skip(1).collect::<Vec<_>>(), others, "{config}");
}

#[test]
fn what_stands_under_another_name_is_written_over_the_key() {
    assert_reshaped(json!({ "width": 12 }), [12, 6], &[]);
    // A late one comes after what is computed from the key, and wins over it; an early one before.
    assert_reshaped(json!({ "width": 12, "hidden": 24 }), [24, 6], &[]);
    assert_reshaped(json!({ "width": 12, "heads": 3, "n_head": 4 }), [12, 3], &[]);
    let five = reshaped(&json!({ "breadth": 16, "words": [], "adapter": false }), Loader::V5_23_0).expect("built");
    assert_eq!(five.tensors["a"].shape, [16, 4]);
    assert_reshaped(json!({ "breadth": 16 }), [8, 4], &[]);
    // And it can be read under either name.
    assert_eq!(five.config["breadth"], json!(16));
}

#[test]
fn computed_keys_say_when_they_are() {
    assert_reshaped(json!({ "width": 12, "legacy": 4 }), [4, 2], &[]);
    assert_reshaped(json!({ "head_width": null }), [8, 4], &[]);
    assert_reshaped(json!({ "head_width": 7 }), [8, 7], &[]);
    assert_reshaped(json!({ "kind": "gated-relu" }), [8, 4], &["b"]);
    assert_reshaped(json!({ "kind": "gated-relu", "gated": false }), [8, 4], &[]);
    assert_reshaped(json!({ "kind": "gated-relu", "gated": null }), [8, 4], &[]);
    assert_reshaped(json!({ "words": "y|X" }), [8, 4], &["c"]);
    assert_reshaped(json!({ "words": ["x"] }), [8, 4], &["c"]);
}

/// Source: `Qwen2MoeDecoderLayer` of transformers 4.47.0 and 4.57.6, which has experts where `num_experts > 0`.
#[test]
fn a_count_of_what_the_class_leaves_out_may_be_negative() {
    let none = |count: i64| shapes(&expect(&json!({ "model_type": "qwen2_moe", "num_experts": count }), &Map::new()));
    assert_same(&none(-1), &none(0), "-1 experts");
    assert!(none(-1).contains_key("model.layers.0.mlp.gate_proj.weight"));
}

/// Source: `XmodOutput` of transformers 4.47.0 and 5.23.0.
#[test]
fn a_list_of_the_config_names_modules() {
    let languages = |list: Value| {
        let expected = expect(&json!({ "model_type": "xmod", "languages": list }), &Map::new());
        let names =
            expected.tensors.keys().filter(|name| name.contains(".layer.3.") && name.contains("adapter_modules."));
        names
            .map(|name| name.rsplit('.').nth(2).expect("a language").to_owned())
            .collect::<std::collections::BTreeSet<_>>()
    };
    assert_eq!(languages(json!(["en_XX", "de_DE"])), ["de_DE", "en_XX"].map(str::to_owned).into());
    assert_eq!(languages(json!([])), std::collections::BTreeSet::new());
}

#[test]
fn a_part_of_a_larger_model_reads_its_own_config() {
    let inner = json!({ "width": 20, "words": [], "adapter": false });
    assert_reshaped(json!({ "model_type": "other", "width": 2, "whole": inner }), [20, 10], &[]);
    let typed = json!({ "model_type": "reshaped", "width": 22, "words": [], "adapter": false });
    assert_reshaped(json!({ "model_type": "other", "width": 2, "somewhere": typed }), [22, 11], &[]);
    assert_reshaped(json!({ "model_type": "reshaped", "width": 2, "somewhere": typed }), [2, 1], &[]);
}

#[test]
fn what_a_description_does_not_cover_is_said() {
    let built = |config: &Value| reshaped(config, Loader::V4_57_6);
    let plain = built(&json!({ "words": [], "adapter": false, "odd": 1 })).expect("built");
    assert_eq!(plain.doubts, []);
    assert!(plain.tensors.contains_key("d"));
    assert_eq!(plain.conversions[0].from, [r"^old\.(\w+)"]);
    let odd = built(&json!({ "words": [], "adapter": true, "odd": 2 })).expect("built");
    let doubts: Vec<String> = odd.doubts.iter().map(ToString::to_string).collect();
    assert_eq!(doubts, ["adapters are not described", "/odd is read by the class, and what it does is not known here"]);
    // Where an expression fails, the key is named that it reads, through the names of the description.
    for (width, words) in [
        (json!(null), "width is null, which is not described here"),
        (json!([8, 8]), "width is a list of 2 elements, which is not described here"),
        (json!("wide"), "width is \"wide\", which is not described here"),
    ] {
        let refusal = built(&json!({ "words": [], "adapter": false, "width": width })).expect_err("no width");
        assert!(matches!(refusal, Refusal::NotCovered(_)), "{refusal:?}");
        assert_eq!(refusal.to_string(), words);
    }
    // No loader makes a tensor of such a size.
    let huge = built(&json!({ "words": [], "adapter": false, "width": 1_u64 << 60 })).expect_err("too wide");
    assert_eq!(huge.to_string(), "width is 1152921504606846976, which is no size of a tensor");
    let refused = built(&json!({ "words": [], "adapter": false, "width": 9 })).expect_err("odd width");
    assert_eq!(refused, Refusal::Raises("ValueError: 9 is no multiple of 2".to_owned()));
}

#[test]
fn the_nearest_loader_that_has_a_class_stands_for_a_version() {
    let library = Library::embedded();
    let stands = |version: &str, class: &str| {
        let config = json!({ "architectures": [class] });
        library.stands_for(version, &config, &[]).map(|(loader, _)| loader)
    };
    assert_eq!(stands("4.50.0", "LlamaForCausalLM"), Some(Loader::V4_47_0));
    assert_eq!(stands("4.56", "LlamaForCausalLM"), Some(Loader::V4_57_6));
    assert_eq!(stands("4.57.3", "LlamaForCausalLM"), Some(Loader::V4_57_6));
    // Known to 4.57 and not to 4.47, to which 4.50 is nearer; a known version stands for itself alone.
    assert_eq!(stands("4.50.0", "Qwen3ForCausalLM"), Some(Loader::V4_57_6));
    assert_eq!(stands("4.47.0", "Qwen3ForCausalLM"), None);
    assert_eq!(stands("4.50.0", "Nobody"), None);
    let by_name = library.class_under("4.50.0", "Qwen3ForCausalLM").map(|(loader, _)| loader);
    assert_eq!(by_name, Some(Loader::V4_57_6));
}
