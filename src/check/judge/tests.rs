#![allow(clippy::unwrap_used, clippy::panic, reason = "a test")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde_json::{Value, json};

use super::classes::{build_classes, faults as class_faults, resolve_targets};
use super::explain::{ExplainedLoad, explain};
use super::predict::predict;
use super::*;
use crate::checkpoint::{Dtype, FaultKind};
use crate::knowledge::architecture::UnknownPart;
use crate::knowledge::{Loader, Refusal};

/// A donor, its config with some values changed, and its tensors under other names.
struct Case {
    checkpoint: Checkpoint,
    knowledge: Knowledge,
    config: Value,
    stored: Stored,
    versions: Vec<String>,
    memo: Memo,
}

impl Case {
    fn new(donor: &str) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors").join(donor);
        let checkpoint = Checkpoint::open(&path).unwrap();
        let config = checkpoint.config().unwrap().clone();
        let stored = Stored::of(&checkpoint);
        Self {
            checkpoint,
            knowledge: Knowledge::embedded().unwrap(),
            config,
            stored,
            versions: Vec::new(),
            memo: Memo::default(),
        }
    }

    fn set(mut self, key: &str, value: Value) -> Self {
        self.config[key] = value;
        self
    }

    /// Every name that starts with `from` starts with `to`.
    fn rename(mut self, from: &str, to: &str) -> Self {
        let names: Vec<String> = self.stored.names().filter(|n| n.starts_with(from)).map(str::to_owned).collect();
        self.stored = self.stored.under(&names, from, to);
        self
    }

    fn versions(mut self, versions: &[&str]) -> Self {
        self.versions = versions.iter().map(|&v| v.to_owned()).collect();
        self
    }

    fn inputs(&self) -> Inputs<'_> {
        let scheme = declared_scheme(&self.config, &self.knowledge.schemes);
        Inputs {
            checkpoint: &self.checkpoint,
            knowledge: &self.knowledge,
            config: &self.config,
            stored: &self.stored,
            versions: &self.versions,
            scheme,
            read: schemes_read(&self.config, &self.knowledge),
            memo: &self.memo,
        }
    }
}

fn kinds(faults: &[Fault]) -> Vec<FaultKind> {
    faults.iter().map(|fault| fault.kind).collect()
}

#[test]
fn the_version_that_wrote_the_config_leads() {
    let case = Case::new("spatialvla-tiny");
    let inputs = case.inputs();
    let targets = resolve_targets(&inputs);
    assert!(targets.first().unwrap().target.leads);
    assert_eq!(targets.first().unwrap().architecture.name(), "spatialvla");
    assert!(targets.iter().skip(1).all(|one| !one.target.leads));
}

#[test]
fn a_loader_that_leads_for_another_is_judged_as_itself() {
    let case = Case::new("spatialvla-tiny").set("transformers_version", json!("5.23.0"));
    let inputs = case.inputs();
    let targets = resolve_targets(&inputs);
    let leading: Vec<_> = targets.iter().filter(|one| one.target.leads).map(|one| one.target.version()).collect();
    assert_eq!(leading, ["4.47.0"]);
}

#[test]
fn versions_that_the_user_names_all_lead() {
    let case = Case::new("spatialvla-tiny").versions(&["4.47.0", "4.46.1"]);
    let inputs = case.inputs();
    let targets = resolve_targets(&inputs);
    // Both are predicted by the same loader, once.
    assert_eq!(targets.len(), 1);
    assert_eq!(targets.first().unwrap().target.loader, Loader::V4_47_0);
}

