use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::json;

use super::*;
use crate::checkpoint::{Dtype, FaultKind, Shard, Tensor};
use crate::knowledge::{ExpectedTensor, Library, Loader};

type Shapes = BTreeMap<String, Vec<u64>>;

fn llama(tie: bool) -> Expected {
    let config = json!({ "architectures": ["LlamaForCausalLM"], "hidden_size": 4, "intermediate_size": 8, "num_attention_heads": 2,
        "num_hidden_layers": 1, "vocab_size": 10, "tie_word_embeddings": tie });
    Library::embedded().find(&config, [], Loader::V4_47_0).expect("llama").expect(&config).expect("built")
}

/// What 4.47.0 says of a checkpoint that has everything.
fn clean() -> LoadReport {
    LoadReport { loader: "4.47.0".to_owned(), ..LoadReport::default() }
}

fn all(expected: &Expected) -> Shapes {
    expected.tensors.iter().map(|(name, t)| (name.clone(), t.shape.clone())).collect()
}

fn shard(name: &str, tensors: &Shapes) -> Shard {
    let tensor = |(name, shape): (&String, &Vec<u64>)| Tensor {
        name: name.clone(),
        dtype: Dtype::BF16,
        shape: shape.clone(),
        begin: 0,
        end: 0,
    };
    Shard { name: name.to_owned(), tensors: tensors.iter().map(tensor).collect(), ..Shard::default() }
}

fn reasons(report: &LoadReport) -> Vec<(&str, SilentReason)> {
    report.silent.iter().map(|s| (s.name.as_str(), s.reason)).collect()
}

#[test]
fn a_whole_checkpoint_loads_clean() {
    let expected = llama(false);
    let report = predict(&expected, &Stored::from_shapes(all(&expected)));
    assert_eq!(report, clean());
    assert!(faults(&report, &expected, None).is_empty());
}

#[test]
fn textual_renames_apply_anywhere_and_one_at_a_time() {
    assert_eq!(keys::renamed("a.gamma.beta"), "a.gamma.bias");
    assert_eq!(keys::renamed("gamma_1.gamma"), "weight_1.weight");
    assert_eq!(keys::renamed("conv.weight_g"), "conv.parametrizations.weight.original0");
    assert_eq!(keys::renamed("conv.weight_v.weight_g"), "conv.weight_v.parametrizations.weight.original0");
    assert_eq!(keys::renamed("conv.weight"), "conv.weight");
}

#[test]
fn base_model_keys_load_into_a_class_with_a_head() {
    let expected = llama(false);
    let mut stored: Shapes =
        all(&expected).into_iter().filter_map(|(n, s)| Some((n.strip_prefix("model.")?.to_owned(), s))).collect();
    let report = predict(&expected, &Stored::from_shapes(stored.clone()));
    assert_eq!((report.missing, report.unexpected, report.raises), (vec!["lm_head.weight".to_owned()], vec![], None));
    // The same with the head beside them raises.
    stored.insert("lm_head.weight".to_owned(), vec![10, 4]);
    let report = predict(&expected, &Stored::from_shapes(stored));
    assert!(report.raises.as_deref().is_some_and(|r| r.starts_with("ValueError: The state dictionary")));
    assert_eq!(faults(&report, &expected, None).iter().map(|f| f.kind).collect::<Vec<_>>(), [FaultKind::LoadRaises]);
}

#[test]
fn a_full_checkpoint_loads_into_the_base_class() {
    let whole = llama(false);
    let config = json!({ "architectures": ["LlamaModel"], "hidden_size": 4, "intermediate_size": 8, "num_attention_heads": 2,
        "num_hidden_layers": 1, "vocab_size": 10 });
    let base = Library::embedded().find(&config, [], Loader::V4_47_0).expect("llama").expect(&config).expect("built");
    let mut stored = all(&whole);
    stored.insert("model.norm.weight".to_owned(), vec![5]);
    let report = predict(&base, &Stored::from_shapes(stored));
    assert_eq!((report.missing.len(), report.unexpected), (0, vec!["lm_head.weight".to_owned()]));
    assert_eq!(
        report.mismatched,
        [Mismatch { name: "model.norm.weight".to_owned(), stored: vec![5], expected: vec![4] }]
    );
    assert!(report.silent.is_empty());
}

