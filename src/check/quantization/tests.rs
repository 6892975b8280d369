use serde_json::{Value, json};

use super::*;
use crate::check::load;
use crate::checkpoint::Parts;
use crate::checkpoint::{Document, Dtype, FaultKind, Shard, Tensor};
use crate::knowledge::quantization::declared_scheme;
use crate::knowledge::{ExpectedTensor, Table};

fn schemes() -> &'static Table<Vec<Scheme>> {
    static SCHEMES: Table<Vec<Scheme>> = Table::new(|| Scheme::embedded().expect("schemes"));
    &SCHEMES
}

fn applied(block: &Value) -> Box<AppliedScheme<'static>> {
    match declared_scheme(&json!({ "quantization_config": block }), schemes()) {
        DeclaredScheme::Known(applied) => applied,
        _ => panic!("{block} means no scheme"),
    }
}

fn class(tensors: &[(&str, &[u64])]) -> Expected {
    let tensor = |(name, shape): &(&str, &[u64])| {
        ((*name).to_owned(), ExpectedTensor { shape: shape.to_vec(), ..ExpectedTensor::default() })
    };
    Expected { tensors: tensors.iter().map(tensor).collect(), ..Expected::default() }
}

fn checkpoint(tensors: &[(&str, Dtype, &[u64])]) -> Checkpoint {
    let tensor = |(name, dtype, shape): &(&str, Dtype, &[u64])| Tensor {
        name: (*name).to_owned(),
        dtype: *dtype,
        shape: shape.to_vec(),
        begin: 0,
        end: 0,
    };
    let shard = Shard {
        name: "model.safetensors".to_owned(),
        tensors: tensors.iter().map(tensor).collect(),
        ..Shard::default()
    };
    Checkpoint::planned("", Parts { shards: vec![shard], ..Parts::default() })
}

/// The kinds of fault, and the report of the load.
fn look(block: &Value, expected: &Expected, checkpoint: &Checkpoint) -> (Vec<FaultKind>, LoadReport) {
    let (applied, stored) = (applied(block), Stored::of(checkpoint));
    let quantised = Quantised::new(&applied, Some(expected), checkpoint, &stored);
    let mut report = quantised.spelled(load::predict(expected, &quantised.plain(&stored))).expect("a report");
    quantised.complete(&mut report);
    report.loader.clear();
    (quantised.faults().iter().map(|f| f.kind).collect(), report)
}

#[test]
fn experts_of_gpt_oss_are_blocks_the_other_way_round() {
    let expected = class(&[("experts.gate_up_proj", &[4, 64, 96]), ("experts.gate_up_proj_bias", &[4, 96])]);
    let stored = checkpoint(&[
        ("experts.gate_up_proj_blocks", Dtype::U8, &[4, 96, 2, 16]),
        ("experts.gate_up_proj_scales", Dtype::U8, &[4, 96, 2]),
        ("experts.gate_up_proj_bias", Dtype::BF16, &[4, 96]),
    ]);
    let block = json!({ "quant_method": "mxfp4" });
    assert_eq!(look(&block, &expected, &stored), (vec![], LoadReport::default()));
    let turned = checkpoint(&[
        ("experts.gate_up_proj_blocks", Dtype::U8, &[4, 64, 3, 16]),
        ("experts.gate_up_proj_scales", Dtype::U8, &[4, 64, 3]),
        ("experts.gate_up_proj_bias", Dtype::BF16, &[4, 96]),
    ]);
    let (faults, report) = look(&block, &expected, &turned);
    assert_eq!((faults, report.mismatched.len()), (vec![FaultKind::QuantizedShapeWrong; 2], 2));
}

/// GPT-2 stores its linear layers with the input first.
#[test]
fn a_convolution_of_width_one_is_packed_as_a_linear_layer() {
    let expected = class(&[("h.0.c_attn.weight", &[32, 96])]);
    let stored = checkpoint(&[("h.0.c_attn.weight", Dtype::I8, &[96, 32]), ("h.0.c_attn.SCB", Dtype::F32, &[96])]);
    let block = json!({ "quant_method": "bitsandbytes", "load_in_8bit": true });
    assert_eq!(look(&block, &expected, &stored), (vec![], LoadReport::default()));
}