#[test]
fn an_unknown_class_and_one_that_cannot_be_built_are_different_faults() {
    let unknown =
        Case::new("llava3d-tiny").set("architectures", json!(["NoSuchModel"])).set("model_type", json!("none"));
    let inputs = unknown.inputs();
    let classes = build_classes(&inputs, resolve_targets(&inputs));
    assert!(classes.is_empty());
    assert_eq!(kinds(&class_faults(&inputs, &classes)), [FaultKind::UnknownArchitecture]);

    let impossible = Case::new("llava3d-tiny").set("num_attention_heads", json!(0));
    let inputs = impossible.inputs();
    let classes = build_classes(&inputs, resolve_targets(&inputs));
    assert!(matches!(classes.first().unwrap().class, Err(Refusal::Impossible(_))));
    assert_eq!(kinds(&class_faults(&inputs, &classes)), [FaultKind::ConfigIncomputable]);
}

#[test]
fn a_backbone_of_another_model_type_is_not_covered() {
    let detr = |backbone: &str| {
        let case = Case::new("llava3d-tiny").versions(&["5.23.0"]).set("architectures", json!(["DetrModel"]));
        case.set("model_type", json!("detr")).set("backbone_config", json!({ "model_type": backbone }))
    };
    let class = |case: &Case| {
        let inputs = case.inputs();
        build_classes(&inputs, resolve_targets(&inputs)).remove(0).class
    };
    assert!(class(&detr("resnet")).is_ok());
    let refusal = class(&detr("timm_backbone")).unwrap_err();
    assert!(matches!(refusal, Refusal::NotCovered(_)), "{refusal:?}");
    let case = detr("timm_backbone");
    let inputs = case.inputs();
    let faults = class_faults(&inputs, &build_classes(&inputs, resolve_targets(&inputs)));
    let [fault] = faults.as_slice() else { panic!("{faults:?}") };
    assert!(fault.detail["part"].as_str().unwrap().contains("timm_backbone"), "{fault:?}");
}

/// A part without a config of its own is read from config.json as a whole.
#[test]
fn what_is_unknown_has_a_place_in_the_config() {
    let place = |config: &str| {
        let case = llama(&["5.23.0"]);
        let inputs = case.inputs();
        let mut built = build_classes(&inputs, resolve_targets(&inputs));
        let part = UnknownPart { config: config.to_owned(), model_type: Some("none".to_owned()), class: None };
        built[0].class = Err(Refusal::UnknownPart(part));
        class_faults(&inputs, &built).remove(0).places.remove(0).pointer
    };
    assert_eq!(place("").as_deref(), Some("/model_type"));
    assert_eq!(place("text_config.part").as_deref(), Some("/text_config/part/model_type"));
}

#[test]
fn a_class_is_built_from_tensors_under_names_that_the_loader_renames() {
    let whole = Case::new("llava3d-tiny");
    // A save of the base model; the size of the vision tower is in no config.
    let bare = Case::new("llava3d-tiny").rename("model.", "");
    let built = |case: &Case| {
        let inputs = case.inputs();
        let class = build_classes(&inputs, resolve_targets(&inputs)).remove(0).class;
        class.unwrap_or_else(|refusal| panic!("{refusal:?}")).tensors.len()
    };
    assert_eq!(built(&whole), built(&bare));
}

#[test]
fn a_prefix_explains_every_tensor_of_a_load() {
    for (from, to, prefix) in [("model.", "", ""), ("", "module.", "module.")] {
        let case = Case::new("llava3d-tiny").rename(from, to);
        let inputs = case.inputs();
        let predictions = predict(&inputs, build_classes(&inputs, resolve_targets(&inputs)));
        assert!(!predictions.first().unwrap().report.as_ref().unwrap().is_whole(), "{prefix}");
        let loads = explain(&inputs, predictions);
        let load = loads.first().unwrap();
        let [fault] = load.prefixes.as_slice() else { panic!("{:?}", load.prefixes) };
        assert_eq!(fault.detail["from"], prefix);
        let rest = load.unexplained().unwrap();
        assert!(rest.is_whole() && rest.unexpected.is_empty(), "{rest:?}");
    }
}