#[test]
fn one_stray_key_with_the_prefix_hijacks_the_whole_model() {
    let mut expected = Expected { base_model_prefix: "model".to_owned(), ..Expected::default() };
    for name in ["vision_tower.w", "language_model.model.w"] {
        expected.tensors.insert(name.to_owned(), ExpectedTensor { shape: vec![2], ..ExpectedTensor::default() });
    }
    let mut stored = all(&expected);
    stored.insert("modelx.weight".to_owned(), vec![1]);
    let report = predict(&expected, &Stored::from_shapes(stored));
    assert_eq!(report.missing, ["model.language_model.model.w", "model.vision_tower.w"]);
    assert_eq!(report.unexpected, ["language_model.model.w", "modelx.weight", "vision_tower.w"]);
    assert_eq!(reasons(&report), [("modelx.weight", SilentReason::PrefixHijack)]);
    let faults = faults(&report, &expected, None);
    assert_eq!(faults.iter().map(|f| f.kind).collect::<Vec<_>>(), [FaultKind::PrefixHijack]);
    assert_eq!(faults[0].detail["tensor"], json!("modelx.weight"));
}

#[test]
fn tied_tensors_stand_for_each_other() {
    let expected = llama(true);
    let mut stored = all(&expected);
    let report = predict(&expected, &Stored::from_shapes(stored.clone()));
    assert_eq!(reasons(&report), [("lm_head.weight", SilentReason::TiedOver)]);
    stored.remove("lm_head.weight");
    assert_eq!(predict(&expected, &Stored::from_shapes(stored.clone())), clean());
    stored.remove("model.embed_tokens.weight");
    assert_eq!(
        predict(&expected, &Stored::from_shapes(stored)).missing,
        ["lm_head.weight", "model.embed_tokens.weight"]
    );
}

#[test]
fn the_index_says_what_is_there_and_the_shards_what_is_loaded() {
    let expected = llama(false);
    let (norm, head) = ("model.norm.weight".to_owned(), "lm_head.weight".to_owned());
    let mut index: BTreeMap<String, Arc<str>> =
        expected.tensors.keys().map(|n| (n.clone(), Arc::from("a.safetensors"))).collect();
    let mut first = all(&expected);
    let report =
        |index: &BTreeMap<String, Arc<str>>, shards: &[Shard]| predict(&expected, &Stored::new(Some(index), shards));
    assert_eq!(report(&index, &[shard("a.safetensors", &first)]), clean());

    // In the index and in no shard: nothing is reported, and it stays random.
    first.remove(&norm);
    let found = report(&index, &[shard("a.safetensors", &first)]);
    assert_eq!((found.missing.len(), reasons(&found)), (0, vec![(norm.as_str(), SilentReason::IndexedButAbsent)]));

    // In a shard the index names for others: loaded all the same.
    index.insert(head.clone(), Arc::from("b.safetensors"));
    let second = Shapes::from([(norm.clone(), vec![4]), (head.clone(), vec![10, 4])]);
    let shards = [shard("a.safetensors", &first), shard("b.safetensors", &second)];
    assert_eq!(report(&index, &shards), clean());

    // A shard that is not there may hold it.
    assert_eq!(report(&index, &shards[..1]), clean());

    // In a shard and not in the index: reported missing.
    index.remove(&norm);
    assert_eq!(report(&index, &shards).missing, [norm]);

    // A single file beside the index wins.
    let stale = shard("model.safetensors", &Shapes::from([(head.clone(), vec![10, 4])]));
    let found = report(&index, &[stale, shards[0].clone(), shards[1].clone()]);
    assert_eq!((found.missing.len(), found.unexpected.len()), (11, 0));
    let loose = [shard("model-00001-of-00002.safetensors", &first), shard("adapter_model.safetensors", &second)];
    assert_eq!(Stored::new(None, &loose).names().count(), first.len());
}