#[test]
fn what_is_missing_is_spelled_as_the_loader_looks_for_it() {
    let expected = class(&[("h.0.q.weight", &[32, 32]), ("h.1.q.weight", &[32, 32]), ("h.2.q.weight", &[32, 32])]);
    let stored = checkpoint(&[
        ("h.0.q.qweight", Dtype::I32, &[4, 32]),
        ("h.0.q.qzeros", Dtype::I32, &[1, 4]),
        ("h.0.q.scales", Dtype::F16, &[1, 32]),
        ("h.1.q.weight", Dtype::F16, &[32, 32]),
    ]);
    let (faults, report) = look(&json!({ "quant_method": "gptq", "bits": 4, "group_size": -1 }), &expected, &stored);
    assert_eq!(faults, [FaultKind::PlainThoughQuantized]);
    let layer = |n: u64| ["qweight", "qzeros", "scales"].map(|ending| format!("h.{n}.q.{ending}"));
    assert_eq!(report.missing, [layer(1), layer(2)].concat());
    assert_eq!(report.unexpected, ["h.1.q.weight"]);
}

#[test]
fn a_module_that_the_config_leaves_plain_is_looked_for_plainly() {
    let expected = class(&[("h.0.q.weight", &[32, 32]), ("h.1.q.weight", &[32, 32])]);
    let packed = |n: u64| {
        [("qweight", Dtype::I32, [32, 4]), ("qzeros", Dtype::I32, [1, 4]), ("scales", Dtype::F16, [1, 32])]
            .map(|(ending, dtype, shape)| (format!("h.{n}.q.{ending}"), dtype, shape))
    };
    let tensors = [packed(0), packed(1)].concat();
    let tensors: Vec<(&str, Dtype, &[u64])> = tensors.iter().map(|(n, d, s)| (n.as_str(), *d, s.as_slice())).collect();
    let block = json!({ "quant_method": "awq", "group_size": -1, "modules_to_not_convert": ["h.1"] });
    let (faults, report) = look(&block, &expected, &checkpoint(&tensors));
    assert_eq!(faults, [FaultKind::QuantizedThoughSkipped]);
    assert_eq!(report.missing, ["h.1.q.weight"]);
    assert_eq!(report.unexpected, ["h.1.q.qweight", "h.1.q.qzeros", "h.1.q.scales"]);
}

#[test]
fn an_incomplete_module_of_bitsandbytes_raises() {
    let expected = class(&[("h.0.q.weight", &[32, 32])]);
    let stored = checkpoint(&[("h.0.q.weight", Dtype::U8, &[512, 1]), ("h.0.q.weight.absmax", Dtype::F32, &[16])]);
    let (faults, report) = look(&json!({ "load_in_4bit": true }), &expected, &stored);
    assert_eq!(faults, [FaultKind::QuantizedModuleIncomplete]);
    assert_eq!(report.missing, ["h.0.q.weight.quant_map", "h.0.q.weight.quant_state.bitsandbytes__nf4"]);
    assert!(report.raises.is_some_and(|r| r.starts_with("ValueError: Supplied state dict for h.0.q.weight does not")));
}

#[test]
fn absurd_parameters_are_no_panic() {
    let expected = class(&[("h.0.q.weight", &[u64::MAX, 32])]);
    let stored = checkpoint(&[("h.0.q.qweight", Dtype::I32, &[u64::MAX, u64::MAX]), ("h.0.q.scales", Dtype::F16, &[])]);
    for bits in [json!(0), json!(-1), json!("four"), json!(u64::MAX), Value::Null, json!([])] {
        for method in ["gptq", "awq", "metal", "compressed-tensors", "fp8"] {
            let block = json!({ "quant_method": method, "bits": bits, "group_size": bits, "format": "pack-quantized",
                "weight_block_size": bits, "config_groups": { "a": { "weights": { "num_bits": bits } } } });
            let _ = look(&block, &expected, &stored);
        }
    }
    let document = Document::parse("config.json", br#"{"quantization_config": 7}"#);
    let config = Checkpoint::planned("", Parts { documents: vec![document], ..Parts::default() });
    assert!(matches!(declared_scheme(config.config().expect("JSON"), schemes()), DeclaredScheme::Plain));
}

#[test]
fn tensors_tell_their_scheme() {
    let told = |names: &[&'static str]| {
        Some(module::signature(schemes(), &names.iter().copied().collect())?.0.scheme.as_str())
    };
    for (scheme, endings) in [
        ("gptq", &["q.qweight", "q.qzeros", "q.scales", "q.g_idx"][..]),
        ("awq", &["q.qweight", "q.qzeros", "q.scales"]),
        ("bitsandbytes-4bit", &["q.weight", "q.weight.absmax", "q.weight.quant_map"]),
        ("bitsandbytes-8bit", &["q.weight", "q.SCB"]),
        ("fp8", &["q.weight", "q.weight_scale_inv"]),
        ("mlx", &["q.weight", "q.scales", "q.biases"]),
        ("mxfp4", &["q_blocks", "q_scales"]),
    ] {
        assert_eq!(told(endings), Some(scheme));
    }
    assert_eq!(told(&["q.weight", "q.bias", "norm.biases", "attn.scales"]), None);
}