#[test]
fn a_config_value_explains_the_tensors_that_follow_from_it() {
    let case = Case::new("llava3d-tiny").set("num_hidden_layers", json!(3));
    let inputs = case.inputs();
    let loads = explain(&inputs, predict(&inputs, build_classes(&inputs, resolve_targets(&inputs))));
    let votes = explain::distinct_votes(&loads);
    let [vote] = votes.as_slice() else { panic!("{votes:?}") };
    assert_eq!((vote.pointer.as_str(), &vote.voted_value), ("/num_hidden_layers", &json!(2)));
    let faults = faults::faults(&inputs, &loads, &votes);
    assert_eq!(kinds(&faults), [FaultKind::ConfigOutvoted]);
    assert_eq!(faults[0].loaders, loads.iter().map(ExplainedLoad::loader).collect::<Vec<_>>());
}

#[test]
fn a_value_is_voted_on_once_for_all_loads() {
    let case = llama(&["4.47.0", "5.23.0"]).set("num_hidden_layers", json!(3)).set("vocab_size", json!(341));
    let inputs = case.inputs();
    let loads = explain(&inputs, predict(&inputs, build_classes(&inputs, resolve_targets(&inputs))));
    let pointers = |votes: &[Vote]| votes.iter().map(|vote| vote.pointer.clone()).collect::<Vec<_>>();
    let distinct = pointers(&explain::distinct_votes(&loads));
    assert_eq!(
        distinct.iter().map(String::as_str).collect::<BTreeSet<_>>(),
        ["/num_hidden_layers", "/vocab_size"].into()
    );
    assert_eq!((distinct.len(), loads.len()), (2, 2));
    assert!(loads.iter().all(|load| pointers(load.votes().unwrap()) == distinct));
}

/// What a quantised module stores is read by the library that packed it.
#[test]
fn integers_are_a_fault_of_plain_weights_alone() {
    let faults = |case: Case| {
        let inputs = case.inputs();
        let loads = explain(&inputs, predict(&inputs, build_classes(&inputs, resolve_targets(&inputs))));
        integers::fault(&inputs, &loads).map(|fault| fault.loaders)
    };
    let stored = |dtype: Dtype| {
        let mut case = llama(&["4.57.6"]);
        for tensor in case.checkpoint.shards.values_mut().flat_map(|shard| &mut shard.tensors) {
            tensor.dtype = if tensor.name == "lm_head.weight" { dtype } else { tensor.dtype };
        }
        case
    };
    assert_eq!(faults(stored(Dtype::F32)), None);
    assert_eq!(faults(stored(Dtype::I8)), Some(vec!["4.57.6"]));
    let packed = json!({ "quant_method": "bitsandbytes", "load_in_8bit": true });
    assert_eq!(faults(stored(Dtype::I8).set("quantization_config", packed)), None);
}

#[test]
fn nothing_stored_is_no_prediction() {
    let mut case = Case::new("llava3d-tiny");
    case.stored = Stored::default();
    let inputs = case.inputs();
    let predictions = predict(&inputs, build_classes(&inputs, resolve_targets(&inputs)));
    assert!(predictions.iter().all(|prediction| prediction.report.is_none()));
    let why = classes::unpredicted(&inputs, &build_classes(&inputs, resolve_targets(&inputs)));
    assert!(!why.is_empty() && why.iter().all(|(_, why)| why == "no tensor was read"), "{why:?}");
}

#[test]
fn layers_are_compared_where_the_class_is_unknown_alone() {
    let faults = |mut case: Case| {
        let layer = |at: usize| (at != 3).then(|| (format!("model.layers.{at}.b.weight"), vec![2]));
        let layers = (0..8).flat_map(|at| [Some((format!("model.layers.{at}.a.weight"), vec![2])), layer(at)]);
        case.stored = Stored::from_shapes(layers.flatten().collect());
        let inputs = case.inputs();
        kinds(&class_faults(&inputs, &build_classes(&inputs, resolve_targets(&inputs))))
    };
    assert_eq!(faults(Case::new("llava3d-tiny")), []);
    let unknown =
        Case::new("llava3d-tiny").set("architectures", json!(["NoSuchModel"])).set("model_type", json!("none"));
    assert_eq!(faults(unknown), [FaultKind::UnknownArchitecture, FaultKind::LayerLacksTensor]);
}

