//! Shard headers, compared with the safetensors crate.

use std::panic::catch_unwind;

use ckpt_doctor::checkpoint::{Fault, FaultKind, Shard, byte_len};
use safetensors::SafeTensors;
use safetensors::tensor::Metadata;
use serde_json::Value;

/// File name of the shard.
pub const NAME: &str = "model.safetensors";

/// Faults of shards that the crate accepts, each with its reason.
pub const OPENS_ALL_THE_SAME: &[(FaultKind, &str)] = &[
    (FaultKind::NoFormatMetadata, "transformers 4 requires `format`; the container does not"),
    (FaultKind::OddTensorName, "names that make trouble on a terminal or as a path are valid strings"),
    (FaultKind::MetadataNull, "serde reads null as an absent `__metadata__`"),
];

/// Further faults of shards that the crate accepts, although they violate the format.
pub const TOO_GENEROUS: &[(FaultKind, &str)] = &[
    (
        FaultKind::DuplicateHeaderKey,
        "the format forbids duplicate keys; the crate keeps the last of two names without a word",
    ),
    (FaultKind::EntryMalformed, "serde also reads a struct from an array: [\"F32\",[1],[0,4]]"),
];

/// The invariants of a whole file.
pub fn hold(bytes: &[u8]) {
    let shard = Shard::parse(NAME, bytes.len() as u64, bytes);
    super::faults_are_placed(&shard.faults, NAME, None);
    let grave: Vec<&Fault> = shard.faults.iter().filter(|f| !among(OPENS_ALL_THE_SAME, f.kind)).collect();
    if grave.is_empty() {
        tensors_fill_the_region(&shard);
    }
    match second_opinion(bytes) {
        Ok((length, metadata)) => {
            for fault in &grave {
                assert!(among(TOO_GENEROUS, fault.kind), "the crate opens it: {fault:?}");
                let reason = fault.detail.get("reason").and_then(Value::as_str).unwrap_or_default();
                if fault.kind == FaultKind::EntryMalformed {
                    assert_eq!(reason, "it is not an object");
                }
            }
            assert_eq!(shard.data_start, length as u64 + 8);
            assert!(!shard.unread);
            if grave.is_empty() {
                assert_eq!(shard.tensors.len(), metadata.tensors().len());
                for tensor in &shard.tensors {
                    let info = metadata.info(&tensor.name).unwrap_or_else(|| panic!("the crate has no {tensor:?}"));
                    assert_eq!(info.dtype.to_string(), tensor.dtype.name());
                    assert!(info.shape.iter().map(|d| *d as u64).eq(tensor.shape.iter().copied()), "{tensor:?}");
                    let (begin, end) = info.data_offsets;
                    assert_eq!((begin as u64, end as u64), (tensor.begin, tensor.end));
                }
            }
        }
        Err(error) => assert!(!grave.is_empty(), "no fault found, but the crate reports {error}"),
    }
}

/// Result of the crate. It panics on overflowing sums when overflow checks are on, which counts as a refusal.
fn second_opinion(bytes: &[u8]) -> Result<(usize, Metadata), String> {
    let opinion = catch_unwind(|| SafeTensors::read_metadata(bytes));
    opinion.map_err(|_| "a panic".to_owned())?.map_err(|error| error.to_string())
}

fn among(list: &[(FaultKind, &str)], kind: FaultKind) -> bool {
    list.iter().any(|(k, _)| *k == kind)
}

/// Each byte of the data belongs to one tensor, and the length of each tensor matches its shape.
fn tensors_fill_the_region(shard: &Shard) {
    assert!(!shard.unread && shard.unreadable.is_empty());
    let mut ranges: Vec<(u64, u64)> = Vec::with_capacity(shard.tensors.len());
    for tensor in &shard.tensors {
        assert_eq!(byte_len(tensor.dtype, &tensor.shape), Some(tensor.end - tensor.begin), "{tensor:?}");
        ranges.push((tensor.begin, tensor.end));
    }
    ranges.sort_unstable();
    let mut filled = 0;
    for (begin, end) in ranges {
        assert_eq!(begin, filled);
        filled = end;
    }
    assert_eq!(shard.data_start + filled, shard.file_len);
}
