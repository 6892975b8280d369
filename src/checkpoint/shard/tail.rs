//! Shards whose last bytes are zero.

use super::{Dtype, Shard, Tensor};
use crate::checkpoint::{Fault, FaultKind};

/// The fault of a shard whose bytes from `from` on, counted in its data, are zero. `None` unless these bytes contain a
/// whole matrix or the end of one: a bias may be zero, and so may the second factor of an untrained LoRA.
pub(crate) fn zero_tail(shard: &Shard, tensors: &[&Tensor], from: u64) -> Option<Fault> {
    let zero = |t: &&&Tensor| t.begin >= from && !t.is_empty();
    let matrix = |t: &&Tensor| t.shape.len() > 1 && !t.name.contains("lora_B") && !t.name.contains("lora_embedding_B");
    let all: Vec<&Tensor> = tensors.iter().filter(zero).copied().collect();
    let whole = all.iter().find(|t| matrix(t)).copied();
    let first = whole.or_else(|| tensors.iter().copied().filter(|t| matrix(t)).find(|t| ends_within(t, from)))?;
    let fault = Fault::new(FaultKind::ZeroTail).at(shard.place().in_tensor(first.name.clone()));
    let region = shard.file_len.saturating_sub(shard.data_start);
    let fault = fault.with("tensors", all.len()).with("bytes", region.saturating_sub(from));
    Some(fault.with("partly", whole.is_none()))
}

/// Whether the nonzero values of a matrix end within a row, and at least a row of zeros follows. Rows that are zero
/// from their start are padding.
fn ends_within(tensor: &Tensor, from: u64) -> bool {
    let is_float = matches!(tensor.dtype, Dtype::BF16 | Dtype::F16 | Dtype::F32 | Dtype::F64);
    let row = tensor.shape.first().and_then(|rows| tensor.len().checked_div(*rows)).unwrap_or(0);
    let begun = from.checked_sub(tensor.begin).and_then(|written| written.checked_rem(row)).is_some_and(|n| n > 0);
    is_float && begun && tensor.end.saturating_sub(from) >= row
}