/// A Llama with the tensors of the donor, those of its vision side left over.
fn llama(versions: &[&str]) -> Case {
    let case = Case::new("llava3d-tiny").set("architectures", json!(["LlamaForCausalLM"]));
    case.set("model_type", json!("llama")).versions(versions)
}

/// Transformers 4.47 reads the values of a Qwen2-VL at the top, and 5.23 refuses an id that is no number.
#[test]
fn a_config_that_several_versions_refuse_is_one_fault_for_each_that_leads() {
    let faults = |versions: &[&str]| {
        let case = Case::new("llava3d-tiny").set("architectures", json!(["Qwen2VLForConditionalGeneration"]));
        let case = case.set("model_type", json!("qwen2_vl")).set("transformers_version", json!("4.47.0"));
        let case = case.set("text_config", json!({ "model_type": "qwen2_vl_text", "hidden_size": 64 }));
        let case = case.set("image_token_id", json!("x")).versions(versions);
        let inputs = case.inputs();
        let faults = class_faults(&inputs, &build_classes(&inputs, resolve_targets(&inputs)));
        let refused = faults.iter().filter(|fault| fault.kind == FaultKind::ConfigIncomputable);
        refused.map(|fault| fault.loaders.clone()).collect::<Vec<_>>()
    };
    assert_eq!(faults(&[]), [["4.47.0", "5.23.0"]]);
    assert_eq!(faults(&["4.47.0", "5.23.0"]), [["4.47.0"], ["5.23.0"]]);
}

#[test]
fn loaders_that_agree_have_their_faults_once() {
    let faults = |case: Case| {
        let inputs = case.inputs();
        let loads = explain(&inputs, predict(&inputs, build_classes(&inputs, resolve_targets(&inputs))));
        let votes = explain::distinct_votes(&loads);
        let faults = faults::faults(&inputs, &loads, &votes);
        let missing = faults.iter().filter(|fault| fault.kind == FaultKind::MissingTensors);
        missing.map(|fault| (fault.loaders.clone(), fault.detail.contains_key("under"))).collect::<Vec<_>>()
    };
    let both = || llama(&["4.47.0", "5.23.0"]);
    assert_eq!(faults(both().rename("lm_head.", "head.")), [(vec!["4.47.0", "5.23.0"], false)]);
    // 5.23 ignores this name, and 4.47 reports it.
    let apart = both().rename("model.layers.0.mlp.up_proj.", "model.layers.0.self_attn.rotary_emb.inv_freq.");
    assert_eq!(faults(apart), [(vec!["4.47.0"], true), (vec!["5.23.0"], true)]);
}

/// The load itself compares no shape of a tensor that it does not find.
#[test]
fn a_shape_behind_a_prefix_is_not_met() {
    let unmet = |mut case: Case, name: &str| {
        let added = BTreeMap::from([(name.to_owned(), Some(vec![7]))]);
        case.stored = case.stored.replacing(&BTreeSet::from([name.to_owned()]), added);
        let inputs = case.inputs();
        let loads = explain(&inputs, predict(&inputs, build_classes(&inputs, resolve_targets(&inputs))));
        let votes = explain::distinct_votes(&loads);
        let faults = faults::faults(&inputs, &loads, &votes);
        let shapes = faults.iter().filter(|fault| fault.kind == FaultKind::MismatchedTensor);
        shapes.map(|fault| fault.detail.contains_key("unmet")).collect::<Vec<_>>()
    };
    assert_eq!(unmet(llama(&[]), "model.norm.weight"), [false]);
    assert_eq!(unmet(llama(&[]).rename("", "module."), "module.model.norm.weight"), [true]);
}
