//! Invariants on random input, with `serde_json` and `safetensors` as oracles.

use std::collections::HashMap;

use ckpt_doctor::checkpoint::{Document, Fault, FaultKind, PythonModule, Vocabulary};
use proptest::prelude::*;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView, serialize};
use serde_json::Value;

use super::shards::read;

/// Any JSON value, a few levels deep.
fn json() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(Value::Null),
        any::<bool>().prop_map(Value::from),
        any::<i64>().prop_map(Value::from),
        (-1e300..1e300_f64).prop_map(Value::from),
        "\\PC{0,8}|[\\x00-\\x1f\"\\\\]{0,4}".prop_map(Value::from),
    ];
    leaf.prop_recursive(4, 40, 6, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..6).prop_map(Value::from),
            prop::collection::vec(("[a-c/~\"é]{0,3}", inner), 0..6)
                .prop_map(|members| Value::Object(members.into_iter().collect())),
        ]
    })
}

/// Bytes after random changes, deletions and insertions.
fn mutated(bytes: Vec<u8>) -> impl Strategy<Value = Vec<u8>> {
    let piece = prop::sample::select(vec![
        &b","[..],
        b"{",
        b"}",
        b"[",
        b"]",
        b"\"",
        b"\\",
        b"'",
        b"//",
        b"/*",
        b"NaN",
        b"-",
        b"1e",
        b"\0",
        b"\xff",
        b":",
        b"\\ud800",
        b"=======\n",
        b" ",
        b"0",
        b"99999999999999999999",
    ]);
    prop::collection::vec((any::<prop::sample::Index>(), 0..4_usize, piece), 0..4).prop_map(move |edits| {
        let mut bytes = bytes.clone();
        for (at, cut, piece) in edits {
            let start = at.index(bytes.len() + 1);
            let end = (start + cut).min(bytes.len());
            bytes.splice(start..end, piece.iter().copied());
        }
        bytes
    })
}

fn tensors() -> impl Strategy<Value = Vec<(String, Dtype, Vec<usize>)>> {
    let dtype = prop::sample::select(vec![
        Dtype::BOOL,
        Dtype::U8,
        Dtype::F8_E4M3,
        Dtype::F16,
        Dtype::BF16,
        Dtype::F32,
        Dtype::I64,
        Dtype::C64,
        Dtype::F4,
    ]);
    let one = ("[a-z][a-z.0-9é]{0,11}", dtype, prop::collection::vec(0..5_usize, 0..4));
    prop::collection::vec(one, 0..6).prop_map(|mut list| {
        list.sort();
        list.dedup_by(|a, b| a.0 == b.0);
        // Elements of four bits need an even number to fill whole bytes.
        list.retain(|(_, dtype, shape)| *dtype != Dtype::F4 || shape.iter().product::<usize>() % 2 == 0);
        list
    })
}

fn serialised(list: &[(String, Dtype, Vec<usize>)]) -> Vec<u8> {
    let data = vec![7; 8 * 4 * 4 * 4];
    let views = list.iter().map(|(name, dtype, shape)| {
        let bytes = shape.iter().product::<usize>() * dtype.bitsize() / 8;
        (name.clone(), TensorView::new(*dtype, shape.clone(), &data[..bytes]).unwrap())
    });
    let metadata = HashMap::from([("format".to_owned(), "pt".to_owned())]);
    serialize(views, Some(metadata)).unwrap()
}

fn spans_are_sound(faults: &[Fault], text: &str) {
    for span in faults.iter().flat_map(|f| &f.places).filter_map(|p| p.span.clone()) {
        assert!(text.get(span.clone()).is_some(), "{span:?} in {text:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn documents_that_serde_json_writes_come_back_equal(value in json(), pretty in any::<bool>()) {
        let value = serde_json::json!({ "root": value });
        let text = if pretty { serde_json::to_string_pretty(&value) } else { serde_json::to_string(&value) }.unwrap();
        let document = Document::parse("config.json", text.as_bytes());
        prop_assert_eq!(document.faults, vec![]);
        prop_assert_eq!(document.value, Some(value));
    }

    #[test]
    fn every_member_is_found_where_it_stands(value in json()) {
        let text = serde_json::to_string_pretty(&value).unwrap();
        let document = Document::parse("config.json", text.as_bytes());
        let mut open = vec![(String::new(), &value)];
        while let Some((pointer, value)) = open.pop() {
            let span = document.locate(&pointer).unwrap();
            prop_assert_eq!(&serde_json::from_str::<Value>(&text[span]).unwrap(), value);
            match value {
                Value::Object(map) => open.extend(map.iter().map(|(key, value)| {
                    (format!("{pointer}/{}", key.replace('~', "~0").replace('/', "~1")), value)
                })),
                Value::Array(list) => open.extend(list.iter().enumerate().map(|(i, value)| (format!("{pointer}/{i}"), value))),
                _ => {}
            }
        }
    }

    #[test]
    fn a_faultless_document_is_strict_json(bytes in json().prop_flat_map(|v| mutated(serde_json::json!({ "a": v, "b": 1 }).to_string().into_bytes()))) {
        let document = Document::parse("config.json", &bytes);
        let strict = serde_json::from_slice::<Value>(&bytes).ok();
        if document.faults.is_empty() {
            prop_assert_eq!(&strict, &document.value);
        }
        // The value is the same as in strict JSON, with any faults (except huge numbers).
        if let Some(strict) = strict && !document.faults.iter().any(|f| f.kind == FaultKind::HugeNumber) {
            prop_assert_eq!(document.value, Some(strict));
        }
        if let Some(text) = &document.text {
            spans_are_sound(&document.faults, text);
        }
    }

    #[test]
    fn arbitrary_bytes_are_read(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = Document::parse("tokenizer.json", &bytes);
        let _ = Document::parse("vocab.json", &bytes);
        let _ = Vocabulary::parse("tokenizer.model", &bytes);
        let _ = PythonModule::parse("m.py", &bytes);
        let _ = read(&bytes);
    }

    #[test]
    fn shards_that_the_crate_writes_are_faultless(list in tensors()) {
        let bytes = serialised(&list);
        let shard = read(&bytes);
        prop_assert_eq!(shard.faults, vec![]);
        let (_, metadata) = SafeTensors::read_metadata(&bytes).unwrap();
        prop_assert_eq!(shard.tensors.len(), metadata.tensors().len());
        for tensor in &shard.tensors {
            let info = metadata.info(&tensor.name).unwrap();
            let shape: Vec<_> = info.shape.iter().map(|d| *d as u64).collect();
            prop_assert_eq!(&shape, &tensor.shape);
            prop_assert_eq!(info.dtype.to_string(), tensor.dtype.name());
            prop_assert_eq!((info.data_offsets.0 as u64, info.data_offsets.1 as u64), (tensor.begin, tensor.end));
        }
    }

    #[test]
    fn a_faultless_shard_opens_in_the_crate(bytes in tensors().prop_flat_map(|list| mutated(serialised(&list)))) {
        if read(&bytes).faults.is_empty() {
            prop_assert!(SafeTensors::read_metadata(&bytes).is_ok());
        }
    }

    #[test]
    fn a_mutated_header_of_its_own_length_opens_in_the_crate_when_faultless(
        header in tensors().prop_flat_map(|list| {
            let bytes = serialised(&list);
            let end = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
            (mutated(bytes[8..end].to_vec()), Just(bytes.len() - end))
        })
    ) {
        let bytes = super::shards::file(&header.0, header.1);
        if read(&bytes).faults.is_empty() {
            prop_assert!(SafeTensors::read_metadata(&bytes).is_ok());
        }
    }
}