#[test]
fn an_optional_group_is_whole_or_absent() {
    let mut expected = llama(false);
    for name in ["model.tower.a", "model.tower.b"] {
        expected.tensors.insert(
            name.to_owned(),
            ExpectedTensor { shape: vec![2], optional: Some("tower".to_owned()), ..ExpectedTensor::default() },
        );
    }
    let mut stored = all(&expected);
    stored.remove("model.tower.a");
    assert_eq!(predict(&expected, &Stored::from_shapes(stored.clone())).missing, ["model.tower.a"]);
    stored.remove("model.tower.b");
    assert_eq!(predict(&expected, &Stored::from_shapes(stored)), clean());
}

#[test]
fn a_fault_names_every_tensor() {
    let report = LoadReport { missing: (0..7).map(|i| format!("t{i}")).collect(), ..LoadReport::default() };
    let faults = faults(&report, &Expected::default(), None);
    assert_eq!(faults[0].detail["names"], json!(["t0", "t1", "t2", "t3", "t4", "t5", "t6"]));
    assert_eq!(
        (faults[0].kind, &faults[0].detail["count"], faults[0].places.len()),
        (FaultKind::MissingTensors, &json!(7), 7)
    );
}

/// Llama as 4.57 builds it; its loader reads the same class from the same data.
fn llama_of_4_57(key_mapping: &[[&str; 2]]) -> Expected {
    let conversions = key_mapping.iter().map(|[from, to]| crate::knowledge::Conversion {
        kind: "KeyMapping".to_owned(),
        from: vec![(*from).to_owned()],
        to: vec![(*to).to_owned()],
        ops: Vec::new(),
        scope: None,
        extra: serde_json::Map::new(),
    });
    Expected { loader: Loader::V4_57_6, conversions: conversions.collect(), ..llama(false) }
}

fn renamed_by(expected: &Expected, stored: &Shapes, with: impl Fn(&str) -> String) -> LoadReport {
    let renamed: Shapes = stored.iter().map(|(name, shape)| (with(name), shape.clone())).collect();
    predict(expected, &Stored::from_shapes(renamed))
}

#[test]
fn transformers_4_57_renames_each_key_once_and_reports_names_of_the_model() {
    let expected = llama_of_4_57(&[]);
    let whole = all(&expected);
    assert_eq!(
        predict(&expected, &Stored::from_shapes(whole.clone())),
        LoadReport { loader: "4.57.6".to_owned(), ..clean() }
    );
    // A base model's file, without prefix: names gain it.
    let mut base = whole.clone();
    base.remove("lm_head.weight");
    let report = renamed_by(&expected, &base, |name| name.trim_start_matches("model.").to_owned());
    assert_eq!(
        (report.missing.as_slice(), report.unexpected.as_slice()),
        (["lm_head.weight".to_owned()].as_slice(), [].as_slice())
    );
    // With the head beside it, it raises.
    let corrupted = renamed_by(&expected, &whole, |name| name.trim_start_matches("model.").to_owned());
    assert!(corrupted.raises.is_some_and(|r| r.starts_with("ValueError")));
    // `gamma` is renamed only after LayerNorm, and an unexpected name loses the prefix that was put on.
    let mut odd = base;
    odd.insert("model.norm.gamma".to_owned(), vec![4]);
    odd.insert("model.LayerNorm.gamma".to_owned(), vec![4]);
    let report = renamed_by(&expected, &odd, |name| name.trim_start_matches("model.").to_owned());
    assert_eq!(report.unexpected, ["LayerNorm.weight", "norm.gamma"]);
}

#[test]
fn transformers_4_57_applies_the_first_pattern_of_a_class_that_matches() {
    // As compositions have it: no base model that a prefix could be put before.
    let mapped = llama_of_4_57(&[[r"^language_model\.(model|lm)", r"\1"], ["^language_model", "unused"]]);
    let expected = Expected { base_model_prefix: String::new(), ..mapped };
    let report = renamed_by(&expected, &all(&expected), |name| {
        if name.starts_with("model.") { format!("language_model.{name}") } else { name.to_owned() }
    });
    assert_eq!(report, LoadReport { loader: "4.57.6".to_owned(), ..clean() });
}
