#![allow(clippy::arithmetic_side_effects, reason = "numbers here are small")]

use crate::check::load::Stored;
use crate::checkpoint::FaultKind;
use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::knowledge::{Library, Loader};

const LOADER: Loader = Loader::V4_47_0;

/// What a class saves: shared storages once.
fn stored(config: &Value) -> Stored {
    let library = Library::embedded();
    let expected = library.find(config, [], LOADER).expect("known").expect(config).unwrap_or_else(|e| panic!("{e:?}"));
    let kept = expected.tensors.iter().filter(|(_, t)| t.tied_to.is_none());
    Stored::from_shapes(kept.map(|(name, t)| (name.clone(), t.shape.clone())).collect())
}

fn llama() -> Value {
    json!({ "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 64, "intermediate_size": 144,
        "num_attention_heads": 4, "num_hidden_layers": 3, "vocab_size": 340, "num_key_value_heads": 2,
        "tie_word_embeddings": false, "attention_bias": false, "rope_theta": 10000.0, "use_cache": true, "pad_token_id": null })
}

fn voted(config: &Value, stored: &Stored) -> Votes {
    let library = Library::embedded();
    let architecture = library.find(config, stored.names(), LOADER).expect("known");
    vote(architecture, config, stored).expect("built")
}

/// Pointer, what the config says, what the tensors say.
fn outvoted(votes: &Votes) -> Vec<(&str, String, String)> {
    votes.outvoted().map(|v| (v.pointer.as_str(), v.config_value.to_string(), v.voted_value.to_string())).collect()
}

#[test]
fn one_wrong_value_is_outvoted_and_nothing_else() {
    let evidence = stored(&llama());
    for (key, wrong) in [
        ("hidden_size", json!(128)),
        ("intermediate_size", json!(100)),
        ("num_hidden_layers", json!(5)),
        ("num_hidden_layers", json!(1)),
        ("vocab_size", json!(32000)),
        ("num_key_value_heads", json!(4)),
        ("num_key_value_heads", json!(1)),
        ("tie_word_embeddings", json!(true)),
        ("attention_bias", json!(true)),
    ] {
        let mut config = llama();
        let right = std::mem::replace(&mut config[key], wrong.clone());
        let votes = voted(&config, &evidence);
        assert_eq!(outvoted(&votes), [(format!("/{key}").as_str(), wrong.to_string(), right.to_string())]);
        assert_eq!(votes.config, llama());
        assert!(votes.after.is_exact() && votes.votes.iter().all(|v| v.votes_against == 0), "{key}: {votes:?}");
    }
    let votes = voted(&llama(), &evidence);
    assert_eq!(outvoted(&votes), []);
    assert_eq!(votes.before, votes.after);
}

#[test]
fn votes_name_their_witnesses() {
    let mut config = llama();
    config["vocab_size"] = json!(500);
    let votes = voted(&config, &stored(&llama()));
    let vote = votes.outvoted().next().expect("a vote");
    assert_eq!((vote.votes_for, vote.votes_against, vote.given), (2, 0, true));
    let named: Vec<String> = vote.evidence.iter().map(ToString::to_string).collect();
    assert_eq!(named, ["model.embed_tokens.weight [340, 64]", "lm_head.weight [340, 64]"]);
    let fault = fault(vote);
    assert_eq!((fault.kind, fault.places[0].pointer.as_deref()), (FaultKind::ConfigOutvoted, Some("/vocab_size")));
    assert_eq!(fault.detail["names"], json!(["model.embed_tokens.weight [340, 64]", "lm_head.weight [340, 64]"]));
}

#[test]
fn what_only_shows_as_a_product_is_left_open() {
    let votes = voted(&llama(), &stored(&llama()));
    let [open] = votes.undecided.as_slice() else { panic!("{:?}", votes.undecided) };
    assert_eq!(open.constraint, "num_attention_heads * head_dim = 64, num_key_value_heads * head_dim = 32");
    let decided: Vec<&str> = votes.votes.iter().map(|v| v.pointer.as_str()).collect();
    assert_eq!(decided, ["/hidden_size", "/intermediate_size", "/num_hidden_layers", "/vocab_size"]);
}

#[test]
fn damaged_tensors_do_not_outvote_the_rest() {
    let intact = stored(&llama());
    let damaged = |name: &str, shape: &[u64]| {
        let of =
            |(n, s): (&str, Option<&[u64]>)| (n.to_owned(), if n == name { shape } else { s.expect("known") }.to_vec());
        Stored::from_shapes(intact.evidence().iter().map(of).collect())
    };
    for evidence in [
        damaged("model.norm.weight", &[8]),
        damaged("lm_head.weight", &[500, 64]),
        damaged("model.layers.0.mlp.up_proj.weight", &[9, 64]),
    ] {
        assert_eq!(outvoted(&voted(&llama(), &evidence)), []);
    }
}

#[test]
fn a_list_for_each_layer_follows_their_number() {
    let mut library = Library::embedded();
    let text = r#"{ architecture: "mix", summary: "", sources: [], loaders: ["4.47.0"], classes: [{ class: "Mix", tensors: {
        "layers.{i}.w": { repeat: { i: "c.n_layers" }, shape: ["c.kinds[i] == 'wide' ? 2 * c.width : c.width"] } } }] }"#;
    library.add("mix.json5", text).expect("parses");
    let config = |n: usize| {
        let kinds = &["wide", "thin", "wide", "thin"][..n];
        json!({ "architectures": ["Mix"], "n_layers": n, "width": 6, "kinds": kinds })
    };
    let mix = library.class("Mix", LOADER).expect("added");
    let four = mix.expect(&config(4)).expect("built").tensors.into_iter().map(|(n, t)| (n, t.shape)).collect();
    let votes = vote(mix, &config(2), &Stored::from_shapes(four)).expect("built");
    assert_eq!(votes.config, config(4));
}

#[test]
fn a_size_behind_a_square_is_found() {
    let vit = json!({ "architectures": ["SiglipVisionModel"], "model_type": "siglip_vision_model", "hidden_size": 32, "image_size": 448,
        "patch_size": 14, "num_hidden_layers": 1, "intermediate_size": 64, "num_attention_heads": 4 });
    let mut config = vit.clone();
    config["image_size"] = json!(224);
    assert_eq!(outvoted(&voted(&config, &stored(&vit))), [("/image_size", "224".to_owned(), "448".to_owned())]);
    config["image_size"] = json!(448);
    config["patch_size"] = json!(16);
    assert_eq!(outvoted(&voted(&config, &stored(&vit))), [("/patch_size", "16".to_owned(), "14".to_owned())]);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    /// Whatever one or two sizes say, what explains the tensors is found again, or something that explains them too.
    #[test]
    fn sizes_are_restored(
        heads in 1_u64..5, dim in 1_u64..9, kv in 1_u64..3, layers in 1_u64..4, ff in 1_u64..200, vocab in 1_u64..900,
        wrong in proptest::collection::vec((0_usize..5, 1_u64..300), 1..3)
    ) {
        let keys = ["hidden_size", "intermediate_size", "num_hidden_layers", "vocab_size", "num_key_value_heads"];
        let mut config = llama();
        for (key, value) in keys.iter().zip([heads * dim * 2, ff, layers, vocab, heads * kv]) {
            config[*key] = json!(value);
        }
        config["num_attention_heads"] = json!(heads * 2);
        let evidence = stored(&config);
        for (key, value) in wrong {
            config[keys[key]] = json!(if key == 2 { value % 40 } else { value });
        }
        prop_assert!(voted(&config, &evidence).after.is_exact(), "{}", config);
    }
}
